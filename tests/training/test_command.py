"""The behaviour commands: a policy's header says how to train it again; returns stand beside the paper's."""

import re
import shlex
from types import SimpleNamespace

import click
import numpy as np
import pytest
import torch

from dmcvb_gen.cli.behaviours import train_behaviour
from dmcvb_gen.own_code import TASKS
from dmcvb_gen.policies.archives import bundled_digests
from dmcvb_gen.policies.bundled import bundled_levels, bundled_policies
from dmcvb_gen.policies.evaluation import goal_scores
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import behaviour
from dmcvb_gen.training.behaviour import plan_of, run_config
from dmcvb_gen.training.run import Run, RunConfig, command_of
from dmcvb_gen.training.settings import default_run, parse_settings
from tests.conftest import invoke, run, told


@pytest.mark.parametrize("init_from", [None, "runs/my stand run"])
def test_the_command_of_a_run_parses_back_to_its_configuration(init_from):
    settings = {"learning_rate": 0.0005, "critic_hidden": [256, 256], "compile": False}
    config = RunConfig("humanoid-walk", "sac", 1000, 3, settings, evaluate_every=700, init_from=init_from)
    words = shlex.split(command_of(config))
    assert words[:2] == ["dmcvb-gen", "train-behaviour"]
    with click.Context(train_behaviour) as context:
        train_behaviour.parse_args(context, words[2:])
    given = context.params
    assert (given["task"], given["algo"], given["steps"], given["seed"]) == ("humanoid-walk", "sac", 1000, 3)
    assert (given["evaluate_every"], given["init_from"]) == (700, init_from)
    assert parse_settings(given["settings"], "sac") == settings


def test_speed_is_meters_a_second_of_the_ants_that_got_there():
    # An agent step lasts 0.05 s: 5 m in 100 steps are 1 m/s, 2 m in 80 steps 0.5 m/s; the third never arrives.
    task, length = get_task("ant-maze-empty7x7"), np.array([100, 80, 1200])
    start = np.zeros((3, task.state_size), np.float32)
    start[:, task.state_slices["target_vector"].start] = [5, 2, 9]
    assert goal_scores(task, start, length, np.array([True, True, False])) == pytest.approx((2 / 3, 0.75))
    assert goal_scores(task, start, length, np.zeros(3, bool)) == (0.0, None)
    assert goal_scores(get_task("walker-walk"), start, length, length) == (None, None)


@pytest.mark.full
def test_one_command_sets_every_bundled_level_beside_the_paper():
    rows = told("evaluate-behaviour", "--episodes", 2)
    tasks = {name.split("/")[0]: None for name in bundled_digests()}
    asked = [(task, level) for task in tasks for level in [*bundled_levels(task), "random"]]
    assert [(row["task"], row["level"]) for row in rows] == asked
    for row in rows:
        assert set(row["returns"]) == {"mean", "std", "min", "p25", "median", "p75", "max"}
        assert row["returns"]["min"] <= row["returns"]["median"] <= row["returns"]["max"]
        if not row["task"].startswith("ant"):
            assert row["paper"] == paper_returns(row["task"], row["level"])


@pytest.mark.slow
def test_a_policy_file_says_itself_which_task_and_level_it_is_for():
    (file,) = bundled_policies("walker-walk", "medium")
    (row,) = told("evaluate-behaviour", "--behaviour", file, "--episodes", 2)
    assert (row["task"], row["level"], row["mode"]) == ("walker-walk", "medium", "mean")
    short = ("--level", "medium", "--episodes", 2)
    folder = told("evaluate-behaviour", "walker-walk", "--behaviour", file.parent, *short)
    assert folder[0]["returns"] == row["returns"]
    both = told("evaluate-behaviour", "--behaviour", file, "--level", "random", *short)
    assert [one["level"] for one in both] == ["random", "medium"] and both[1]["returns"] == row["returns"]
    assert both[0]["returns"]["mean"] < row["returns"]["mean"] / 2
    table = run("evaluate-behaviour", "--behaviour", file, "--episodes", 2)
    assert "DMC-VB paper" in table and "mean actions" in table
    (drawn,) = told("evaluate-behaviour", "--behaviour", file, "--episodes", 2, "--sample")
    assert drawn["mode"] == "sampled" and drawn["returns"] != row["returns"]


POLICY = str(bundled_policies("walker-walk", "expert")[0])


