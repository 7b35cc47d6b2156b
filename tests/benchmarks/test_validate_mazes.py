"""validate: a whole small maze release (goals visible, hidden, fixed) through checks, B1 and B3, and its page."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from dmcvb_gen.agents.data import Slice, load_data
from dmcvb_gen.benchmarks.cell import data_score
from dmcvb_gen.benchmarks.checks import check_policy_returns
from dmcvb_gen.benchmarks.plan import goal_cells
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import Release
from dmcvb_gen.dataset.manifest import PolicyRecord
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from tests.conftest import roll_out

TINY = "ant-maze-tiny:****/*..*/****"
NAME = "ant-maze-tiny/random"


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Random actions, an episode with the goal visible, one with it hidden, one of each of two fixed goals."""
    pattern = {"tasks": TINY, "levels": "random", "settings": ["visible", "hidden", "fixed"], "episodes": 1}
    pattern |= {"fixed_goals": 2, "episodes_per_goal": 1}
    recipe = {"name": "tiny-maze", "size": 16, "renderer": {"backend": "native"}, "subsets": [pattern]}
    folder = tmp_path_factory.mktemp("validate-maze") / "tiny"
    roll_out(make_recipe(recipe), folder)
    return folder


def test_episodes_of_fixed_goals_are_not_held_to_returns_over_random_ones(release):
    said = {"mean": -1.0, "std": 0.1, "episodes": 100, "mode": "sampled"}
    policy = PolicyRecord(name="other", digest="x", header={"task": TINY, "evaluation": said})
    found = {}
    for setting in ("visible", "fixed"):
        subset = Release.open(release)[f"{NAME}/{setting}"]
        subset.record = subset.record.model_copy(update={"policies": (policy,), "deterministic": False})
        found[setting] = len(list(check_policy_returns(subset)))
    assert found == {"visible": 1, "fixed": 0}


def test_the_cells_of_a_goal_pair_are_those_of_the_rollout(release):
    subset, layout = Release.open(release)[f"{NAME}/fixed"], get_task(TINY).layout
    assert [goal_cells(subset, pair) for pair in range(2)] == fixed_pairs(layout, 2, seed=0)


# -- B1 and B3 ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(release, tmp_path_factory):
    out = tmp_path_factory.mktemp("maze-report")
    command = ["validate", str(release), "--benchmark", "b1", "--benchmark", "b3", "--agents", "state-bc,bc,id+bc"]
    return out, CliRunner().invoke(main, [*command, "--workers", "1", "--threads", "1", "--out", str(out)])


def test_a_maze_release_goes_through_b1_and_b3(report):
    out, result = report
    assert result.exit_code == 0, result.output
    facts = json.loads((out / "report.json").read_text())
    ran = [(r["cell"]["benchmark"], r["cell"]["agent"], r["labels"]["policy"]) for r in facts["results"]]
    assert set(ran) == {("b1", agent, "random") for agent in ("state-bc", "bc", "id+bc")} | {
        ("b3", agent, f"random goal {pair}") for agent in ("bc", "id+bc") for pair in range(2)
    }
    by_id = {r["id"]: r for r in facts["results"]}
    pretrained = next(r for name, r in by_id.items() if name.startswith("b3") and "id-bc" in name.replace("+", "-"))
    assert [part["subset"] for part in pretrained["cell"]["pretrain"]] == [f"{NAME}/hidden"]
    assert not facts["failed"] and not any(r["share"] for r in facts["results"])
    assert "ant-maze-tiny/expert/visible" in result.output  # B1 would have the paper's levels too


def test_the_datas_speed_is_that_of_the_straight_line_as_the_policies_is(release):
    subset, task = Release.open(release)[f"{NAME}/visible"], get_task(TINY)
    data = load_data({subset.name: subset}, [Slice(subset.name)], pixels=False, seed=0)
    first, ends = np.cumsum(data.lengths + 1) - data.lengths - 1, np.cumsum(data.lengths + 1) - 1
    data.discount[ends - 1] = 0  # as if the ant had got there
    state = data.state[first].numpy() * data.normalization.std.numpy() + data.normalization.mean.numpy()
    assert state == pytest.approx(subset.read("state")[:, 0], abs=1e-4)
    straight = np.linalg.norm(subset.read("state")[:, 0, task.state_slices["target_vector"]], axis=1)
    score = data_score(subset, data)
    assert score.success == 1
    assert score.speed == pytest.approx((straight / (data.lengths * 2 * task.control_timestep)).mean(), rel=1e-4)


def test_maze_scores_have_reward_success_and_speed_beside_the_datas_own(report, release):
    facts = json.loads((report[0] / "report.json").read_text())
    [score] = [r for r in facts["results"] if r["cell"]["agent"] == "state-bc"]
    subset = Release.open(release)[f"{NAME}/visible"]
    reached = subset.read("terminated")
    assert score["data"]["success"] == reached.mean() and score["data"]["limit"] == subset.record.max_steps
    assert (score["data"]["speed"] is None) == (not reached.any())
    assert score["score"]["success"] is not None and score["score"]["limit"] == 10  # smoke's
    page = (report[0] / "report.html").read_text()
    assert "success" in page and "Evaluations are cut at 10 agent steps" in page
