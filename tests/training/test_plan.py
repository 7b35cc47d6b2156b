"""Before its first step a run says what it will do; while it trains, the time that is left is a sane one."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest
import torch

from dmcvb_gen import progress
from dmcvb_gen.own_code import TASKS
from dmcvb_gen.training import behaviour
from dmcvb_gen.training.behaviour import plan_of, run_config
from dmcvb_gen.training.run import Run
from dmcvb_gen.training.settings import default_run

torch.set_num_threads(1)
SMALL = {"simulations": 4, "batch_size": 8, "actor_hidden": [8], "critic_hidden": [8]}


def lines_of(folder, task, algorithm="sac", done=0, **given):
    settings = SMALL if algorithm in ("sac", "mpo") else {}
    return plan_of(Run(folder, run_config(task, algorithm, settings, **given)), done)


@pytest.mark.parametrize(
    ("algorithm", "first"),
    [
        ("sac", "walker-walk, sac, float32: 120,000 agent steps, 5,000 of them random."),
        ("mpo", "walker-walk, mpo: 120,000 agent steps, 5,000 of them random."),
        ("sb3:TD3", "walker-walk, sb3:TD3: 120,000 agent steps, 100 of them random."),
    ],
)
def test_a_run_says_what_it_will_do(tmp_path, monkeypatch, algorithm, first):
    monkeypatch.setattr(behaviour, "PROBE_SECONDS", 0.05)
    said = lines_of(tmp_path / "run", "walker-walk", algorithm)
    assert said[0] == first
    assert re.fullmatch(r"About (\d+ min|[\d.]+ h) of one core, without evaluations \(.*\)\.", said[1])
    assert said[2] == "To expect: 935, as the package's own expert has after 33,000 agent steps."
    assert not (tmp_path / "run").exists() and max(map(len, said)) <= 80


def test_short_runs_are_not_tried_and_what_is_done_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(behaviour, "probe", lambda run: pytest.fail("tried"))
    said = lines_of(tmp_path, "acrobot-swingup", steps=9_000, done=6_000)
    assert said == ["acrobot-swingup, sac, float32: 9,000 agent steps, 6,000 of them done."]


def test_a_pause_says_nothing_of_the_time_left(tmp_path, monkeypatch):
    """Compiling the updates takes a minute, in which eight steps are made."""
    bars, clock = [], iter([0.0, 0.1, 70.0, 70.1, 70.2])

    class Recorded(progress.ProgressBar):
        def __init__(self, shown, **options):
            super().__init__(False, **options)
            self.disable, self.resumed, self.sp = False, [], lambda text: None
            bars.append(self)

        def unpause(self):
            self.resumed.append(self.n)

        def update(self, n=1):
            self.n += n

        def close(self):
            self.disable = True

    def train(report, tick, stopping):
        for _ in range(4):
            tick(8)

    run = SimpleNamespace(config=SimpleNamespace(steps=32, task="walker-walk"), train=train)
    monkeypatch.setattr(progress, "ProgressBar", Recorded)
    monkeypatch.setattr(behaviour, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    behaviour._train(run, 0, True, lambda line: None)
    assert bars[0].resumed == [8] and bars[0].n == 32


@pytest.mark.parametrize(("seconds", "warmup"), [(0.4, 1000), (5, 2500), (60, 5000)])
def test_own_tasks_of_short_episodes_are_learned_soon(tmp_path, monkeypatch, seconds, warmup):
    code = f"""
from dm_control import suite

def short():
    return suite.load("cartpole", "swingup", environment_kwargs={{}}, task_kwargs=dict(time_limit={seconds}))
"""
    name = f"short_{str(seconds).replace('.', '_')}"
    (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(TASKS, f"{name}:short")
    assert default_run(f"{name}:short")["settings"] == {"warmup_steps": warmup}
    assert default_run("hopper-hop")["settings"] == {}