MISTAKES = [
    ("walker-fly", "walker-walk"),
    ("walker-walk --algo dreamer", "Known: guided, mpo, sac, sb3:PPO, sb3:SAC, sb3:TD3."),
    ("walker-walk --set learning_rat=3", "Did you mean 'learning_rate'?"),
    ("walker-walk --algo sb3:PPO --set buffer_size=3", "clip_range"),
    ("walker-walk --algo sb3:SAC --set optimize_memory_usage=true", "unknown setting of sb3:SAC"),
    ("walker-walk --set foo=1", "more; --list-settings lists them all."),
    ("walker-walk --set speed", "key=value"),
    ("walker-walk --set discount=1.5", "setting discount of sac is 1.5: input should be less than 1"),
    ("walker-walk --algo sb3:ARS", "Known: A2C, CrossQ, DDPG, PPO, SAC, TD3, TQC, TRPO."),
    ("walker-walk --algo sb3:SAC --set ent_coef=abc", "sb3:SAC does not accept"),
    ("walker-walk --algo sb3:SAC --set use_sde=true", "error: sb3:SAC has noise that depends on the"),
    (f"walker-walk --algo sb3:SAC --init-from {POLICY}", "--init-from has no effect"),
    ("walker-walk --steps 0", "x>=1"),
    ("walker-walk --steps 100", "all warm-up (5000 steps)"),
    (f"walker-walk --steps 4000 --init-from {POLICY}", "or less warm-up: --set warmup_steps=N"),
    ("walker-walk --set low_spawn_fraction=0.1", "only for ant mazes; walker-walk has no use for it"),
    ("cheetah-run --set shaping=0.1", "setting shaping is only for humanoid-walk and ant mazes"),
    ("fish-swim --set standing_starts=0.1", "only for bodies that move freely"),
    ("walker-walk --algo guided", "for ant mazes"),
]


@pytest.mark.parametrize("words, told", MISTAKES)
def test_bad_commands_say_what_is_wrong(tmp_path, words, told):
    result = invoke("train-behaviour", *words.split(), "--out", tmp_path / "run", code=2)
    assert told in result.output and not (tmp_path / "run").exists()
    assert len(result.output.strip().splitlines()) == 1 or "Usage" in result.output


@pytest.mark.parametrize("words", ["PPO --steps 80", "SAC --steps 104"])
def test_a_run_that_ends_before_it_learns_says_so(tmp_path, words):
    result = invoke(
        "train-behaviour", "walker-walk", "--algo", *f"sb3:{words}".split(), "--out", tmp_path / "run", code=2
    )
    assert "learned nothing" in result.output and "learning_starts with --set" in result.output


# -- what a run says before its first step ----------------------------------------------------------

torch.set_num_threads(1)
SMALL = {"simulations": 4, "batch_size": 8, "actor_hidden": [8], "critic_hidden": [8]}


def lines_of(folder, task, algorithm="sac", done=0, **given):
    settings = {"sac": SMALL | {"bfloat16": False}, "mpo": SMALL}.get(algorithm, {})
    return plan_of(Run(folder, run_config(task, algorithm, settings, **given)), done)


@pytest.mark.parametrize("named, drawn", [("sac, float32", "5,000"), ("mpo", "5,000"), ("sb3:TD3", "100")])
def test_a_run_says_what_it_will_do(tmp_path, monkeypatch, named, drawn):
    monkeypatch.setattr(behaviour, "PROBE_SECONDS", 0.05)
    said = lines_of(tmp_path / "run", "walker-walk", named.split(",")[0])
    assert said[0] == f"walker-walk, {named}: 120,000 agent steps, {drawn} of them random."
    assert re.fullmatch(r"About (\d+ min|[\d.]+ h) of one core, without evaluations \(.*\)\.", said[1])
    assert said[2] == "To expect: 935, as the package's own expert has after 33,000 agent steps."
    assert not (tmp_path / "run").exists() and max(map(len, said)) <= 80


def test_short_runs_are_not_tried_and_what_is_done_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(behaviour, "probe", lambda run: pytest.fail("tried"))
    said = lines_of(tmp_path, "acrobot-swingup", steps=9_000, done=6_000)
    assert said == ["acrobot-swingup, sac, float32: 9,000 agent steps, 6,000 of them done."]


def test_a_pause_says_nothing_of_the_time_left(tmp_path, monkeypatch):
    """Compiling the updates takes a minute, in which eight steps are made; evaluations are part of the work."""
    resumed, clock = [], iter([0.0, 0.1, 70.0, 70.1, 100.0, 100.1])

    def train(report, tick, stopping):
        for _ in range(3):
            tick(8)
        report(SimpleNamespace(mean=1.0))
        tick(8)

    run = SimpleNamespace(config=SimpleNamespace(steps=32, task="walker-walk"), train=train)
    monkeypatch.setattr(ProgressBar, "unpause", lambda bar: resumed.append(bar.n))
    monkeypatch.setattr(behaviour, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    behaviour._train(run, 0, True, lambda line: None)
    assert resumed == [8]


def own_task(folder, module, seconds):
    """Write a task of one's own with short episodes, and give its name."""
    load = f'suite.load("cartpole", "swingup", task_kwargs=dict(time_limit={seconds}))'
    (folder / f"{module}.py").write_text(f"from dm_control import suite\n\ndef own():\n    return {load}\n")
    return f"{module}:own"


@pytest.mark.parametrize(("seconds", "warmup"), [(0.4, 1000), (5, 2500), (60, 5000)])
def test_own_tasks_of_short_episodes_are_learned_soon(tmp_path, monkeypatch, seconds, warmup):
    name = own_task(tmp_path, f"short_{str(seconds).replace('.', '_')}", seconds)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(TASKS, name)
    assert default_run(name)["settings"]["warmup_steps"] == warmup
    assert default_run("hopper-hop")["settings"].keys() == {"bfloat16"}
