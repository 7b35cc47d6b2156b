"""Picking checkpoints from curves whose answer is known."""

import inspect
import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

from dmcvb_gen.errors import StoreError
from dmcvb_gen.own_code import TASKS
from dmcvb_gen.policies.actor import RandomPolicy
from dmcvb_gen.policies.bundled import level_files
from dmcvb_gen.policies.evaluation import FRESH, evaluate
from dmcvb_gen.policies.header import Evaluation, PolicyHeader
from dmcvb_gen.policies.policy_file import read_header, save_policy
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import selection
from dmcvb_gen.training.networks import Actor, as_arrays
from dmcvb_gen.training.selection import MIXED_COUNT, converge, pick_checkpoints, read_curve, select_checkpoints
from tests.conftest import invoke, told
from tests.training.test_command import own_task

STEPS = np.arange(1, 101) * 1000


def rising(top=1000.0, at=40, base=0.0):
    """A line from base to top, then a plateau."""
    return base + (top - base) * np.minimum(np.arange(1, 101) / at, 1)


def select(returns, base=0.0, noise=0.0, fresh=None, task="", keep=lambda step: True):
    """Select from a synthetic curve; fresh episodes return the true value (or `fresh`)."""
    seen = returns + noise * np.random.default_rng(0).normal(size=len(returns))
    curve = [(int(STEPS[index]), float(value), Path(f"{index}")) for index, value in enumerate(seen)]
    truth = returns if fresh is None else fresh

    def measure(path):
        value = float(truth[int(path.name)])
        return Evaluation(mean=value, std=abs(noise), episodes=100, mode="mean", seed=0)

    end = converge([point[0] for point in curve], seen, base)
    return pick_checkpoints(task, [point for point in curve if keep(point[0])], base, end, measure)


@pytest.mark.parametrize("step", [0, 20_000])
def test_the_episodes_that_decide_are_none_that_a_training_was_evaluated_on(step):
    task = get_task("cartpole-swingup")
    policy = RandomPolicy(task)
    seen, fresh = (evaluate(policy, task, 2, step, streams=name) for name in ("evaluation", FRESH))
    assert seen.mean != fresh.mean
    assert inspect.signature(evaluate).parameters["streams"].default == "evaluation"  # a training's


LUCKY = np.concatenate([rising()[:20], np.full(5, 1000.0), rising()[25:]])
STAIRS = np.concatenate([np.full(40, 300.0), np.linspace(300, 1000, 20), np.full(40, 1000.0)])
COLLAPSE = np.concatenate([rising()[:40], np.full(35, 1000.0), np.linspace(1000, 50, 25)])


CURVES = {
    "plain": (dict(returns=rising()), 1000, 38_000, 38_000),
    "noise": (dict(returns=rising(), noise=30.0), 1000, 37_000, 44_000),
    "luck": (dict(returns=LUCKY, fresh=rising()), 1000, 38_000, 38_000),  # twenty lucky episodes; fresh ones say half
    "stairs": (dict(returns=STAIRS), 1000, 58_000, 60_000),  # a plateau before the top is no convergence of the whole
    "collapse": (dict(returns=COLLAPSE), 1000, 38_000, 38_000),
    "costs": (dict(returns=rising(top=-50.0, base=-450.0), base=-450.0), -50, 38_000, 38_000),
    "two evaluations": (dict(returns=np.array([10.0, 300.0])), 300, 2000, 2000),
}


@pytest.mark.parametrize("curve", CURVES)
def test_expert_is_the_first_at_95_percent_of_the_way_and_medium_lies_at_half(curve):
    given, end, first, last = CURVES[curve]
    found, base = select(**given), given.get("base", 0.0)
    assert found.convergence.converged and found.convergence.value == pytest.approx(end, abs=0.02 * (end - base))
    [expert] = found.picks["expert"]
    assert first <= expert.step <= last
    assert expert.evaluation.mean - base >= 0.95 * (found.convergence.value - base)
    if len(given["returns"]) > 2:
        assert (found.picks["medium"][0].evaluation.mean - base) / (end - base) == pytest.approx(0.5, abs=0.1)


