"""A task as a Stable-Baselines3 VecEnv over one batch of simulations, for any algorithm of SB3 or sb3-contrib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.tasks.base import Task


def _spaces(task: Task) -> tuple[spaces.Box, spaces.Box]:
    return (
        spaces.Box(-np.inf, np.inf, (task.behaviour_size,), np.float32),
        spaces.Box(task.action_low, task.action_high, dtype=np.float32),
    )


class TaskVecEnv(VecEnv):
    """`size` episodes side by side, each restarted when it ends.

    Observations are (size, behaviour_size) float32, actions lie in the task's bounds, rewards are (size,) float32
    summed over the control steps.
    At an episode's end `infos[i]["terminal_observation"]` is its last observation (the one returned belongs to
    the next episode), and `infos[i]["TimeLimit.truncated"]` is true if only the time limit ended it, so that
    a learner bootstraps there and nowhere else. `infos[i]["episode"]` has its return "r" and length "l".

    Args:
      seed: initial states come from the streams of (seed, task, "training"), a new one each episode.
    """

    def __init__(self, task: Task, size: int, seed: int = 0, threads: int = 1):
        if size < 1:
            raise ValueError(f"size is {size}, expected at least 1")
        self.task, self.batch = task, task.batch(size, threads)
        super().__init__(size, *_spaces(task))
        self._seed, self._started = seed, 0
        self._actions: np.ndarray | None = None
        self._length, self._return = np.zeros(size, int), np.zeros(size)

    def _start(self, ids: np.ndarray) -> None:
        names, first = (self.task.id, "training"), self._started
        generators = [episode_stream(self._seed, names, first + k, "initial_state") for k in range(len(ids))]
        self._started += len(ids)
        self._length[ids], self._return[ids] = 0, 0.0
        self.batch.reset(generators, ids)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Take the streams of `seed` from the next reset on."""
        if seed is not None:
            self._seed, self._started = seed, 0
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray:
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._start(np.arange(self.num_envs))
        return self.batch.behaviour_observation()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        result = self.batch.step(self._actions)
        observation = self.batch.behaviour_observation()
        self._length += 1
        self._return += result.reward
        truncated = (result.truncated | (self._length >= self.task.max_steps)) & ~result.terminated
        done = result.terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(cut)} for cut in truncated]
        ended = np.flatnonzero(done)
        for i in ended:
            infos[i]["terminal_observation"] = observation[i].copy()
            infos[i]["episode"] = {"r": float(self._return[i]), "l": int(self._length[i])}
        if len(ended):
            self._start(ended)
            observation[ended] = self.batch.behaviour_observation()[ended]
        return observation, result.reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to free: the simulations live in memory."""

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        if attr_name == "render_mode":  # asked for by VecEnv's constructor
            return [None] * len(list(self._get_indices(indices)))
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        raise AttributeError(f"{attr_name} cannot be set: simulations of a batch share their attributes")

    def env_method(self, method_name: str, *args, indices=None, **kwargs) -> list[Any]:
        raise AttributeError(f"{method_name} cannot be called: simulations of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
