"""Training episodes side by side, with their restarts and the state that resumes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch

from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.spec import is_maze
from dmcvb_gen.tasks.ant_maze.task import SPAWN_NOISE
from dmcvb_gen.tasks.base import StepResult, Task
from dmcvb_gen.training.runs import Run

HURRY = 0.1
"""Cost of a step in a maze, as the reward is 0 in the whole goal cell; lying on the back costs 1 more."""


HINTED = "humanoid-walk"
"""The task that a hint helps, besides mazes."""


def shaping_of(task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """(n, state) -> (n,): a hint that a learner may be given; humanoid-walk and mazes have one.

    Humanoid-walk's reward is zero on the floor; the hint, in [0, 1], is how high and upright it is. It is full once the
    humanoid stands, so it does not change which gait is best. An ant on its back never gets up again; the hint, in
    [-1.1, -0.1], is how far it has tipped over, and that time passes.
    """
    slices = task.state_slices
    if task.id == HINTED:
        height, vertical = slices["head_height"].start, slices["torso_vertical"].start + 2
        return lambda state: np.clip(state[:, height] / 1.4, 0, 1) ** 2 * (1 + state[:, vertical]) / 2
    if is_maze(task.id):
        upright = slices["world_zaxis"].start + 2
        return lambda state: (state[:, upright] - 1) / 2 - HURRY
    raise AssertionError(f"no hint for {task.id}")


def standing_states(task: Task, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, physics) float64: the model's own pose with a little noise on every joint, at rest."""
    data = mujoco.MjData(task.model)
    rows = np.empty((count, task.physics_size))
    for row in rows:
        mujoco.mj_resetData(task.model, data)
        data.qpos[7:] += rng.normal(0, 0.05, task.model.nq - 7)
        data.qvel[:] = rng.normal(0, 0.05, task.model.nv)
        mujoco.mj_getState(task.model, data, row, task.physics_spec)
    return rows


def _stands(task: Task) -> bool:
    """Return True if a model's pose is a place and a posture, and the model stays the same in all episodes."""
    free = task.model.njnt > 0 and task.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    return bool(free and not task.model_entries)


def useless_setting(task: Task, settings: Any) -> str | None:
    """Say which setting has no meaning for a task, and the cure; None if all have one."""
    maze = is_maze(task.id)
    fits = {
        "progress": (maze, "only for ant mazes"),
        "sunken_starts": (maze, "only for ant mazes"),
        "shaping": (maze or task.id == HINTED, f"only for {HINTED} and ant mazes"),
        "standing_starts": (not maze and _stands(task), "only for bodies that move freely, such as humanoid's"),
    }
    for name, (fit, what) in fits.items():
        if getattr(settings, name, 0) and not fit:
            return f"setting {name} is {what}; {task.id} has no use for it, so remove it"
    return None


class Episodes:
    """Training episodes side by side, restarted when they end; all of their state can be saved.

    Args:
      rng: draws which episodes start standing.
    """

    def __init__(self, run: Run, rng: np.random.Generator):
        self._run, self._rng, self._task = run, rng, run.task
        settings = run.settings
        self.size, self._limit = settings.simulations, settings.train_episode_steps or run.task.max_steps
        self.batch = run.task.batch(self.size)
        if getattr(settings, "progress", 0):
            self.batch.track_paths()
        # The first episodes are cut short at different steps, so that ends do not fall together.
        self.elapsed = (np.arange(self.size) * self._limit) // self.size

    def start(self, ids: np.ndarray) -> np.ndarray:
        """Begin new episodes; (size, observation) of all, what policies see."""
        run = self._run
        numbers = run.step * self.size + ids  # never the same stream twice in a run
        names = (self._task.id, "training")
        self.batch.reset([episode_stream(run.config.seed, names, int(i), "initial_state") for i in numbers], ids)
        standing = ids[self._rng.random(len(ids)) < getattr(run.settings, "standing_starts", 0.0)]
        if len(standing):
            self.batch.set_physics(standing_states(self._task, self._rng, len(standing)), standing)
        sunken = ids[self._rng.random(len(ids)) < getattr(run.settings, "sunken_starts", 0.0)]
        if len(sunken):
            self.batch.sink(sunken, self._rng.uniform(-SPAWN_NOISE, -SPAWN_NOISE / 2, len(sunken)))
        return self.batch.behaviour_observation()

    def ending(self, result: StepResult) -> np.ndarray:
        """(size,) bool: which episodes the task, or the limit, ends with the step just made."""
        return result.terminated | result.truncated | (self.elapsed + 1 >= self._limit)

    def restart_ended(self, observation: np.ndarray, result: StepResult) -> np.ndarray:
        """Count a step; begin anew if the task, or the limit, ended an episode."""
        ended = np.flatnonzero(self.ending(result))
        self.elapsed += 1
        if len(ended):
            observation = self.start(ended)
            self.elapsed[ended] = 0
        return observation

    def saved(self, observation: np.ndarray) -> dict[str, torch.Tensor]:
        """State of the episodes; with observations, because touch sensors do not follow from the physics."""
        parts = {"physics": self.batch.physics(), "elapsed": self.elapsed, "observation": observation}
        return {name: torch.from_numpy(part.copy()) for name, part in parts.items()}

    def restore(self, saved: dict[str, torch.Tensor]) -> np.ndarray:
        """Restore the saved episodes; return what policies see."""
        self.elapsed = saved["elapsed"].numpy().copy()
        self.batch.set_physics(saved["physics"].numpy())
        return saved["observation"].numpy().copy()
