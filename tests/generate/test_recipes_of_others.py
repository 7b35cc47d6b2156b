"""The recipes after other benchmarks' data: their published counts, and a tiny cut of each made and verified."""

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.recipe import expand, load_recipe
from dmcvb_gen.policies.header import PolicyHeader, weight_shapes
from dmcvb_gen.policies.policy_file import save_policy
from dmcvb_gen.release.card import write_card
from dmcvb_gen.release.verify import verify
from dmcvb_gen.spec import DistractorSetting
from dmcvb_gen.tasks import get_task

TINY = ["--episodes", "1", "--max-steps", "3", "--size", "16"]
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
CUTS = {
    "laom": ["cheetah-run", "humanoid-walk"],
    "vd4rl": ["walker-walk", "--level", "random"],
    "dmc-gb": ["--level", "random", "--distractor", "dynamic_hard"],
    "dcs-easy": ["--level", "random", "--distractor", "dynamic_easy"],
    "dcs-medium": ["walker-walk", "--level", "expert"],
    "dcs-hard": ["cheetah-run", "--level", "expert"],
}


def run(*arguments):
    return CliRunner().invoke(main, ["rollout", *map(str, arguments)])


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_recipe_has_the_tasks_counts_sizes_and_scales_that_were_published(name):
    size, tasks, steps, scales = PUBLISHED[name]
    recipe, requests = load_recipe(name), expand(load_recipe(name))
    assert recipe.name == name and recipe.size == size and "Not equal to theirs:" in recipe.description
    assert {request.task for request in requests} == tasks
    assert {request.episodes * request.max_steps for request in requests} == {steps}
    assert {DistractorSetting.parse(request.setting).scale for request in requests} == scales


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_a_recipe_is_planned_and_a_tiny_cut_of_it_is_made_and_verified(name, tmp_path):
    cut = ["--recipe", name, *CUTS[name], *TINY, "--out", tmp_path / "r"]
    planned = run(*cut, "--dry-run")
    assert planned.exit_code == 0 and not (tmp_path / "r").exists(), planned.output
    made = run(*cut, "--workers", 1)
    assert made.exit_code == 0, made.output
    release = Release.open(tmp_path / "r")
    assert {subset.record.size for subset in release.subsets.values()} == {16} and not release.shortfalls
    assert not verify(tmp_path / "r").findings
    write_card(tmp_path / "r")
    assert "Not equal to theirs:" in (tmp_path / "r" / "README.md").read_text()


def test_tasks_without_a_bundled_expert_name_the_cure_and_take_an_expert_of_ones_own(tmp_path):
    cut = ["--recipe", "laom", "hopper-hop", *TINY, "--out", tmp_path / "r"]
    refused = run(*cut, "--dry-run")
    assert refused.exit_code and "train-behaviour hopper-hop" in refused.output and "--behaviour" in refused.output
    task = get_task("hopper-hop")
    sizes = {"observation_size": task.behaviour_size, "action_size": task.action_size}
    header = PolicyHeader(task="hopper-hop", algorithm="sac", agent_step=0, hidden=(4,), **sizes)
    weights = {weight: [[0.5] * shape[-1]] * shape[0] if shape[1:] else [0.5] * shape[0]
               for weight, shape in weight_shapes(header).items()}  # fmt: skip
    save_policy(tmp_path / "expert.safetensors", header, weights)
    made = run(*cut, "--behaviour", tmp_path / "expert.safetensors", "--workers", 1)
    assert made.exit_code == 0 and not verify(tmp_path / "r").findings, made.output
