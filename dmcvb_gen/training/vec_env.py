"""A task as a Stable-Baselines3 VecEnv over one batch of simulations, for any algorithm of SB3 or sb3-contrib."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from dmcvb_gen.arithmetic import to_unit
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.training.episodes import Episodes, EpisodeSettings


class TaskVecEnv(VecEnv):
    """Training episodes side by side (`Episodes`).

    Observations are (size, behaviour_size) float32, actions lie in the task's bounds, rewards are (size,) float32
    summed over the control steps. At an episode's end `infos[i]["terminal_observation"]` is its last observation (the
    one returned belongs to the next episode), and `infos[i]["TimeLimit.truncated"]` is true if only a time limit ended
    it, so that a learner bootstraps there and nowhere else.
    """

    def __init__(self, task: Task, size: int, seed: int = 0):
        self.task, self._seed = task, seed
        seen = spaces.Box(-np.inf, np.inf, (task.behaviour_size,), np.float32)
        super().__init__(size, seen, spaces.Box(task.action_low, task.action_high, dtype=np.float32))

    def reset(self) -> np.ndarray:
        settings, rng = EpisodeSettings(simulations=self.num_envs), np.random.default_rng(self._seed)
        self.episodes = Episodes(self.task, settings, self._seed, rng)
        return self.episodes.observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = to_unit(np.asarray(actions, np.float32), self.task.action_low, self.task.action_high)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        moment = self.episodes.step(self._actions)
        cut = moment.ended & ~moment.terminated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(each)} for each in cut]
        for i in np.flatnonzero(moment.ended):
            infos[i]["terminal_observation"] = moment.next_observation[i]
        return self.episodes.observation, moment.reward.astype(np.float32), moment.ended, infos

    def close(self) -> None:
        """Nothing to free: the simulations live in memory."""

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        return [getattr(self, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        raise AttributeError(f"{attr_name} cannot be set: simulations of a batch share their attributes")

    def env_method(self, method_name: str, *args, indices=None, **kwargs) -> list[Any]:
        raise AttributeError(f"{method_name} cannot be called: simulations of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
