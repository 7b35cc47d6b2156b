"""Environments that show what the data show: stacks of frames, channels first.

A policy trained on `sampler.stream` or a `StepSource` sees the same layout here: the last `stack` frames, oldest first,
each with its views in their order, and the first frame of an episode repeated before it. `subset.environment()` makes
the environment that matches a subset.
"""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.inputs import BUILTIN, video_source
from dmcvb_gen.loaders.envs import DistractedEnv, DistractedVectorEnv
from dmcvb_gen.spec import FIXED, HIDDEN, VISIBLE
from dmcvb_gen.tasks import ACTION_REPEAT


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

    def push(self, pixels: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Take up (place, size, size, channel); gives (place, stack * channel, size, size).

        Args:
          first: (place,) bool, where these are the first frames of episodes.
        """
        moved = np.moveaxis(pixels, -1, 1)
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
        self._ended[:] = False
        return self._stacked(observation, ~self._ended), info

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        first, self._ended = self._ended, terminated | truncated
        return self._stacked(observation, first), reward, terminated, truncated, info

    def _stacked(self, observation: Observation, first: np.ndarray) -> Observation:
        return {**observation, "pixels": self._stack.push(observation["pixels"], first)}


def data_layout(env: gymnasium.Env | VectorEnv, stack: int = 3) -> DataLayout | VectorDataLayout:
    """An environment of `gymnasium.make` or `make_vec` with the data's layout (the agents' of DMC-VB with 3 frames)."""
    return VectorDataLayout(env, stack) if isinstance(env, VectorEnv) else DataLayout(env, stack)


def matching_environment(
    subset: Subset, stack: int = 3, split: str = "val", num_envs: int | None = None, **options: Any
) -> DataLayout | VectorDataLayout:
    """See `SubsetReader.environment`."""
    given = environment_options(subset, split)
    if own_videos(subset):
        given["backgrounds"] = video_source(subset.release.path, subset.record)
    given |= options
    env = DistractedEnv(**given) if num_envs is None else DistractedVectorEnv(num_envs, **given)
    return data_layout(env, stack)


def environment_options(subset: Subset, split: str) -> dict[str, Any]:
    """Options of `DistractedEnv` that match a subset: setting, size, renderer, views, time limit, pairs of goals.

    Episodes are cut where the data's are, and so compare with the reference scores.

    Args:
      split: videos and styles: the data's own ("train"), or those kept for evaluation ("val").
    """
    record, maze = subset.record, subset.record.goal_mode is not None
    options: dict[str, Any] = {
        "task": record.task,
        "distractor": record.setting if maze else record.distractor.name,
        "size": record.size,
        "samples": record.renderer.get("samples"),
        "split": split,
        "max_steps": record.max_steps,
    }
    if record.action_repeat != ACTION_REPEAT:
        options["action_repeat"] = record.action_repeat
    if record.renderer.get("name") and not record.imported:
        options["renderer"] = record.renderer["name"]
    if maze:
        options["views"] = list(shown(subset).views)
        if record.hidden_goal != (record.setting != VISIBLE):  # `paint --goal` decides it, too
            options["goal"] = HIDDEN if record.hidden_goal else VISIBLE
    if own_videos(subset):
        options["own_videos"] = (record.backgrounds or {}).get("digest")
    if record.setting == FIXED:
        seed = int(subset.trajectories.makes.get("seed", 0))
        options |= {"fixed_goals": record.fixed_goals, "goal_seed": seed}
    return options


def own_videos(subset: Subset) -> str | None:
    """The folder of a release's own videos; None if a subset shows the built-in ones or none."""
    videos = (subset.record.backgrounds or {}).get("source", BUILTIN)
    return None if videos == BUILTIN else videos
