"""Measuring a policy: policy and task in, returns of fresh episodes out, all episodes in one batch of fixed size."""

from __future__ import annotations

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.behaviours.policies.actor import Policy
from dmcvb_gen.behaviours.policies.header import Evaluation
from dmcvb_gen.behaviours.policies.simulate import Simulation, simulate
from dmcvb_gen.tasks.base import ACTION_REPEAT, Task


def evaluate(
    policy: Policy, task: Task, episodes: int = 100, seed: int = 1, deterministic: bool = True, threads: int = 1
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
    success, speed = maze_scores(task, out)
    return (
        Evaluation(
            mean=float(returns.mean()),
            std=float(returns.std()),
            episodes=episodes,
            mode="mean" if deterministic else "sampled",
            seed=seed,
            quartiles=tuple(float(value) for value in np.quantile(returns, (0, 0.25, 0.5, 0.75, 1))),
            success=success,
            speed=speed,
        ),
        out,
    )


def maze_scores(task: Task, simulation: Simulation) -> tuple[float | None, float | None]:
    """Share of episodes that reached the goal, and their mean speed towards it.

    Speed is the straight distance to the goal at the start over the time it took, in m/s, as in the benchmarks;
    None where no episode got there, both None for a task without a goal.
    """
    part = task.state_slices.get("target_vector")
    if part is None:
        return None, None
    reached = simulation.terminated
    seconds = simulation.length * ACTION_REPEAT * task.control_timestep
    speed = arithmetic.norm(simulation.state[:, 0, part]) / seconds
    return float(reached.mean()), float(speed[reached].mean()) if reached.any() else None
