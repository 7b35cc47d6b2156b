"""Policies of one's own: scored by `dmcvb_gen.evaluate` and by `validate --agent`; wrong actions are one line."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from dm_control import suite

import dmcvb_gen
from dmcvb_gen import own_code
from dmcvb_gen.benchmarks.cell import CellRun, OwnAgent, kept_results
from dmcvb_gen.benchmarks.plan import BUDGETS, plan_benchmark
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import Release
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.tasks import get_task

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"


@pytest.mark.parametrize("where, channels", [("walker-walk/dynamic", 9), ("ant-maze-empty7x7/hidden", 27)])
def test_a_policy_sees_stacks_and_states_of_all_episodes_at_once(where, channels):
    task, seen = get_task(where.split("/")[0]), []

    def policy(observation):
        seen.append(observation)
        return np.full((2, task.action_size), 0.1)

    score = dmcvb_gen.evaluate(policy, where, episodes=2, max_steps=3, size=16, seed=4)
    assert len(seen) == 3 and score.limit == 3 and len(score.returns) == 2
    assert seen[0]["pixels"].shape == (2, channels, 16, 16) and seen[0]["pixels"].dtype == np.uint8
    assert seen[0]["state"].shape == (2, task.state_size) and seen[0]["state"].dtype == np.float32
    half = channels // 3
    np.testing.assert_array_equal(seen[2]["pixels"][:, half : 2 * half], seen[1]["pixels"][:, 2 * half :])
    assert score.mean == pytest.approx(np.mean(score.returns))
    again = dmcvb_gen.evaluate(policy, where, episodes=2, max_steps=3, size=16, seed=4, pixels=False)
    assert again.returns == score.returns and set(seen[-1]) == {"state"}


@pytest.mark.parametrize("where", ["walker-walk/dynamic", "ant-maze-empty7x7/visible"])
def test_the_split_changes_what_is_seen_and_nothing_else(where):
    seen = {}

    def policy(observation):
        seen[split] = observation
        return np.zeros((2, get_task(where.split("/")[0]).action_size))

    for split in ("val", "train"):
        dmcvb_gen.evaluate(policy, where, episodes=2, max_steps=1, size=16, split=split)
    np.testing.assert_array_equal(seen["val"]["state"], seen["train"]["state"])
    assert (seen["val"]["pixels"] != seen["train"]["pixels"]).any()
    with pytest.raises(UnknownNameError, match="train"):
        dmcvb_gen.evaluate(policy, where, split="trian")


@pytest.mark.parametrize("actions, told", [
    (np.zeros((2, 5)), r"step 0: .*shape \(2, 5\); expected \(2, 6\)"),
    (np.full((2, 6), np.nan), r"step 0: .*is nan; expected numbers"),
    (np.full((2, 6), 1.5), r"step 0: .*is 1\.5; expected \[-1, 1\]"),
    ("none", r"step 0: .*no array of actions"),
])  # fmt: skip
def test_wrong_actions_are_one_line_with_the_step_and_what_was_expected(actions, told):
    with pytest.raises(DmcvbError, match=told) as error:
        dmcvb_gen.evaluate(lambda observation: actions, "walker-walk/none", episodes=2, max_steps=2, pixels=False)
    assert len(str(error.value).splitlines()) == 1


def test_actions_lie_in_a_tasks_own_bounds():
    """dm_control's quadruped takes -1, -1, -0.8 to 1, 1.1, 0.8 at each leg."""
    spec, options = suite.load("quadruped", "walk").action_spec(), dict(episodes=2, max_steps=2, pixels=False)
    for action in (spec.minimum, spec.maximum):
        dmcvb_gen.evaluate(lambda _, action=action: np.stack([action] * 2), "quadruped-walk/none", **options)
    with pytest.raises(DmcvbError, match=r"is 1.01; expected \[-1, 1\], clip it"):
        dmcvb_gen.evaluate(lambda _: np.stack([spec.maximum + 0.01] * 2), "quadruped-walk/none", **options)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_torch_policy_need_not_detach_its_actions(dtype):
    weights = torch.full((2, 6), 0.5, dtype=dtype, requires_grad=True)
    options = dict(episodes=2, max_steps=2, pixels=False)
    score = dmcvb_gen.evaluate(lambda observation: weights * 1, "walker-walk/none", **options)
    same = dmcvb_gen.evaluate(lambda observation: np.full((2, 6), 0.5), "walker-walk/none", **options)
    assert score.returns == same.returns


