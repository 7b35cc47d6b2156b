"""The shipped recipes: what was published of those after other benchmarks, and a tiny cut of each made and verified."""

import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.recipe import expand, load_recipe, shipped_recipes
from dmcvb_gen.policies.bundled import bundled_levels
from dmcvb_gen.release.card import write_card
from dmcvb_gen.release.verify import verify
from dmcvb_gen.spec import DistractorSetting
from tests.conftest import invoke

TINY = ["--episodes", "2", "--max-steps", "3", "--size", "8"]
SUITE = {"ball_in_cup-catch", "cartpole-swingup", "cheetah-run", "finger-spin", "reacher-easy", "walker-walk"}
"""The six tasks of the Distracting Control Suite."""
DMC_GB = {"walker-walk", "walker-stand", "cartpole-swingup", "ball_in_cup-catch", "finger-spin"}
PUBLISHED = {
    "laom": (64, {"cheetah-run", "walker-run", "hopper-hop", "humanoid-walk"}, 5_000_000, {0.1}),
    "vd4rl": (64, {"walker-walk", "cheetah-run", "humanoid-walk"}, 100_000, {0.0, 0.1, 0.2, 0.3}),
    "dmc-gb": (84, DMC_GB, 15_000, {0.0, 0.1, 0.3}),
    "dcs-easy": (84, SUITE, 100_000, {0.1}),
    "dcs-medium": (84, SUITE, 100_000, {0.2}),
    "dcs-hard": (84, SUITE, 100_000, {0.3}),
}
"""Recipe -> size, tasks, agent steps a subset and scales, as their papers and repositories say."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_recipe_has_the_tasks_counts_sizes_and_scales_that_were_published(name):
    size, tasks, steps, scales = PUBLISHED[name]
    recipe, requests = load_recipe(name), expand(load_recipe(name))
    assert recipe.name == name and recipe.size == size and "Not equal to theirs:" in recipe.description
    assert {request.task for request in requests} == tasks
    assert {request.episodes * request.max_steps for request in requests} == {steps}
    assert {DistractorSetting.parse(request.setting).scale for request in requests} == scales


def test_laom_has_its_action_repeat_its_videos_and_its_episodes():
    recipe = load_recipe("laom")
    assert recipe.action_repeat == 1 and recipe.split == "train"
    for request in expand(recipe):
        setting = DistractorSetting.parse(request.setting)
        assert (request.episodes, request.max_steps, setting.kind, setting.videos) == (5_000, 1_000, "dynamic", 60)
        assert all(setting.scale_of(part) == 0.1 for part in ("camera", "color"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.full] * name.startswith("dmcvb")) for name in shipped_recipes()]
)
def test_two_episodes_of_every_subset_of_a_shipped_recipe_are_planned_made_and_sound(name, tmp_path):
    """Tasks whose experts are not in the package are refused in one line, which says how to train one."""
    wanted = {request.name: request for request in expand(load_recipe(name))}
    lacking = {r.task for r in wanted.values() if r.level != "random" and r.level not in bundled_levels(r.task)}
    for task in lacking:
        refused = invoke("rollout", "--recipe", name, task, *TINY, "--out", tmp_path / "r", "--dry-run", code=2).output
        assert refused.count("\n") == 1 and f"`dmcvb-gen train-behaviour {task} && " in refused, refused
        assert f"select-checkpoints runs/{task}`, then give --behaviour runs/{task}" in refused
    tasks = sorted({request.task for request in wanted.values()} - lacking)
    cut = ["rollout", "--recipe", name, *tasks, *TINY, "--out", tmp_path / "r", "--json"]
    invoke(*cut, "--dry-run", code=0)
    assert not (tmp_path / "r").exists()
    invoke(*cut, "--workers", 1, code=0)
    release = Release.open(tmp_path / "r")
    assert set(release.subsets) == {name for name, request in wanted.items() if request.task in tasks}
    assert all(len(subset.episodes) >= 2 for subset in release.subsets.values()) and not release.shortfalls
    assert not verify(tmp_path / "r").findings
    write_card(tmp_path / "r")
    card = (tmp_path / "r" / "README.md").read_text()
    assert name not in PUBLISHED or "Not equal to theirs:" in card
    assert ("60 background videos are asked for, and 8 are there" in card) == (name == "laom")
