"""Maze releases: views with and without the goal, early ends, fixed pairs, the same bits however made."""

from __future__ import annotations

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.distractors import DistractorSetting, sample_distractors
from dmcvb_gen.generate.engine import paint
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.release.verify import verify
from dmcvb_gen.rendering import available_renderers, make_renderer
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from tests.conftest import TINY_MAZE, maze_recipe, roll_out


@pytest.mark.slow
def test_a_maze_release_is_sound_and_the_same_with_two_workers(maze_release, tmp_path):
    result = verify(maze_release)
    assert result.sound, result.findings
    again = roll_out(maze_recipe(), tmp_path / "again", workers=2, works=lambda works: works[::-1])
    assert again.digest == Release.open(maze_release).digest


def test_all_views_with_and_without_the_goal(maze_release):
    subset = Release.open(maze_release)["ant-maze-tiny/random/visible"]
    task, episode = get_task(TINY_MAZE), subset.episode(0)
    assert set(subset.pixel_arrays) == {
        f"{root}/{view}" for root in ("pixels", "pixels_hidden_goal") for view in task.views
    }
    length = len(episode["action"])
    assert episode["pixels/top"].shape == (length + 1, 16, 16, 3)
    assert (episode["pixels/top"] != episode["pixels_hidden_goal/top"]).any(axis=(1, 2, 3)).all()
    assert len(np.unique(episode["exogenous/style"])) == 1
    assert episode["exogenous/style"][0] // 100 in (2, 3, 4, 5)
    if episode["terminated"]:
        assert episode["discount"][-1] == 0 and episode["state"][-1, task.state_slices["target_activated"]] == 1
    assert (episode["reward"] <= 0).all() and (episode["reward"] >= -2).all()


@pytest.mark.slow
def test_fixed_goals(tmp_path):
    recipe = maze_recipe(settings=("fixed",), episodes=None, fixed_goals=2, episodes_per_goal=2)
    subset = roll_out(recipe, tmp_path / "r")["ant-maze-tiny/random/fixed"]
    np.testing.assert_array_equal(subset.read("goal_pair"), [0, 0, 1, 1])
    task = get_task(TINY_MAZE)
    first = [subset.episode(i, ["state", "length"])["state"][0] for i in range(4)]
    goals = np.array([state[task.state_slices["target_position"]] for state in first])
    starts = np.array([state[task.state_slices["walker_position"]] for state in first])
    pairs = [pair for pair in fixed_pairs(task.layout, 2, 0) for _ in range(2)]
    for (start, goal), at, to in zip(pairs, starts, goals, strict=True):
        assert np.abs(at[:2] - task.layout.world(start)).max() <= 0.25 + 1e-6
        assert np.abs(to[:2] - task.layout.world(goal)).max() <= 0.5 + 1e-6
    assert (starts[0] != starts[1]).all() and (goals[0, :2] != goals[1, :2]).all()


def frames(task, seed, count):
    """Physics states and labels of the starts of `count` episodes."""
    batch = task.batch(count)
    batch.reset([np.random.default_rng([seed, i]) for i in range(count)])
    physics = batch.physics()
    generators = {"style": [np.random.default_rng(i) for i in range(count)]}
    return physics, sample_distractors(task, DistractorSetting(), physics[:, None], generators)[:, 0]


@pytest.mark.slow_cases("opengl")
@pytest.mark.parametrize("name", ["native", "opengl"])
def test_hidden_pictures_differ_only_where_the_goal_is_in_sight(name):
    reason = available_renderers()[name]
    if reason:
        pytest.skip(reason)
    task = get_task("ant-maze-easy7x7b")
    physics, labels = frames(task, 7, 24)
    renderer = make_renderer(name, task, 32)
    visible, hidden = renderer.render(physics, labels), renderer.render(physics, labels, hide_goal=True)
    renderer.close()
    seen_anywhere = 0
    for column, view in enumerate(task.views):
        differs = (visible[:, column] != hidden[:, column]).any(axis=(1, 2, 3))
        in_sight = task.goal_in_sight(view, physics, labels)
        assert not (differs & ~in_sight).any()
        seen_anywhere += int((~in_sight).sum())
        if view == "top":
            assert differs.all()
    assert seen_anywhere > 10  # pictures that need no second rendering


@pytest.mark.slow_cases("opengl")
@pytest.mark.parametrize("name", ["opengl"])
def test_shared_backgrounds_give_the_pictures_that_painting_each_frame_gives(name):
    reason = available_renderers()[name]
    if reason:
        pytest.skip(reason)
    task = get_task("ant-maze-empty7x7")
    policy = load_policy(bundled_policies(task.id, "expert")[0], task)
    far = [((2, 1), (4, 5))]
    run = simulate(task, [policy], range(3), 4, (task.id,), max_steps=200, goal_pairs=far, episodes_per_goal=3)
    assert run.terminated.any()  # the goal is reached in one of them, so the ant is far from it and beside it
    physics, length = run.physics[:, :201], run.length
    generators = {"style": [np.random.default_rng(i) for i in range(3)]}
    labels = sample_distractors(task, DistractorSetting(), filled(physics, length), generators)
    renderer, asked = make_renderer(name, task, 32), []
    render = renderer.render

    def counting(physics, exogenous, views=None, hide_goal=False):
        if hide_goal:
            asked.append((views[0], len(physics)))
        return render(physics, exogenous, views=views, hide_goal=hide_goal)

    renderer.render = counting
    painted = {name: picture.copy() for name, picture in paint(task, renderer, physics, labels, length, 201)}
    episode, row = np.nonzero(np.arange(201)[None] <= length[:, None])
    every = render(physics[episode, row], labels[episode, row], hide_goal=True)
    renderer.close()
    for column, view in enumerate(task.views):
        np.testing.assert_array_equal(painted[f"pixels_hidden_goal/{view}"][episode, row], every[:, column])
    assert sum(count for view, count in asked if view == "top") < len(episode) / 2


def filled(physics, length):
    """Physics states with the last one of an episode repeated past its end."""
    rows = np.minimum(np.arange(physics.shape[1])[None], length[:, None])
    return np.take_along_axis(physics, rows[..., None], axis=1)


def test_styles_of_data_and_of_evaluation_are_apart():
    task = get_task("ant-maze-empty7x7")
    physics = np.repeat(task.batch(1).physics()[None], 200, axis=0)
    generators = {"style": [np.random.default_rng(i) for i in range(200)]}
    train = sample_distractors(task, DistractorSetting(), physics, generators, split="train").style
    val = sample_distractors(task, DistractorSetting(), physics, generators, split="val").style
    assert set(np.unique(train) // 100) == {2, 3, 4, 5} and set(np.unique(val) // 100) == {1}
    assert set(np.unique(train)) <= {look for style in (2, 3, 4, 5) for look in task.looks(style)}
    styles = np.unique(train[:, 0] // 100, return_counts=True)[1]
    assert (np.abs(styles - 50) < 25).all() and len(np.unique(train)) > 80  # styles as likely, all textures in play