@pytest.mark.parametrize("where, told", [
    ("walker-walk", "TASK/SETTING"), ("walker-wlk/none", "walker-walk"), ("walker-walk/dynamc", "dynamic"),
    ("ant-maze-empty7x7/fixed", "b3"),
])  # fmt: skip
def test_a_place_that_cannot_be_evaluated_is_refused_with_what_can(where, told):
    with pytest.raises(DmcvbError, match=told):
        dmcvb_gen.evaluate(lambda observation: None, where, pixels=False)


AGENTS = """
import numpy as np

def still(observation):
    return np.zeros((len(observation["state"]), 6))
still.pixels = False

def learned(data):
    assert data.task == "walker-walk" and len(data.source) > 0 and "pixels" not in data.source[0]
    mean = data.source.gather(np.arange(len(data.source)))["action"].mean(axis=0)
    return lambda observation: np.tile(mean, (len(observation["state"]), 1))
learned.pixels = False

def broken(observation):
    return np.zeros((1, 1))
broken.pixels = False
"""


@pytest.mark.slow
def test_validate_sets_agents_of_ones_own_beside_the_papers(small_release, tmp_path, monkeypatch):
    (tmp_path / "own_agents.py").write_text(AGENTS)
    monkeypatch.chdir(tmp_path)
    command = ["validate", str(small_release), "--profile", "smoke", "--only", "walker-walk/random/none"]
    command += [value for name in ("still", "learned", "broken") for value in ("--agent", f"own_agents:{name}")]
    result = CliRunner().invoke(main, [*command, "--workers", "1", "--threads", "1", "--out", str(tmp_path / "report")])
    facts = json.loads((tmp_path / "report" / "report.json").read_text())
    scores = {r["cell"]["agent"]: r["score"] for r in facts["results"]}
    assert set(scores) == {"state-bc", "own_agents:still", "own_agents:learned"}, result.output
    assert all("renderer" not in r["evaluation"] for r in facts["results"])  # none of them saw pictures
    [failed] = facts["failed"]
    assert "step 0" in failed["error"] and "expected (2, 6)" in failed["error"] and result.exit_code == 1
    assert scores["own_agents:still"]["returns"] != scores["own_agents:learned"]["returns"]
    alone = dmcvb_gen.evaluate(lambda o: np.zeros((2, 6)), "walker-walk/none", episodes=2, max_steps=10, pixels=False)
    assert scores["own_agents:still"]["returns"] == list(alone.returns)
    page = (tmp_path / "report" / "report.html").read_text()
    assert "own_agents:still" in page


CHANGING = """
import numpy as np

RATE = 0.5

def ready(observation):
    return np.full((len(observation["state"]), 6), float(open("weights.txt").read()))
ready.pixels = False

def learned(data):
    from changing_late import LATE
    return lambda observation: np.full((len(observation["state"]), 6), RATE * LATE)
learned.pixels = False
"""


@pytest.fixture
def changing(small_release, tmp_path, monkeypatch):
    """Agents whose policy hangs on other files: (name) -> its cell's result, as in a new process."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for name, text in {"changing.py": CHANGING, "changing_late.py": "LATE = 0.5\n", "weights.txt": "0.0"}.items():
        (tmp_path / name).write_text(text)
    release = Release.open(small_release)

    def score(name):
        own_code._digests.clear()
        for module in ("changing_late", "changing"):
            sys.modules.pop(module, None)
        importlib.invalidate_caches()
        cells, _ = plan_benchmark("b1", release, [f"changing:{name}"])
        cell = next(cell for cell in cells if cell.setting == "none")
        return CellRun(small_release, tmp_path / "out", BUDGETS["smoke"], cell).result()

    yield score
    own_code._digests.clear()


def write_later(path, text):
    """Write a file whose compiled code of before is not taken for its own."""
    path.write_text(text)
    os.utime(path, (path.stat().st_mtime + 10,) * 2)


def test_a_ready_policy_is_scored_anew_whatever_it_loads(changing, tmp_path):
    first = changing("ready")
    again = changing("ready")
    assert again["score"]["returns"] == first["score"]["returns"]
    (tmp_path / "weights.txt").write_text("0.5")
    assert changing("ready")["score"]["returns"] != first["score"]["returns"]


def test_an_agent_that_learns_is_trained_again_if_a_module_of_its_folder_changed(changing, tmp_path):
    first = json.loads(json.dumps(changing("learned")))
    assert changing("learned") == first  # its seconds, too: it was not trained
    write_later(tmp_path / "changing_late.py", "LATE = -0.5\n")  # imported by a function alone
    second = changing("learned")
    assert list(second["score"]["returns"]) != first["score"]["returns"]
    assert {"changing", "changing_late.py"} <= OwnAgent.load("changing:learned").digests.keys()
    write_later(tmp_path / "changing.py", CHANGING + "\n")
    with pytest.raises(DmcvbError, match="has changed, but its old code still runs"):
        _ = OwnAgent.load("changing:learned").digests


def test_a_result_file_that_names_an_agent_runs_no_code(changing, small_release, tmp_path, monkeypatch):
    changing("learned")
    monkeypatch.delenv(own_code.AGENTS)  # as if another user had made the folder
    kept = kept_results(Release.open(small_release), tmp_path / "out", BUDGETS["smoke"])
    monkeypatch.setenv(own_code.AGENTS, "changing:learned")
    again = kept_results(Release.open(small_release), tmp_path / "out", BUDGETS["smoke"])
    assert not kept and [cell.agent.name for cell, _ in again] == ["changing:learned"]


SEEING = """
import numpy as np

