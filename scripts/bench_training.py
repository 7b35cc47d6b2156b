"""Wall-clock until 90 % of the paper's expert return: ours against plain SB3 SAC, in the same run.

    python scripts/bench_training.py --limit 3600
    python scripts/bench_training.py --task cheetah-run --limit 7200
    python scripts/bench_training.py --limit 3600 --peer-times 4          # stop the peer after four times ours
    python scripts/bench_training.py --recipes sac sb3-sac tqc --limit 900  # which --algo is soonest at 95 %?
    python scripts/bench_training.py --precisions                           # updates a second in float32 and bfloat16
    python scripts/bench_training.py --limit 3 --every 400 --episodes 2     # does it run?

The peer is Stable-Baselines3's SAC with its own settings on one dm_control environment at action repeat 2. One
thread each, one after the other. Both are evaluated on 20 fresh episodes with sampled actions every 2,000 steps;
evaluations are not counted, compilation is. A side that does not get there within the limit is reported as such.
The last table says how much sooner ours has each return on the way that the peer reaches at all.
Measure on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import runs
from dmcvb_gen.training.defaults import default_run
from dmcvb_gen.training.runs import RunConfig
from dmcvb_gen.training.sac import Sac, SacSettings, precision_setting
from dmcvb_gen.training.training import open_run
from dmcvb_gen.training.vec_env import TaskVecEnv

SHARES = (0.1, 0.25, 0.5, 0.75, 0.9)
"""Shares of the paper's expert return at which the two times are compared."""

Curve = list[tuple[float, float]]
"""(seconds of training, return) of each evaluation."""


class SuiteEnv(gymnasium.Env):
    """dm_control's own environment of a task, one agent step two control steps."""

    def __init__(self, task: str, seed: int):
        from dm_control import suite

        self.suite = suite.load(*task.split("-"), task_kwargs={"random": seed})
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self.suite.action_spec().shape, np.float32)
        size = sum(int(np.prod(spec.shape)) for spec in self.suite.observation_spec().values())
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def _flat(self, step) -> np.ndarray:
        return np.concatenate([np.ravel(part) for part in step.observation.values()]).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._flat(self.suite.reset()), {}

    def step(self, action):
        reward = 0.0
        for _ in range(2):
            step = self.suite.step(action)
            reward += step.reward
            if step.last():
                break
        return self._flat(step), reward, False, step.last(), {}


class UntilReturn(BaseCallback):
    """Evaluates every `every` steps and stops at the goal or the limit; its clock stands still meanwhile.

    Attributes:
      curve: (seconds, return) of each evaluation.
    """

    def __init__(self, task: str, goal: float, limit: float, every: int, episodes: int):
        super().__init__()
        self.task, self.goal, self.limit, self.spent, self.reached = task, goal, limit, 0.0, False
        self.every, self.episodes = every, episodes
        self.curve: Curve = []

    def _on_training_start(self) -> None:
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every:
            return True
        self.spent += time.perf_counter() - self.started
        env, total = TaskVecEnv(get_task(self.task), self.episodes, seed=1_000), 0.0
        observation = env.reset()
        for _ in range(env.task.max_steps):
            observation, reward, _, _ = env.step(self.model.predict(observation, deterministic=False)[0])
            total += reward.mean()
        print(f"  sb3   {self.num_timesteps:>8,} steps  {self.spent:7.0f} s  return {total:.0f}", flush=True)
        self.curve.append((self.spent, float(total)))
        self.reached = total >= self.goal
        self.started = time.perf_counter()
        return not self.reached and self.spent < self.limit


class Enough(Exception):
    """Ours got there, or ran out of time."""


def ours(
    task: str, goal: float, limit: float, seed: int, every: int, episodes: int, algorithm: str = "sac"
) -> tuple[Curve, bool, int]:
    """The curve, True if the goal was reached, and agent steps."""
    curve: Curve = []
    last, name = [], "ours" if algorithm == "sac" else algorithm

    def report(progress):
        seconds, mean = progress.seconds, progress.evaluation.mean
        curve.append((seconds, mean))
        last[:] = [mean >= goal, progress.step]
        print(f"  {name:7} {progress.step:>8,} steps  {seconds:7.0f} s  return {mean:.0f}", flush=True)
        if last[0] or seconds >= limit:
            raise Enough

    with tempfile.TemporaryDirectory() as folder:
        runs.EVALUATION_EPISODES = episodes
        settings = default_run(task, algorithm)["settings"]
        if algorithm == "sac":
            settings |= precision_setting(settings)
        config = RunConfig(task, algorithm, 2_000_000, seed, settings, evaluate_every=every, evaluate_sparse=every)
        try:
            open_run(Path(folder) / "run", config, resume=False).train(report)
        except Enough:
            pass
    return curve, last[0], last[1]