UNPICKED = [
    (np.linspace(10, 1000, 100), "expert", "still rises"),
    (rising()[:1], "expert", "1 evaluation, at least 2 are needed"),
    (np.full(100, -3.0), "medium", "never rose"),
    (np.repeat([20.0, 1000.0], [30, 70]), "mixed", "evaluate more often"),  # jumps over the half
]


@pytest.mark.parametrize("returns, level, words", UNPICKED)
def test_what_cannot_be_picked_says_why(returns, level, words):
    found = select(returns)
    assert words in found.reasons[level] and level not in found.picks


def test_mixed_is_even_in_training_steps_not_in_return():
    """A curve that stays on the floor for three quarters of the way to medium."""
    returns = np.concatenate([np.full(30, 10.0), np.linspace(10, 1000, 20), np.full(50, 1000.0)])
    found = select(returns)
    medium = found.picks["medium"][0]
    assert medium.step == pytest.approx(40_000, abs=1000)
    steps = [pick.step for pick in found.picks["mixed"]]
    np.testing.assert_allclose(steps, np.linspace(0, medium.step, MIXED_COUNT), atol=1000)
    assert found.picks["mixed"][-1].path == medium.path
    assert sum(pick.evaluation.mean < 20 for pick in found.picks["mixed"]) == 6


FEW = [
    ([10.0, 300.0], 300.0, 290.0, True, "300.0 +- 290.0 (converged: from 2 evaluations, so a longer run may end"),
    ([0.0, 100.0, 200.0, 210.0, 205.0], 205.0, 155.0, True, "from 5 evaluations"),
    ([-9.0, -8.0, -8.0], -8.0, 1.0, False, "never rose"),
    ([5.0], 5.0, None, False, "5.0 (not converged: 1 evaluation, at least 2 are needed)"),
]


@pytest.mark.parametrize("returns, value, error, converged, words", FEW)
def test_a_few_evaluations_are_enough_and_say_how_sure_they_are(returns, value, error, converged, words):
    end = converge(list(range(len(returns))), returns)
    assert (end.value, end.converged) == (value, converged) and words in end.standing
    assert end.error == error or (error is None and np.isnan(end.error))


def test_mixed_are_eight_different_checkpoints_or_say_which_is_missing():
    steps = [pick.step for pick in select(rising(), keep=lambda step: step % 2000 == 0).picks["mixed"]]
    assert steps == [2000, 4000, 6000, 8000, 12_000, 14_000, 18_000, 20_000]  # nearest to 0 and to 2857 is one
    found = select(rising(), keep=lambda step: not 4000 < step < 15_000)
    assert "near step 8571 (number 4 of 8)" in found.reasons["mixed"] and "medium" in found.picks
    seven = (1000, 3000, 6000, 9000, 11_000, 14_000, 20_000)
    found = select(rising(), keep=lambda step: step in seven or step > 30_000)
    assert "near step 17143 (number 7 of 8)" in found.reasons["mixed"]


def test_a_maze_medium_is_nearest_to_the_papers_row_and_there_is_no_mixed():
    returns = rising(top=-50.0, base=-450.0)
    for task, goal in (
        ("ant-maze-empty7x7", -172.2),
        ("ant-maze-easy7x7b", -131.1),
        ("ant-maze-medium7x7c", -176.0),
        ("ant-maze-medium:***/*.*/***", -250),  # the user's own has no row: half of the way
    ):
        found = select(returns, base=-450.0, task=task)
        assert set(found.picks) == {"expert", "medium"} and not found.reasons
        assert found.picks["medium"][0].evaluation.mean == pytest.approx(goal, abs=10)
        assert -50 / 0.95 <= found.picks["expert"][0].evaluation.mean <= -50  # 95 % of the way would be -70
    found = select(returns, base=-450.0, task="ant-maze-medium7x7a", keep=lambda step: step > 33_000)
    assert "-176.0 +- 35.2" in found.reasons["medium"]


