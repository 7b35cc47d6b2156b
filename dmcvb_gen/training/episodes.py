"""Training episodes side by side: a task's simulations with the aids that a training may have, and their restarts.

Actions go in; what the policy sees next, the reward with its aids and the ends of episodes come out. Learners know of
no aid. Evaluations have none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.spec import is_maze
from dmcvb_gen.tasks.ant_maze.task import SPAWN_NOISE
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.training.settings import Count, Natural, Share

STEP_COST = 0.1
"""Cost of a step in a maze, as the reward is 0 in the whole goal cell; lying on the back costs 1 more."""
SHAPED = "humanoid-walk"
"""The task that has a shaping term, besides mazes."""


@dataclass(frozen=True)
class EpisodeSettings:
    """How training episodes go.

    Attributes:
      simulations: episodes stepped side by side.
      train_episode_steps: cut training episodes off after so many agent steps (0: the task's limit).
      standing_starts: share of training episodes that start in the model's own pose (humanoid: standing)
        instead of the task's initial states.
      low_spawn_fraction: mazes: share of training episodes that start deep in the floor, which flings an ant up; what
        it does in the air decides whether it comes down on its feet.
    """

    simulations: Count = 8
    train_episode_steps: Natural = 0
    standing_starts: Share = 0.0
    low_spawn_fraction: Share = 0.0


def shaping_of(task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """(n, state) -> (n,): the shaping term of humanoid-walk or of a maze.

    Humanoid-walk's reward is zero on the floor; the term, in [0, 1], is how high and upright it is. It is full once the
    humanoid stands, so it does not change which gait is best. An ant on its back never gets up again; the term, in
    [-1.1, -0.1], is how far it has tipped over, and that time passes.
    """
    slices = task.state_slices
    if task.id == SHAPED:
        height, vertical = slices["head_height"].start, slices["torso_vertical"].start + 2
        return lambda state: np.clip(state[:, height] / 1.4, 0, 1) ** 2 * (1 + state[:, vertical]) / 2
    upright = slices["world_zaxis"].start + 2
    return lambda state: (state[:, upright] - 1) / 2 - STEP_COST


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


def check_settings_fit(task: Task, settings: Any) -> None:
    """Refuse a setting that has no meaning for a task.

    Raises:
      DmcvbError: which one, and the cure.
    """
    maze, model = is_maze(task.id), task.model
    free = model.njnt > 0 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and not task.model_entries
    fits = {
        "path_reward_scale": (maze, "only for ant mazes"),
        "low_spawn_fraction": (maze, "only for ant mazes"),
        "shaping": (maze or task.id == SHAPED, f"only for {SHAPED} and ant mazes"),
        "standing_starts": (not maze and free, "only for bodies that move freely, such as humanoid's"),
    }
    for name, (fit, what) in fits.items():
        if getattr(settings, name, 0) and not fit:
            raise DmcvbError(f"setting {name} is {what}; {task.id} has no use for it, so remove it")


@dataclass(frozen=True)
class Moment:
    """One agent step of every simulation, (simulation, ...).

    Attributes:
      next_observation: (simulation, observation) float32, where it led, before any restart.
      reward: (simulation,) with the aids. terminated, ended: (simulation,) bool, by the task; by it or by the limit.
    """

    next_observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    ended: np.ndarray


class Episodes:
    """Training episodes side by side, restarted when they end; all of their state can be saved.

    Args:
      seed: of the run. rng: draws which episodes have another start than the task's.

    Attributes:
      observation: (simulation, observation) float32, what policies see now.
      steps: agent steps so far, of all simulations together.
    """

    def __init__(self, task: Task, settings: EpisodeSettings, seed: int, rng: np.random.Generator):
        self._task, self._settings, self._seed, self._rng = task, settings, seed, rng
        self.size, self._limit = settings.simulations, settings.train_episode_steps or task.max_steps
        self._batch, self.steps = task.batch(self.size), 0
        self._shaping, self._path_scale = (getattr(settings, name, 0.0) for name in ("shaping", "path_reward_scale"))
        self._shape = shaping_of(task) if self._shaping else None
        if self._path_scale:
            self._batch.track_paths()  # type: ignore[attr-defined]  # mazes have paths
        # The first episodes are cut short at different steps, so that ends do not fall together.
        self._elapsed = (np.arange(self.size) * self._limit) // self.size
        self.observation = self._start(np.arange(self.size))

    def _start(self, ids: np.ndarray) -> np.ndarray:
        """Begin new episodes; (size, observation) of all, what policies see."""
        settings, rng = self._settings, self._rng
        numbers = self.steps * self.size + ids  # never the same stream twice in a run
        names = (self._task.id, "training")
        self._batch.reset([episode_stream(self._seed, names, int(i), "initial_state") for i in numbers], ids)
        standing = ids[rng.random(len(ids)) < settings.standing_starts]
        if len(standing):
            self._batch.set_physics(standing_states(self._task, rng, len(standing)), standing)
        low = ids[rng.random(len(ids)) < settings.low_spawn_fraction]
        if len(low):
            self._batch.sink(low, rng.uniform(-SPAWN_NOISE, -SPAWN_NOISE / 2, len(low)))  # type: ignore[attr-defined]
        return self._batch.behaviour_observation()

    def step(self, action: np.ndarray) -> Moment:
        """Take one agent step in every simulation, and begin anew where an episode ended with it.

        Args:
          action: (simulation, action) float32 in [-1, 1], which are scaled to the task's bounds.
        """
        batch: Any = self._batch  # mazes' have more than others
        before = batch.path_length() if self._path_scale else 0.0
        result = batch.step(self._task.from_unit(action))
        reward = result.reward
        if self._path_scale:
            reward = reward + self._path_scale * (before - batch.path_length())
        if self._shape:
            reward = reward + self._shaping * self._shape(result.state)
        self._elapsed += 1
        self.steps += self.size
        ended = result.terminated | result.truncated | (self._elapsed >= self._limit)
        reached = self.observation = batch.behaviour_observation()
        if ended.any():
            self.observation = self._start(np.flatnonzero(ended))
            self._elapsed[ended] = 0
        return Moment(reached, reward, result.terminated, ended)

    def saved(self) -> dict[str, Any]:
        """State of the episodes; with observations, because touch sensors do not follow from the physics."""
        parts = {"physics": self._batch.physics(), "elapsed": self._elapsed, "observation": self.observation}
        return {name: torch.from_numpy(part.copy()) for name, part in parts.items()} | {"steps": self.steps}

    def restore(self, saved: dict[str, Any]) -> None:
        """Continue from `saved()`."""
        self._elapsed, self.steps = saved["elapsed"].numpy().copy(), saved["steps"]
        self._batch.set_physics(saved["physics"].numpy())
        self.observation = saved["observation"].numpy().copy()
