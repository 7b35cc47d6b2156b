"""The environments for users of dm_env: `DmEnv("walker-walk", "dynamic")` gives TimeSteps."""

from __future__ import annotations

from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from dmcvb_gen.loaders.envs import DistractedEnv


class DmEnv(dm_env.Environment):
    """One episode at a time; the same episodes as `DistractedEnv` of the same arguments and seed.

    Args:
      seed: decides initial states and distractors of all episodes.
      options: options of `DistractedEnv` (size, renderer, split, ...).
    """

    def __init__(self, task: str, distractor: str = "none", *, seed: int | None = None, **options: Any):
        self._env, self._seed, self._running = DistractedEnv(task, distractor, **options), seed, False

    def reset(self) -> dm_env.TimeStep:
        observation, _ = self._env.reset(seed=self._seed)
        self._seed, self._running = None, True
        return dm_env.restart(observation)

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """One agent step; after the last one, a new episode starts whatever the action."""
        if not self._running:
            return self.reset()
        observation, reward, terminated, truncated, _ = self._env.step(action)
        self._running = not (terminated or truncated)
        if terminated:
            return dm_env.termination(reward, observation)
        if truncated:
            return dm_env.truncation(reward, observation)
        return dm_env.transition(reward, observation)

    def observation_spec(self) -> dict[str, specs.Array]:
        spaces, _ = self._env.spaces()
        return {name: _spec(name, space) for name, space in spaces.items()}

    def action_spec(self) -> specs.BoundedArray:
        space = self._env.spaces()[1]
        return specs.BoundedArray(space.shape, np.float32, space.low, space.high, name="action")

    def close(self) -> None:
        self._env.close()


def _spec(name: str, space: Any) -> specs.Array:
    if np.isfinite(space.low).all() and np.isfinite(space.high).all():
        return specs.BoundedArray(space.shape, space.dtype, space.low.min(), space.high.max(), name=name)
    return specs.Array(space.shape, space.dtype, name=name)
