"""Environments that show what the data show: stacks of frames, channels first.

A policy trained on `sampler.stream` or a `StepSource` sees the same layout here: the last `stack` frames, oldest first,
each with its views in their order, and the first frame of an episode repeated before it.
"""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from dmcvb_gen.errors import DmcvbError


class _Stack:
    """The last frames of episodes side by side, (place, stack, channel, size, size) uint8."""

    def __init__(self, places: int, stack: int, observations: gymnasium.Space):
        if stack < 1:
            raise DmcvbError(f"stack is {stack}; give at least 1")
        assert isinstance(observations, spaces.Dict)
        size, _, channels = observations["pixels"].shape or ()
        self._frames = np.zeros((places, stack, channels, size, size), np.uint8)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of one place: (stack * channel, size, size)."""
        _, stack, channels, height, width = self._frames.shape
        return stack * channels, height, width

    def push(self, pixels: np.ndarray, first: np.ndarray, only_first: bool = False) -> np.ndarray:
        """Take up (place, size, size, channel); gives (place, stack * channel, size, size).

        Args:
          first: (place,) bool, where these are the first frames of episodes.
          only_first: the frames of the other places are not new.
        """
        moved = np.moveaxis(pixels, -1, 1)
        if not only_first:
            self._frames = np.concatenate([self._frames[:, 1:], moved[:, None]], axis=1)
        self._frames[first] = moved[first, None]
        return self._frames.reshape(len(pixels), *self.shape).copy()


def _space(space: gymnasium.Space, shape: tuple[int, int, int]) -> spaces.Dict:
    assert isinstance(space, spaces.Dict)
    return spaces.Dict({**space.spaces, "pixels": spaces.Box(0, 255, shape, np.uint8)})


Observation = dict[str, np.ndarray]


class DataLayout(gymnasium.Wrapper):
    """A `DistractedEnv` with the data's layout: "pixels" (stack * view * 3, size, size) uint8, "state" as it was."""

    def __init__(self, env: gymnasium.Env, stack: int = 3):
        super().__init__(env)
        self._stack = _Stack(1, stack, env.observation_space)
        self.observation_space = _space(env.observation_space, self._stack.shape)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._stacked(observation, True), info

    def step(self, action: np.ndarray) -> tuple[Observation, SupportsFloat, bool, bool, dict]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._stacked(observation, False), reward, terminated, truncated, info

    def _stacked(self, observation: Observation, first: bool) -> Observation:
        return {**observation, "pixels": self._stack.push(observation["pixels"][None], np.array([first]))[0]}


class VectorDataLayout(VectorWrapper):
    """A `DistractedVectorEnv` with the data's layout, see `DataLayout`; a restarted episode's stack begins anew."""

    def __init__(self, env: VectorEnv, stack: int = 3):
        super().__init__(env)
        if env.metadata.get("autoreset_mode") != AutoresetMode.NEXT_STEP:
            raise DmcvbError("the vector environment does not restart at the next step; give one of dmcvb_gen's")
        self._stack = _Stack(env.num_envs, stack, env.single_observation_space)
        self.single_observation_space = _space(env.single_observation_space, self._stack.shape)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._ended = np.zeros(env.num_envs, bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        first = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        self._ended[first] = False
        return {**observation, "pixels": self._stack.push(observation["pixels"], first, only_first=True)}, info

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        first, self._ended = self._ended, terminated | truncated
        return self._stacked(observation, first), reward, terminated, truncated, info

    def _stacked(self, observation: Observation, first: np.ndarray) -> Observation:
        return {**observation, "pixels": self._stack.push(observation["pixels"], first)}


def data_layout(env: gymnasium.Env | VectorEnv, stack: int = 3) -> DataLayout | VectorDataLayout:
    """An environment of `gymnasium.make` or `make_vec` with the data's layout (the agents' of DMC-VB with 3 frames)."""
    return VectorDataLayout(env, stack) if isinstance(env, VectorEnv) else DataLayout(env, stack)
