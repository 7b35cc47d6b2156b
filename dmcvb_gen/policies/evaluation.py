"""Measure a policy's returns on fresh episodes, all in one batch of fixed size."""

from __future__ import annotations

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.header import Evaluation
from dmcvb_gen.policies.simulate import Simulation, simulate
from dmcvb_gen.tasks.base import Task

FRESH = "selection"
"""Streams of the episodes that decide which checkpoint is picked: a training's evaluations see none of them."""


def evaluate(
    policy: Policy,
    task: Task,
    episodes: int = 100,
    seed: int = 1,
    deterministic: bool = True,
    threads: int = 1,
    streams: str = "evaluation",
) -> tuple[Evaluation, Simulation]:
    """Roll a policy out over fresh episodes (streams of their own, apart from every release's).

    Args:
      streams: name of the episodes' streams; `FRESH` has none of the episodes that trainings are evaluated on.

    Returns:
      Return statistics, and the episodes they come from.
    """
    out = simulate(
        task, [policy], range(episodes), seed, (task.id, streams), deterministic=deterministic, threads=threads
    )
    returns = out.returns
    lowest, lower, middle, upper, highest = map(float, np.quantile(returns, (0, 0.25, 0.5, 0.75, 1)))
    success, speed = maze_scores(task, out)
    return (
        Evaluation(
            mean=float(returns.mean()),
            std=float(returns.std()),
            episodes=episodes,
            mode="mean" if deterministic else "sampled",
            seed=seed,
            quartiles=(lowest, lower, middle, upper, highest),
            success=success,
            speed=speed,
        ),
        out,
    )


def goal_speed(distance: np.ndarray, length: np.ndarray, reached: np.ndarray, task: Task) -> float | None:
    """Mean speed towards the goal of the episodes that reached it, m/s; None if none did.

    Args:
      distance: (episode,) to the goal at the start in a straight line, meters.
      length: (episode,) agent steps. reached: (episode,) bool.
    """
    seconds = length * task.seconds_per_step
    return float((distance / seconds)[reached].mean()) if reached.any() else None


def maze_scores(task: Task, simulation: Simulation) -> tuple[float | None, float | None]:
    """Share of episodes that reached the goal, and their speed (`goal_speed`); None of a task without a goal."""
    part = task.state_slices.get("target_vector")
    if part is None:
        return None, None
    reached = simulation.terminated
    distance = arithmetic.norm(simulation.state[:, 0, part])
    return float(reached.mean()), goal_speed(distance, simulation.length, reached, task)
