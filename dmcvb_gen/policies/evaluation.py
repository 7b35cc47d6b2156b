"""Measure a policy's returns on fresh episodes, all in one batch of fixed size."""

from __future__ import annotations

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.header import Evaluation
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.tasks.base import Task

FRESH = "selection"
"""Streams of the episodes that decide which checkpoint is picked: a training's evaluations see none of them."""


def evaluate(policy: Policy, task: Task, episodes: int = 100, seed: int = 1, streams: str = "evaluation") -> Evaluation:
    """Roll a policy out over fresh episodes (streams of their own, apart from every release's).

    Args:
      streams: name of the episodes' streams; `FRESH` has none of the episodes that trainings are evaluated on.

    Returns:
      Return statistics, and the episodes they come from.
    """
    out = simulate(task, [policy], range(episodes), seed, (task.id, streams))
    returns = out.returns
    success, speed = goal_scores(task, out.state[:, 0], out.length, out.terminated)
    return Evaluation(
        mean=float(returns.mean()),
        std=float(returns.std()),
        episodes=episodes,
        mode="mean",
        seed=seed,
        quartiles=tuple(np.quantile(returns, (0, 0.25, 0.5, 0.75, 1)).tolist()),
        success=success,
        speed=speed,
    )


def goal_scores(
    task: Task, start: np.ndarray, length: np.ndarray, reached: np.ndarray
) -> tuple[float | None, float | None]:
    """Share of episodes that reached the goal, and their mean speed towards it; None of a task without a goal.

    Args:
      start: (episode, state) of the first step.
      length: (episode,) agent steps. reached: (episode,) bool.

    Returns:
      The speed is of the straight line from the start to the goal, m/s; None if no episode reached it.
    """
    part = task.state_slices.get("target_vector")
    if part is None:
        return None, None
    speed = arithmetic.norm(start[:, part]) / (length * task.seconds_per_step)
    return float(reached.mean()), float(speed[reached].mean()) if reached.any() else None
