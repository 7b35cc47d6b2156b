"""Distractors: what varies in the picture and nowhere else.

`sample_distractors` expands a setting into per-frame labels, from random streams that physics never touches.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dmcvb_gen.distractor_state import LABEL_DIMENSIONS, LABEL_DTYPES, OPTIONAL_LABELS, DistractorState
from dmcvb_gen.distractors.backgrounds import Backgrounds, load_backgrounds
from dmcvb_gen.distractors.base import Distractor, DistractorSetting, Scene, floor_alpha_for
from dmcvb_gen.distractors.registry import BUILT_IN, distractors_of
from dmcvb_gen.errors import DmcvbError, first_line
from dmcvb_gen.tasks.base import Task

ROUNDING = 1e-4
"""Labels of an episode may differ by so much with the episodes beside it, as sums round by their sizes."""


class DistractorSampler:
    """An episode batch's distractors, drawn ahead of the trajectory.

    The random walks need only the streams. The states of the agent come frame by frame when an agent is evaluated, or
    for whole episodes at once.

    Args:
      generators: stream name -> one generator an episode; "camera", "color", "background", "style", "cue" are used.
      frames: frames an episode at most.
    """

    def __init__(
        self,
        task: Task,
        setting: DistractorSetting,
        frames: int,
        generators: Mapping[str, Sequence[np.random.Generator]],
        backgrounds: Backgrounds | None,
        split: str = "train",
    ):
        self.task, self.setting, self.frames = task, setting, frames
        self._scene = Scene(task, setting, frames, backgrounds, split)
        kinds = distractors_of(setting)
        self.own = " and ".join(f"{kind.__module__}:{kind.__name__}" for kind in kinds if kind not in BUILT_IN)
        with self._told():
            self._drawn = [distractor(self._scene, generators[distractor.stream]) for distractor in kinds]
        given = {name for distractor in self._drawn for name in distractor.names}
        self._left_out = [distractor for distractor in BUILT_IN if not given.issuperset(distractor.names)]

    def labels(
        self, physics: np.ndarray, actions: np.ndarray | None = None, frame: int | None = None
    ) -> DistractorState:
        """Labels of whole episodes, leading shape (episode, frame), or of one frame of all of them, (episode,).

        Args:
          physics: (episode, frame, physics) float64, or (episode, physics) at that frame.
          actions: (..., action), those before each frame; zeros before the first one, or if None.
        """
        frames = slice(physics.shape[1]) if frame is None else frame
        if actions is None:
            actions = np.zeros((*physics.shape[:-1], self.task.action_size))
        found: dict[str, Any] = {}
        with self._told():
            for nominal in self._left_out:
                found.update(nominal.nominal(self._scene, physics))
            for distractor in self._drawn:
                found.update(distractor.labels(physics, frames))
            if self.own:  # its `adjust` may write into them
                found = {name: np.array(values) for name, values in found.items()}
            for distractor in self._drawn:
                distractor.adjust(found, actions, frames)
            if self.own:
                self._check(found, physics.shape[:-1])
        typed = {name: found[name].astype(LABEL_DTYPES[name]) for name in LABEL_DTYPES if name in found}
        return DistractorState(**typed)

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """An exception of the user's own code becomes one line."""
        try:
            yield
        except Exception as error:
            if not self.own or isinstance(error, DmcvbError):
                raise
            raise DmcvbError(f"distractor {self.own} failed ({type(error).__name__}: {first_line(error)})") from error

    def _check(self, found: dict[str, Any], lead: tuple[int, ...]) -> None:
        """Refuse labels that cannot be stored, or that no picture shows.

        Args:
          lead: (episode, frame) or (episode,).
        """
        sizes = {"view": len(self.task.views), "material": len(self.task.material_colors)}
        sizes |= {"xyz": 3, "wxyz": 4, "rgb": 3}
        for name in LABEL_DTYPES:
            if name not in found:
                if name in OPTIONAL_LABELS:
                    continue
                raise DmcvbError(f"distractor {self.own} gives no {name}; give it, or leave it out of `names`")
            found[name] = values = np.asarray(found[name])
            shape = (*lead, *(sizes[dimension] for dimension in LABEL_DIMENSIONS[name]))
            if values.shape != shape or values.dtype.kind not in "fiu":
                raise DmcvbError(
                    f"distractor {self.own} gives {name} as {values.dtype} of shape {values.shape}; give numbers of "
                    f"shape {shape}"
                )
            if name == "camera_quaternion" and not values.any(axis=-1).all():
                raise DmcvbError(f"distractor {self.own} gives a camera_quaternion of zeros, which is no rotation")
            low, high = self._range(name, found)
            if not ((low <= values) & (values <= high)).all():  # NaN is in no range
                raise DmcvbError(
                    f"distractor {self.own} gives {name} from {values.min()} to {values.max()}; give finite numbers "
                    f"from {np.min(low)} to {np.max(high)}"
                )

    def _range(self, name: str, found: Mapping[str, np.ndarray]) -> tuple[Any, Any]:
        """The least and the largest value of a label."""
        lengths = self._scene.backgrounds.lengths if self._scene.backgrounds else ()
        if name == "background_video":
            return -1, len(lengths) - 1
        if name == "background_frame":
            video = found["background_video"].astype(int)
            return np.minimum(video, 0), np.append(lengths, 0)[video] - 1
        dtype = np.dtype(LABEL_DTYPES[name])
        limits = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
        return {"material_rgb": (0, 1), "camera_quaternion": (-1, 1)}.get(name, (limits.min, limits.max))


def sample_distractors(
    task: Task,
    setting: DistractorSetting,
    physics: np.ndarray,
    generators: Mapping[str, Sequence[np.random.Generator]],
    backgrounds: Backgrounds | None = None,
    split: str = "train",
    actions: np.ndarray | None = None,
) -> DistractorState:
    """Per-frame labels of whole episodes (Distracting Control Suite; DMC-VB, section 3.1).

    Args:
      physics: (episode, frame, physics) float64 states.
      generators: stream name -> one generator an episode.
      backgrounds: the videos, needed unless the setting is "none".
      split: "train" or "val", which maze styles.
      actions: (episode, frame, action), the one before each frame, which cues follow; zeros if None.

    Returns:
      Labels with leading shape (episode, frame); an episode's labels depend on its own streams and states only,
      and a longer episode begins with the labels of a shorter one.

    Raises:
      DmcvbError: a user's own distractor fails, or gives labels that are not so.
    """
    alone = {name: [copy.deepcopy(streams[-1])] for name, streams in generators.items()}
    sampler = DistractorSampler(task, setting, physics.shape[1], generators, backgrounds, split)
    labels = sampler.labels(physics, actions)
    if sampler.own:
        part = np.s_[-1:, : 1 + physics.shape[1] // 2]
        frames = physics[part].shape[1]
        again = DistractorSampler(task, setting, frames, alone, backgrounds, split)
        found = again.labels(physics[part], None if actions is None else actions[part])
        for (name, values), (_, wanted) in zip(found.items(), labels[part].items(), strict=True):
            if not np.allclose(values, wanted, atol=ROUNDING):
                raise DmcvbError(
                    f"distractor {sampler.own} gives other {name} for the same episode; draw from its generator alone, "
                    "row by row, and let a longer episode begin with the shorter one"
                )
    return labels


__all__ = [
    "Backgrounds",
    "Distractor",
    "DistractorSampler",
    "DistractorSetting",
    "Scene",
    "floor_alpha_for",
    "load_backgrounds",
    "sample_distractors",
]
