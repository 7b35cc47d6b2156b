"""Gymnasium environments of the tasks, with distractors.

For evaluation: by default they show the `val` videos and styles, which no released picture shows, and last as long as
online evaluation does. Many episodes side by side (`gymnasium.make_vec`) share one batch of simulations
and one call of the renderer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, SupportsFloat

import gymnasium
import numpy as np
import pydantic
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from dmcvb_gen.dataset.pictures import Pictures
from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.distractors import DistractorSampler
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.modalities import get_modality
from dmcvb_gen.generate.render import look, open_renderer
from dmcvb_gen.generate.request import background_source
from dmcvb_gen.options import naming_parameters
from dmcvb_gen.seeding import STREAMS, episode_stream
from dmcvb_gen.spec import VISIBLE, GoalMode, SubsetSpec, is_maze
from dmcvb_gen.tasks import Task, get_task
from dmcvb_gen.tasks.ant_maze import as_maze, fixed_pairs
from dmcvb_gen.text import as_names

PURPOSE = "evaluation"
"""Names the random streams: no episode here has those of released data."""
FIXED_GOALS = 5
"""Pairs of start and goal that "fixed" episodes go round by default (benchmark B3)."""


Count = Annotated[int, pydantic.Field(gt=0)]
Index = Annotated[int, pydantic.Field(ge=0)]


@pydantic.dataclasses.dataclass(frozen=True, config=pydantic.ConfigDict(extra="forbid"))
class Scene:
    """Settings of an environment; `DistractedEnv`, `gymnasium.make` and `make_vec` take every field.

    Attributes:
      task: e.g. "walker-walk".
      distractor: "none", "static", "dynamic", or with a difficulty ("dynamic_hard"); for mazes whether the goal is
        "visible", "hidden", or hidden and "fixed" with the start.
      size: pixels a side. renderer: its name; samples: a pixel.
      split: "val" shows videos and styles that no released data show, "train" those of the data.
      backgrounds: "builtin" or a folder of videos.
      own_videos: digest of the videos of the data, if these are not the built-in ones; then give `backgrounds`.
      views: pictures of a task that has several (mazes), side by side in the channels; all by default.
      stack: frames a stack, laid out as readers give them; one frame with its channels last by default.
      modalities: names of modalities that observations have too, e.g. "depth" and "parts"; see `generate.modalities`.
      action_repeat: control steps for which an action is held; give that of the data.
      max_steps: agent steps at which an episode is truncated; by default those of the task's online evaluation.
      fixed_goals: number of pairs of start and goal under "fixed" (5); an episode takes the next one.
      goal_pair: under "fixed": this pair in all episodes.
      goal_seed: under "fixed": the seed that the pairs are drawn from, as a recipe's seed.
      threads: threads of the simulation; the result does not depend on them.
    """

    task: str
    distractor: str = "none"
    size: int = 64
    renderer: str = "native"
    samples: Count | None = None
    split: Literal["val", "train"] = "val"
    backgrounds: str | Path = "builtin"
    own_videos: str | None = None
    views: str | Sequence[str] | None = None
    stack: Count | None = None
    modalities: str | Sequence[str] = ()
    action_repeat: Literal[1, 2, 4] = 2
    max_steps: Count | None = None
    fixed_goals: Count | None = None
    goal_pair: Index | None = None
    goal_seed: Index = 0
    threads: Count = 1

    def spec(self) -> SubsetSpec:
        """The task with its distractor and goal mode; the level is of no account.

        Raises:
          UnknownNameError: the task has no such setting.
        """
        # Mazes always differ in style, and in whether the goal is seen.
        unnamed = self.distractor == "none" and is_maze(get_task(self.task).id)
        return SubsetSpec.parse(self.task, "random", VISIBLE if unnamed else self.distractor)

    def check(self) -> None:
        """Raises DmcvbError for a field that has no effect, or none for this task."""
        spec, unused = self.spec(), []
        if spec.goal is not GoalMode.FIXED:
            unused += ["fixed_goals", "goal_pair", "goal_seed"]
        elif self.goal_pair is not None and self.fixed_goals and self.goal_pair >= self.fixed_goals:
            raise DmcvbError(f"goal_pair is {self.goal_pair}; give 0 to {self.fixed_goals - 1}, as fixed_goals says")
        if not spec.distractor.shows_videos:
            unused.append("backgrounds")
        for name in unused:
            if getattr(self, name) != getattr(Scene, name):
                raise DmcvbError(f"{name} has no effect on {self.task} {self.distractor}; remove {name}")
        if self.own_videos and self.backgrounds == "builtin":
            raise DmcvbError(
                f"the data show videos of their own (digest {self.own_videos[:12]}), not the built-in ones: give their "
                "folder with backgrounds=FOLDER"
            )
        if self.views is not None and not len(self.views):
            raise DmcvbError("views is empty; leave it out for all of them")
        for modality in as_names(self.modalities):
            if get_modality(modality).needs_next:
                raise DmcvbError(
                    f"an environment has no {modality}: the next frame is not known yet; remove {modality}"
                )


def _scene(task: str, distractor: str, options: Mapping[str, Any]) -> Scene:
    try:
        scene = Scene(task=task, distractor=distractor, **options)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise DmcvbError(f"{first['loc'][0]} is {first['input']!r}: {first['msg']}") from None
    scene.check()
    return scene


class _Stage:
    """`count` episodes with their distractors and pictures; restarted one by one."""

    @naming_parameters()
    def __init__(self, count: int, scene: Scene):
        if count < 1:
            raise DmcvbError(f"num_envs is {count}; give at least 1")
        spec = scene.spec()
        self.task, self.count = get_task(scene.task).at(scene.action_repeat), count
        self.size, self.split = scene.size, scene.split
        self.setting = spec.distractor
        self.pictures = Pictures(self.task.views, spec.hides_goal).select(scene.views)
        self.modalities = as_names(scene.modalities)
        self.max_steps = scene.max_steps or self.task.evaluation_steps
        self.pairs = _pairs(self.task, scene) if spec.goal is GoalMode.FIXED else None
        self._first_pair = scene.goal_pair or 0
        given = (scene.renderer, scene.size, scene.samples, background_source(scene.backgrounds), scene.split)
        self.renderer, self.backgrounds = open_renderer(self.task, self.setting, *given)
        shown = self.backgrounds.digest if self.backgrounds and self.split == "train" else scene.own_videos
        if scene.own_videos not in (None, shown):
            raise DmcvbError(
                f"{scene.backgrounds} has other videos than the data ({scene.own_videos[:12]}); give theirs"
            )
        self.batch = self.task.batch(count, scene.threads)
        self.batch.alone = False
        self._episodes = [(0, 0)] * count  # (seed, number) of each place
        self.frame, self.started = np.zeros(count, int), np.zeros(count, int)
        self.action = np.zeros((count, self.task.action_size))  # the last one
        self.state = np.zeros((count, self.task.state_size))
        self.goal_pair = np.full(count, -1)
        self.picture: np.ndarray | None = None  # (place, size, size, 3 * view), the last one
        self.stack, channels = scene.stack, 3 * len(self.pictures.views)
        self._frames = np.zeros((count, scene.stack or 1, channels, self.size, self.size), np.uint8)
        self._is_first = np.zeros(count, bool)

    def spaces(self) -> tuple[spaces.Dict, spaces.Box]:
        """Spaces of one place: observations {"pixels", "state"} and modalities, and actions."""
        channels = 3 * len(self.pictures.views)
        shape = (self.stack * channels, self.size, self.size) if self.stack else (self.size, self.size, channels)
        observation: dict[str, spaces.Space] = {
            "pixels": spaces.Box(0, 255, shape, np.uint8),
            "state": spaces.Box(-np.inf, np.inf, (self.task.state_size,), np.float32),
        }
        for modality in map(get_modality, self.modalities):
            values, (low, high) = (self.size, self.size, len(self.pictures.views), *modality.shape), modality.bounds
            if np.issubdtype(modality.dtype, np.integer):
                low, high = np.clip((low, high), np.iinfo(modality.dtype).min, np.iinfo(modality.dtype).max)
            observation[modality.name] = spaces.Box(low, high, values, np.dtype(modality.dtype).type)
        return spaces.Dict(observation), spaces.Box(self.task.action_low, self.task.action_high, dtype=np.float32)

    def info(self) -> dict[str, np.ndarray]:
        """Of mazes under "fixed", the pair of start and goal in each place, (place,) int."""
        return {"goal_pair": self.goal_pair.copy()} if self.pairs else {}

    def start(self, places: Iterable[int], seeds: Sequence[int]) -> None:
        """Start the next episode of some places, from the streams of their seeds."""
        places = list(places)
        for place, seed in zip(places, seeds, strict=True):
            number = int(self.started[place])
            self._episodes[place] = seed, number
            if self.pairs:
                self.goal_pair[place] = self._first_pair + number % len(self.pairs)
            self.started[place] += 1
            self.frame[place], self.action[place], self._is_first[place] = 0, 0, True
        streams = {
            name: [episode_stream(seed, (self.task.id, PURPOSE), number, name) for seed, number in self._episodes]
            for name in STREAMS
        }
        initial = [streams["initial_state"][place] for place in places]
        if self.pairs:
            pairs = [self.pairs[self.goal_pair[place] - self._first_pair] for place in places]
            self.state = self.batch.reset_fixed(initial, pairs, places)
        else:
            self.state = self.batch.reset(initial, places)
        # Drawn for all places together (the running ones get the walks that they have): labels then take one call.
        self.walk = DistractorSampler(
            self.task, self.setting, self.max_steps + 1, streams, self.backgrounds, self.split
        )

    def labels(self, physics: np.ndarray) -> DistractorState:
        """Labels of the frame that each place shows now, leading shape (place,)."""
        found = {int(frame): self.walk.labels(physics, self.action, int(frame)) for frame in np.unique(self.frame)}
        parts = [found[int(frame)][place : place + 1] for place, frame in enumerate(self.frame)]
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name, _ in parts[0].items()}
        return DistractorState(**joined)

    def observe(self) -> dict[str, np.ndarray]:
        """ "pixels" (place, size, size, 3 * view) uint8 or stacked, "state" (place, state) float32, modalities (place,
        size, size, view)."""
        physics, shown = self.batch.physics(), self.pictures
        labels = self.labels(physics)
        pictures = self.renderer.render(physics, labels, shown.views, shown.hide_goal)  # (place, view, size, size, 3)
        self.picture = np.moveaxis(pictures, 1, 3).reshape(self.count, self.size, self.size, -1)
        pixels = self._stacked(self.picture) if self.stack else self.picture
        observation = {"pixels": pixels, "state": self.state.astype(np.float32)}
        if self.modalities:
            seen = look(self.renderer, physics, labels, shown.views, shown.hide_goal)
            for modality in map(get_modality, self.modalities):
                values = np.stack([modality.compute(view) for view in seen], axis=3)
                observation[modality.name] = values.astype(modality.dtype)
        return observation

    def _stacked(self, pixels: np.ndarray) -> np.ndarray:
        """(place, stack * 3 * view, size, size): the last frames, the oldest first; an episode's first is repeated."""
        channels = np.moveaxis(pixels, -1, 1)
        self._frames = np.concatenate([self._frames[:, 1:], channels[:, None]], axis=1)
        self._frames[self._is_first] = channels[self._is_first, None]
        self._is_first[:] = False
        return self._frames.reshape(self.count, -1, self.size, self.size).copy()

    def step(self, actions: ArrayLike, active: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rewards, terminated, truncated of one agent step of the active places.

        Raises:
          DmcvbError: no episode has started, or the actions have another shape, or are not finite numbers.
        """
        if not self.started.any():
            raise DmcvbError("step before reset; call reset() first")
        actions, wanted = np.asarray(actions, np.float64), (self.count, self.task.action_size)
        if actions.shape != wanted:
            raise DmcvbError(f"the actions have shape {actions.shape}; {self.task.id} takes shape {wanted}")
        if not np.isfinite(actions[active]).all():
            raise DmcvbError("the action holds NaN or infinite values; give finite numbers in action_space")
        clipped = np.clip(actions, self.task.action_low, self.task.action_high)
        result, self.action[active] = self.batch.step(clipped, active), clipped[active]
        self.state = result.state
        self.frame[active] += 1
        truncated = active & (result.truncated | (self.frame >= self.max_steps)) & ~result.terminated
        return result.reward, result.terminated, truncated


def _pairs(task: Task, scene: Scene) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """The (start, goal) cells that "fixed" episodes go round."""
    if scene.goal_pair is None:
        return fixed_pairs(as_maze(task).layout, scene.fixed_goals or FIXED_GOALS, scene.goal_seed)
    return fixed_pairs(as_maze(task).layout, scene.goal_pair + 1, scene.goal_seed)[-1:]


class DistractedEnv(gymnasium.Env):
    """One episode at a time.

    Observations are {"pixels": (size, size, 3 * views) uint8, or (stack * views * 3, size, size), "state": (state,)
    float32}; an action (action,) in
    the task's bounds, [-1, 1] for most, is held for `action_repeat` control steps, whose rewards are summed (an episode
    earns at most 1000). The seed of `reset` decides initial states, distractors and all episodes after it.

    Args:
      task: its name, see `Scene`.
      distractor: its setting, see `Scene`.
      render_mode: None or "rgb_array".
      **options: those of `Scene`.

    Raises:
      DmcvbError: what is asked for does not exist; the message lists what does.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, task: str, distractor: str = "none", *, render_mode: str | None = None, **options: Any):
        if render_mode not in (None, "rgb_array"):
            raise DmcvbError(f"render_mode {render_mode!r} is not offered; give 'rgb_array' or None")
        self._stage = _Stage(1, _scene(task, distractor, options))
        self.task, self.render_mode = self._stage.task, render_mode
        self.observation_space, self.action_space = self._stage.spaces()
        self.metadata = self.metadata | {"render_fps": round(1 / self.task.seconds_per_step)}
        self._seed: int | None = None
        self._ended = False

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        if seed is not None or self._seed is None:
            self._seed, self._stage.started[0] = int(self.np_random.integers(2**63)), 0
        self._stage.start([0], [self._seed])
        self._ended = False
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict]:
        if self._ended:
            raise DmcvbError("step after the end of the episode; call reset() first")
        reward, terminated, truncated = self._stage.step([action], np.ones(1, bool))
        self._ended = bool(terminated[0] or truncated[0])
        return self._observation(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def _observation(self) -> dict[str, np.ndarray]:
        return {name: value[0] for name, value in self._stage.observe().items()}

    def _info(self) -> dict[str, int]:
        return {name: int(values[0]) for name, values in self._stage.info().items()}

    def render(self) -> np.ndarray | None:
        """The picture of the current frame (its first view), (size, size, 3) uint8."""
        if self.render_mode is None or self._stage.picture is None:
            return None
        return self._stage.picture[0, ..., :3].copy()

    def close(self) -> None:
        self._stage.renderer.close()


class DistractedVectorEnv(VectorEnv):
    """`num_envs` episodes side by side; an episode that ended restarts at the next step (Gymnasium's NEXT_STEP).

    Place i behaves, to the last bit of state and reward, as a `DistractedEnv` that was reset with that place's seed.

    Args:
      task: see `Scene`.
      distractor: see `Scene`.
      options: see `Scene`.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": [], "render_fps": 20}

    def __init__(self, num_envs: int, task: str, distractor: str = "none", **options: Any):
        self._stage = _Stage(num_envs, _scene(task, distractor, options))
        self.num_envs, self.task, self.render_mode = num_envs, self._stage.task, None
        self.single_observation_space, self.single_action_space = self._stage.spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeds: list[int] = []
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict]:
        """Start all episodes; an int seeds place i with seed + i, as Gymnasium's own vector environments do.

        Raises:
          DmcvbError: there is a reset_mask, or not one seed for each place.
        """
        if options and "reset_mask" in options:
            raise DmcvbError("places restart by themselves, a step after their end; leave reset_mask out")
        if seed is not None or not self._seeds:
            given = [int(seed) + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
            given = [None] * self.num_envs if given is None else [each if each is None else int(each) for each in given]
            if len(given) != self.num_envs:
                raise DmcvbError(f"{len(given)} seeds are given for {self.num_envs} environments; give one for each")
            self._seeds = [int(gymnasium.utils.seeding.np_random(value)[0].integers(2**63)) for value in given]
            self._stage.started[:] = 0
        self._stage.start(range(self.num_envs), self._seeds)
        self._ended[:] = False
        return self._stage.observe(), self._info()

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict]:
        restarted = self._ended.copy()
        if restarted.any():
            places = np.flatnonzero(restarted)
            self._stage.start(places, [self._seeds[place] for place in places])
        reward, terminated, truncated = self._stage.step(actions, ~restarted)
        self._ended = terminated | truncated
        return self._stage.observe(), reward, terminated, truncated, self._info()

    def _info(self) -> dict[str, np.ndarray]:
        """What a single environment tells, and for each name, as Gymnasium has it, which places do: all."""
        told = self._stage.info()
        return told | {f"_{name}": np.ones(self.num_envs, bool) for name in told}

    def close_extras(self, **kwargs: Any) -> None:
        self._stage.renderer.close()