def print_pace(mine: Curve, peer: Curve, expert: float) -> None:
    """How many times as long the peer takes to the same returns; the peer's last time if it never gets there."""

    def first(curve: Curve, wanted: float) -> float | None:
        return next((seconds for seconds, mean in curve if mean >= wanted), None)

    print("return   ours, s   SB3, s   ratio")
    for share in SHARES:
        wanted, ours_at = share * expert, first(mine, share * expert)
        if ours_at is None:
            break
        peer_at = first(peer, wanted)
        seconds, sign = (peer_at, "") if peer_at is not None else (peer[-1][0], "> ")
        print(f"{wanted:6.0f} {ours_at:9.0f} {sign + f'{seconds:.0f}':>8} {sign + f'{seconds / ours_at:.1f}':>7}")


def precisions(task: str, updates: int) -> None:
    """Updates a second of SAC's critics and actor in both precisions, and which one `--precision auto` takes here."""
    found = get_task(task)
    sizes = {"observation_size": found.state_size, "action_size": found.action_size}
    chosen, rates = default_run(task, "sac")["settings"], {}
    settings = SacSettings(**chosen)
    header = PolicyHeader(task=task, algorithm="sac", agent_step=0, hidden=settings.actor_hidden, **sizes)
    rows = settings.batch_size
    batch = {name: torch.randn(rows, sizes["observation_size"]) for name in ("observation", "next_observation")}
    batch |= {"action": torch.rand(rows, found.action_size), "reward": torch.rand(rows)}
    batch |= {"discount": torch.full((rows,), settings.discount)}
    for half in (False, True):
        sac = Sac(header, replace(settings, bfloat16=half), 0)
        for _ in range(5):  # compiled, and warm
            sac.update(batch)
        started = time.perf_counter()
        for _ in range(updates):
            sac.update(batch)
        rates["bfloat16" if half else "float32"] = updates / (time.perf_counter() - started)
    auto = "bfloat16" if precision_setting(chosen)["bfloat16"] else "float32"
    shown = ", ".join(f"{name} {rate:.1f}" for name, rate in rates.items())
    print(f"updates a second: {shown}; auto takes {auto}, {rates[auto] / max(rates.values()):.2f} of the faster one")


def compare(arguments: argparse.Namespace) -> None:
    """Seconds of each algorithm, with its default settings, until 95 % of the paper's expert return."""
    goal = 0.95 * paper_returns(arguments.task, "expert")["mean"]
    print(f"{arguments.task}: seconds of training to a return of {goal:.0f}, one thread")
    sizes = arguments.limit, arguments.seed, arguments.every, arguments.episodes
    results = {algorithm: ours(arguments.task, goal, *sizes, algorithm) for algorithm in arguments.recipes}
    for algorithm, (curve, reached, steps) in results.items():
        print(f"{algorithm}: {curve[-1][0]:.0f} s, {steps:,} agent steps" + ("" if reached else " (not reached)"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="walker-walk", choices=["walker-walk", "cheetah-run", "humanoid-walk"])
    parser.add_argument("--limit", type=float, default=3600.0, help="training seconds a side")
    parser.add_argument("--peer-times", type=float, help="stop the peer after so many times our seconds")
    parser.add_argument("--every", type=int, default=2_000, help="agent steps between evaluations")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of an evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--recipes", nargs="+", help="compare these of train-behaviour's algorithms, to 95 %%, instead")
    parser.add_argument("--precisions", action="store_true", help="time updates in both precisions instead")
    parser.add_argument("--updates", type=int, default=300, help="updates timed in each precision")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.precisions:
        return precisions(arguments.task, arguments.updates)
    if arguments.recipes:
        return compare(arguments)
    task, expert = arguments.task, paper_returns(arguments.task, "expert")["mean"]
    goal, sizes = 0.9 * expert, (arguments.every, arguments.episodes)
    print(f"{task}: seconds of training to a return of {goal:.0f}, one thread")
    curve, reached, _ = ours(task, goal, arguments.limit, arguments.seed, *sizes)
    mine = curve[-1][0]
    limit = min(arguments.limit, mine * (arguments.peer_times or np.inf))
    callback = UntilReturn(task, goal, limit, *sizes)
    peer = SAC("MlpPolicy", SuiteEnv(task, arguments.seed), seed=arguments.seed, device="cpu")
    peer.learn(2_000_000, callback=callback)
    for name, seconds, done in (("ours", mine, reached), ("SB3 SAC", callback.spent, callback.reached)):
        print(f"{name}: {seconds:.0f} s" + ("" if done else " (not reached)"))
    if reached:
        print(f"ratio: {'' if callback.reached else 'more than '}{callback.spent / mine:.1f}")
    print_pace(curve, callback.curve, expert)


if __name__ == "__main__":
    main()
