"""Measuring a policy: policy and task in, returns of fresh episodes out, all episodes in one batch of fixed size."""

from __future__ import annotations

import numpy as np

from dmcvb_gen.behaviours.policy_file import Evaluation, Policy
from dmcvb_gen.behaviours.simulate import Simulation, simulate
from dmcvb_gen.tasks.base import Task


def evaluate(
    policy: Policy, task: Task, episodes: int = 100, seed: int = 1, deterministic: bool = False, threads: int = 1
) -> tuple[Evaluation, Simulation]:
    """Roll a policy out over fresh episodes (streams of their own, apart from every release's).

    Returns:
      Return statistics, and the episodes they come from.
    """
    out = simulate(
        task,
        [policy],
        range(episodes),
        seed,
        (task.id, "evaluation"),
        deterministic=deterministic,
        threads=threads,
    )
    returns = out.returns
    success = speed = None
    if task.id.startswith("ant-maze"):
        success = float(out.terminated.mean())
    return (
        Evaluation(
            mean=float(returns.mean()),
            std=float(returns.std()),
            episodes=episodes,
            mode="deterministic" if deterministic else "sampled",
            seed=seed,
            quartiles=tuple(float(value) for value in np.quantile(returns, (0, 0.25, 0.5, 0.75, 1))),
            success=success,
            speed=speed,
        ),
        out,
    )