def seeing(data):
    learned = data.source.gather(np.arange(2))["pixels"].shape[1:]
    def policy(observation):
        assert observation["pixels"].shape[1:] == learned, (observation["pixels"].shape, learned)
        return np.zeros((len(observation["pixels"]), len(data.source[0]["action"])))
    return policy
"""


@pytest.mark.slow_cases("small_mazes")
@pytest.mark.parametrize("kind", ["small_release", "small_mazes"])
def test_what_an_agent_learns_from_is_what_it_sees_when_it_is_scored(kind, request, tmp_path, monkeypatch):
    (tmp_path / f"seeing_{kind}.py").write_text(SEEING)
    monkeypatch.chdir(tmp_path)
    command = ["validate", str(request.getfixturevalue(kind)), "--only", "*/random/*i*", "--agents", "state-bc"]
    command += ["--agent", f"seeing_{kind}:seeing", "--workers=1", "--threads=1", f"--out={tmp_path / 'report'}"]
    result = CliRunner().invoke(main, command)
    facts = json.loads((tmp_path / "report" / "report.json").read_text())
    assert not facts["failed"], facts["failed"]
    seeing = [one for one in facts["results"] if "seeing" in one["cell"]["agent"]]
    assert seeing and all("renderer" in one["evaluation"] for one in seeing), result.output


class Learner:
    """A class whose objects are policies that learned from data."""

    def __init__(self, data, rate=0.1):
        self.tasks = data

    def __call__(self, observation):
        return np.zeros((len(observation["state"]), 6))


def test_a_class_or_a_function_with_defaults_may_learn_and_other_classes_are_refused():
    assert OwnAgent("m:Learner", Learner).learns and isinstance(OwnAgent("m:Learner", Learner).policy("data"), Learner)
    assert OwnAgent("m:f", lambda data, k=3: None).learns and not OwnAgent("m:p", lambda observation: None).learns
    assert not OwnAgent("m:g", lambda data, k: None).learns
    own_code.allow(["pathlib:Path"], own_code.AGENTS)
    with pytest.raises(DmcvbError, match="is a class; expected a policy, or a function or class of `data`"):
        OwnAgent.load("pathlib:Path")


@pytest.mark.parametrize("option", [dict(max_steps=-1), dict(max_steps=2.5), dict(episodes=2.5), dict(threads=-3)])
def test_numbers_that_count_nothing_are_refused(option):
    for where in ("walker-walk/none", "ant-maze-empty7x7/visible"):
        with pytest.raises(DmcvbError, match=f"{next(iter(option))} is .*; give a whole number, at least 1"):
            dmcvb_gen.evaluate(lambda observation: None, where, pixels=False, **option)
    with pytest.raises(DmcvbError, match="seed is -1; give a whole number, at least 0"):
        dmcvb_gen.evaluate(lambda observation: None, "walker-walk/none", seed=-1)


@pytest.mark.parametrize("name, told", [("own_agnts:still", "cannot find agent"), ("bc", "--agents")])
def test_an_agent_that_cannot_be_loaded_is_one_line(small_release, tmp_path, name, told):
    command = ["validate", str(small_release), "--agent", name, "--only", "walker-walk/random/none", "--workers", "1"]
    result = CliRunner().invoke(main, [*command, "--agents", "state-bc", "--out", str(tmp_path)])
    assert result.exit_code != 0 and told in result.output


@pytest.mark.full
@pytest.mark.parametrize("example", ["evaluate_torch", "evaluate_jax"])
def test_examples_train_and_score_a_policy(small_release, example):
    pytest.importorskip("jax" if "jax" in example else "torch")
    command = [sys.executable, str(EXAMPLES / f"{example}.py"), str(small_release), "walker-walk/random/dynamic"]
    shown = subprocess.run([*command, "2", "5"], capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert shown.returncode == 0, shown.stderr
    assert "return " in shown.stdout and "over 2 episodes" in shown.stdout
