"""Maze releases: views with and without the goal, early ends, fixed pairs, the same bits however made."""

from __future__ import annotations

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.reader import TRANSITIONS
from dmcvb_gen.distractors import DistractorSetting, sample_distractors
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from tests.conftest import TINY_MAZE, maze_recipe, roll_out


def test_all_views_with_and_without_the_goal(maze_release):
    subset = Release.open(maze_release)["ant-maze-tiny/random/visible"]
    task, episode = get_task(TINY_MAZE), subset.episode(0)
    folders = ("pixels", "pixels_hidden_goal")
    assert set(subset.pixel_arrays) == {f"{folder}/{view}" for folder in folders for view in task.views}
    length = len(episode["action"])
    assert episode["pixels/top"].shape == (length + 1, 16, 16, 3)
    assert (episode["pixels/top"] != episode["pixels_hidden_goal/top"]).any(axis=(1, 2, 3)).all()
    assert len(np.unique(episode["exogenous/style"])) == 1
    if episode["terminated"]:
        assert episode["discount"][-1] == 0 and episode["state"][-1, task.state_slices["target_activated"]] == 1
    assert (episode["reward"] <= 0).all() and (episode["reward"] >= -2).all()


@pytest.mark.slow
def test_rows_past_an_episodes_end_are_zero(tmp_path):
    subset = roll_out(maze_recipe(episodes_per_shard=2), tmp_path / "r")["ant-maze-tiny/random/visible"]
    lengths = subset.read("length")
    assert lengths.min() < lengths.max() and subset.read("exogenous/style")[:, 0].all()
    for name in subset.arrays:
        if subset.spec(name).steps:
            for values, length in zip(subset.array(name)[:], lengths, strict=True):
                assert not values[length + (name not in TRANSITIONS) :].any(), name


@pytest.mark.slow
def test_fixed_goals(tmp_path):
    recipe = maze_recipe(settings=("fixed",), episodes=None, fixed_goals=2, episodes_per_goal=2)
    subset = roll_out(recipe, tmp_path / "r")["ant-maze-tiny/random/fixed"]
    np.testing.assert_array_equal(subset.read("goal_pair"), [0, 0, 1, 1])
    task = get_task(TINY_MAZE)
    pairs = [pair for pair in fixed_pairs(task.layout, 2, recipe.seed) for _ in range(2)]
    for field, cells in zip(("walker_position", "target_position"), zip(*pairs, strict=True), strict=True):
        places = subset.read("state")[:, 0, task.state_slices[field]][:, :2]
        np.testing.assert_array_equal(np.rint(task.layout.grid(places)), cells)
        assert (places[0] != places[1]).all()


def test_styles_of_data_and_of_evaluation_are_apart():
    task = get_task("ant-maze-empty7x7")
    physics = np.repeat(task.batch(1).physics()[None], 200, axis=0)
    generators = {"style": [np.random.default_rng(i) for i in range(200)]}
    train = sample_distractors(task, DistractorSetting(), physics, generators, split="train").style
    val = sample_distractors(task, DistractorSetting(), physics, generators, split="val").style
    assert set(np.unique(train) // 100) == {2, 3, 4, 5} and set(np.unique(val) // 100) == {1}
    assert set(np.unique(train)) <= {*sum(task.styles("train"), ())}
    styles = np.unique(train[:, 0] // 100, return_counts=True)[1]
    assert (np.abs(styles - 50) < 25).all() and len(np.unique(train)) > 80  # styles as likely, all textures in play