@pytest.fixture
def run_folder(tmp_path):
    """A run of cheetah-run whose checkpoints are random networks, with a made-up learning curve."""
    sizes = {"observation_size": 17, "action_size": 6, "hidden": (4,)}
    header = PolicyHeader(task="cheetah-run", algorithm="sac", agent_step=0, **sizes)
    for index, value in enumerate(rising(top=6.0, at=20), 1):
        evaluation = Evaluation(mean=float(value), std=1.0, episodes=20, mode="mean", seed=0)
        torch.manual_seed(index)
        save_policy(
            tmp_path / "checkpoints" / f"{index * 1000:010d}.safetensors",
            header.model_copy(update=dict(agent_step=index * 1000, evaluation=evaluation)),
            as_arrays(Actor(header).state_dict()),
        )
    return tmp_path


def test_a_run_folder_is_judged_by_fresh_episodes_and_says_what_is_missing(run_folder):
    found = told("select-checkpoints", run_folder, "--episodes", 3)
    assert found["convergence"]["converged"] and found["convergence"]["value"] == pytest.approx(6)
    assert all(pick["evaluation"]["mode"] == "mean" for level in found["levels"].values() for pick in level["picks"])
    assert json.loads((run_folder / "selection.json").read_text()) == found
    assert (run_folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    for level, entry in found["levels"].items():
        files = level_files(run_folder / "selected", level)
        assert bool(entry["picks"]) == bool(files) != bool(entry["reason"])
        for path, pick in zip(files, entry["picks"], strict=True):
            header = read_header(path)
            assert header.level == level and header.evaluation.episodes == 3
            assert header.agent_step == pick["step"] and header.evaluation.mean == pick["evaluation"]["mean"]
            value = round(found["convergence"]["value"], 2)
            assert header.training["selection"] == {"target": pick["target"], "convergence": value}
            steps, returns, _ = zip(*read_curve(run_folder), strict=True)
            curve = {"steps": list(steps), "returns": [round(value, 2) for value in returns]}
            assert header.training["curve"] == curve
    longer = invoke("select-checkpoints", run_folder, "--episodes", 3, "--convergence", 900, "--json", code=1).stdout
    given = {"value": 900.0, "error": None, "converged": True, "reason": "as was given"}
    assert json.loads(longer)["convergence"] == given


def test_a_run_that_still_rises_is_judged_by_the_papers_convergence(run_folder):
    for path in sorted((run_folder / "checkpoints").iterdir())[18:]:
        path.unlink()
    found = json.loads(invoke("select-checkpoints", run_folder, "--episodes", 3, "--json", code=1).stdout)
    assert found["convergence"]["value"] == pytest.approx(890.49 / 0.95, abs=0.1)
    assert found["convergence"]["reason"].startswith("in the paper's run; here the return still rises (from ")
    assert "of 0 candidates held 890.5" in found["levels"]["expert"]["reason"]


def test_a_folder_that_cannot_be_written_to_is_one_line(run_folder, monkeypatch):
    monkeypatch.setattr(selection, "MEDIUM_SHARE", 2.0)  # no medium, so little is measured
    (run_folder / "curve.png").mkdir()
    with pytest.raises(StoreError, match=r"cannot write to .*curve\.png: "):
        select_checkpoints(run_folder, episodes=2)


@pytest.mark.slow
def test_the_command_after_the_training_of_an_own_task_can_be_run_as_it_is(tmp_path, monkeypatch):
    task = own_task(tmp_path, "briefly", 0.2)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(TASKS, "")  # its code is not allowed to run yet
    cut = {"warmup_steps": 10, "simulations": 2, "batch_size": 4, "compile": False, "bfloat16": False}
    words = [word for name, value in cut.items() for word in ("--set", f"{name}={value}")]
    trained = invoke("train-behaviour", task, "--steps", 12, "--out", "run", *words, code=0)
    [line] = [line for line in trained.output.splitlines() if line.startswith("Next: ")]
    leave, program, *arguments = shlex.split(line.removeprefix("Next: "))
    assert (leave, program) == (f"{TASKS}={task}", "dmcvb-gen")
    get_task.cache_clear()  # as in a new process
    monkeypatch.setenv(TASKS, leave.removeprefix(f"{TASKS}="))
    selected = invoke(*arguments, "--episodes", 2, code=1)
    assert "at least 2 are needed" in " ".join(selected.output.split()), selected.output
