"""Wall-clock until 90 % of the paper's expert return on walker-walk: ours against plain SB3 SAC, in the same run.

    python scripts/bench_training.py --limit 3600
    python scripts/bench_training.py --limit 3600 --peer-times 4          # stop the peer after four times ours
    python scripts/bench_training.py --recipes sac sb3-sac tqc --limit 900  # which --algo is soonest at 95 %?
    python scripts/bench_training.py --precisions                           # updates a second in float32 and bfloat16
    python scripts/bench_training.py --limit 3 --every 400 --episodes 2     # does it run?

The peer is Stable-Baselines3's SAC with its own settings on one dm_control environment at action repeat 2. One
thread each, one after the other. Both are evaluated on 20 fresh episodes with sampled actions every 2,000 steps;
evaluations are not counted, compilation is. A side that does not get there within the limit is reported as such.
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
from dmcvb_gen.precision import choose_precision, dense_product
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import runs
from dmcvb_gen.training.defaults import default_run
from dmcvb_gen.training.runs import RunConfig
from dmcvb_gen.training.sac import Sac, SacSettings
from dmcvb_gen.training.training import open_run
from dmcvb_gen.training.vec_env import TaskVecEnv

TASK = "walker-walk"
UPDATES = 300
"""Timed in each precision."""


class SuiteEnv(gymnasium.Env):
    """dm_control's own walker, one agent step two control steps."""

    def __init__(self, seed: int):
        from dm_control import suite

        self.suite = suite.load(*TASK.split("-"), task_kwargs={"random": seed})
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
    """Evaluates every `every` steps and stops at the goal or the limit; its clock stands still meanwhile."""

    def __init__(self, goal: float, limit: float, every: int, episodes: int):
        super().__init__()
        self.goal, self.limit, self.spent, self.reached = goal, limit, 0.0, False
        self.every, self.episodes = every, episodes

    def _on_training_start(self) -> None:
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every:
            return True
        self.spent += time.perf_counter() - self.started
        env, total = TaskVecEnv(get_task(TASK), self.episodes, seed=1_000), 0.0
        observation = env.reset()
        for _ in range(env.task.max_steps):
            observation, reward, _, _ = env.step(self.model.predict(observation, deterministic=False)[0])
            total += reward.mean()
        print(f"  sb3   {self.num_timesteps:>8,} steps  {self.spent:7.0f} s  return {total:.0f}", flush=True)
        self.reached = total >= self.goal
        self.started = time.perf_counter()
        return not self.reached and self.spent < self.limit


class Enough(Exception):
    """Ours got there, or ran out of time."""


def ours(
    goal: float, limit: float, seed: int, every: int, episodes: int, algorithm: str = "sac"
) -> tuple[float, bool, int]:
    """Training seconds, whether the goal was reached, and agent steps."""
    last, name = [], "ours" if algorithm == "sac" else algorithm

    def report(progress):
        last[:] = [progress.seconds, progress.evaluation.mean >= goal, progress.step]
        print(
            f"  {name:7} {progress.step:>8,} steps  {last[0]:7.0f} s  return {progress.evaluation.mean:.0f}", flush=True
        )
        if last[1] or last[0] >= limit:
            raise Enough

    with tempfile.TemporaryDirectory() as folder:
        runs.EVALUATION_EPISODES = episodes
        settings = default_run(TASK, algorithm)["settings"]
        config = RunConfig(TASK, algorithm, 2_000_000, seed, settings, evaluate_every=every, evaluate_sparse=every)
        try:
            open_run(Path(folder) / "run", config, resume=False).train(report)
        except Enough:
            pass
    return last[0], last[1], last[2]


def precisions() -> None:
    """Updates a second of SAC's critics and actor in both precisions, and which one `--precision auto` takes here."""
    header = PolicyHeader(task=TASK, observation_size=24, action_size=6, algorithm="sac", agent_step=0, hidden=(256,))
    settings, rates = SacSettings(**default_run(TASK, "sac")["settings"]), {}
    batch = {
        "observation": torch.randn(settings.batch_size, 24),
        "next_observation": torch.randn(settings.batch_size, 24),
    }
    batch |= {"action": torch.rand(settings.batch_size, 6), "reward": torch.rand(settings.batch_size)}
    batch |= {"terminated": torch.zeros(settings.batch_size)}
    for half in (False, True):
        sac = Sac(header, replace(settings, bfloat16=half), 0)
        for _ in range(20):  # compiled, and warm
            sac.update(batch)
        started = time.perf_counter()
        for _ in range(UPDATES):
            sac.update(batch)
        rates["bfloat16" if half else "float32"] = UPDATES / (time.perf_counter() - started)
    auto = choose_precision("auto", dense_product(settings.critic_hidden[-1], settings.batch_size))
    shown = ", ".join(f"{name} {rate:.1f}" for name, rate in rates.items())
    print(f"updates a second: {shown}; auto takes {auto}, {rates[auto] / max(rates.values()):.2f} of the faster one")


def compare(arguments: argparse.Namespace) -> None:
    """Seconds of each algorithm, with its default settings, until 95 % of the paper's expert return."""
    goal = 0.95 * paper_returns(TASK, "expert")["mean"]
    print(f"{TASK}: seconds of training to a return of {goal:.0f}, one thread")
    sizes = arguments.limit, arguments.seed, arguments.every, arguments.episodes
    results = {algorithm: ours(goal, *sizes, algorithm) for algorithm in arguments.recipes}
    for algorithm, (seconds, reached, steps) in results.items():
        print(f"{algorithm}: {seconds:.0f} s, {steps:,} agent steps" + ("" if reached else " (not reached)"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limit", type=float, default=3600.0, help="training seconds a side")
    parser.add_argument("--peer-times", type=float, help="stop the peer after so many times our seconds")
    parser.add_argument("--every", type=int, default=2_000, help="agent steps between evaluations")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of an evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--recipes", nargs="+", help="compare these of train-behaviour's algorithms, to 95 %%, instead")
    parser.add_argument("--precisions", action="store_true", help="time updates in both precisions instead")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.precisions:
        return precisions()
    if arguments.recipes:
        return compare(arguments)
    goal = 0.9 * paper_returns(TASK, "expert")["mean"]
    print(f"{TASK}: seconds of training to a return of {goal:.0f}, one thread")
    mine, reached, _ = ours(goal, arguments.limit, arguments.seed, arguments.every, arguments.episodes)
    limit = min(arguments.limit, mine * (arguments.peer_times or np.inf))
    callback = UntilReturn(goal, limit, arguments.every, arguments.episodes)
    SAC("MlpPolicy", SuiteEnv(arguments.seed), seed=arguments.seed, device="cpu").learn(2_000_000, callback=callback)
    for name, seconds, done in (("ours", mine, reached), ("SB3 SAC", callback.spent, callback.reached)):
        print(f"{name}: {seconds:.0f} s" + ("" if done else " (not reached)"))
    if reached:
        print(f"ratio: {'' if callback.reached else 'more than '}{callback.spent / mine:.1f}")


if __name__ == "__main__":
    main()
