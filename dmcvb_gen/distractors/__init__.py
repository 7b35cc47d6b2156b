"""Distractors: what varies in the picture and nowhere else.

`sample_distractors` expands a setting into per-frame labels, from random streams that physics never touches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.distractors.background import background_walk
from dmcvb_gen.distractors.backgrounds import Backgrounds, load_backgrounds
from dmcvb_gen.distractors.base import KINDS, SCALES, Distractor, floor_alpha_for
from dmcvb_gen.distractors.camera import camera_range, camera_walk, look_at, nominal_target
from dmcvb_gen.distractors.color import color_walk
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import camera_ids, centers_of_mass, nominal_cameras, quaternions, seen_materials


class DistractorSampler:
    """An episode batch's distractors, drawn ahead of the trajectory.

    The random walks need only the streams; where the agent is comes in frame by frame (`frame`) when
    an agent is evaluated, or for whole episodes at once (`whole`).

    Args:
      generators: stream name -> one generator an episode; "camera", "color", "background", "style" are used.
      frames: frames an episode at most.
    """

    def __init__(
        self,
        task: Task,
        setting: Distractor,
        frames: int,
        generators: Mapping[str, Sequence[np.random.Generator]],
        backgrounds: Backgrounds | None,
        split: str = "train",
    ):
        self.task, self.setting, self.frames = task, setting, frames
        episodes = len(generators["style"])
        own = task.material_colors
        self._video = np.full((episodes, frames), -1, np.int16)
        self._index = np.full((episodes, frames), -1, np.int16)
        self._style = np.full((episodes, frames), -1, np.int16)
        styles = task.styles(split)
        if styles:
            self._style[:] = [[_draw(rng, task.looks(_draw(rng, styles)))] for rng in generators["style"]]
        if setting.kind == "none":
            self._colors = np.broadcast_to(own, (episodes, frames, *own.shape))
            self._offset = None
            return
        if backgrounds is None:
            raise ValueError(f"distractor {setting.name!r} needs backgrounds")
        self._colors = color_walk(own, setting, frames, generators["color"])
        unseen = np.setdiff1d(np.arange(len(own)), seen_materials(task.model))
        self._colors[:, :, unseen] = own[unseen]  # a label of what nobody sees would only cost bytes
        offset = np.asarray(task.model.cam_poscom0[camera_ids(task)[0]])
        self._offset, roll = camera_walk(camera_range(offset, setting), setting, frames, generators["camera"])
        nominal = task.model.cam_mat0[camera_ids(task)[0]].reshape(3, 3)
        self._quaternion = quaternions(look_at(self._offset - nominal_target(offset, nominal), roll))
        self._video, self._index = background_walk(backgrounds.lengths, setting, frames, generators["background"])

    def frame(self, frame: int, physics: np.ndarray) -> DistractorState:
        """Labels of one frame of all episodes, leading shape (episode,).

        Args:
          physics: (episode, physics) float64, the states at that frame.
        """
        return self._labels(physics, slice(None), frame)

    def whole(self, physics: np.ndarray) -> DistractorState:
        """Labels of whole episodes, leading shape (episode, frame).

        Args:
          physics: (episode, frame, physics) float64.
        """
        return self._labels(physics, slice(None), slice(physics.shape[1]))

    def _labels(self, physics, episodes, frames) -> DistractorState:
        lead = physics.shape[:-1]
        flat = physics.reshape(-1, physics.shape[-1])
        if self._offset is None:
            position, quaternion = nominal_cameras(self.task, flat)
            position, quaternion = position.reshape(*lead, -1, 3), quaternion.reshape(*lead, -1, 4)
        else:
            agent = centers_of_mass(self.task, flat).reshape(*lead, 3)
            position = (agent + self._offset[episodes, frames])[..., None, :]
            quaternion = self._quaternion[episodes, frames][..., None, :]
        return DistractorState(
            camera_position=position.astype(np.float32),
            camera_quaternion=quaternion.astype(np.float32),
            material_rgb=self._colors[episodes, frames].astype(np.float32),
            background_video=self._video[episodes, frames],
            background_frame=self._index[episodes, frames],
            style=self._style[episodes, frames],
        )


def _draw(rng: np.random.Generator, choices: Sequence[int]) -> int:
    return choices[int(rng.integers(len(choices)))]


def sample_distractors(
    task: Task,
    setting: Distractor,
    physics: np.ndarray,
    generators: Mapping[str, Sequence[np.random.Generator]],
    backgrounds: Backgrounds | None = None,
    split: str = "train",
) -> DistractorState:
    """Per-frame labels of whole episodes (Distracting Control Suite; DMC-VB, section 3.1).

    Args:
      physics: (episode, frame, physics) float64 states.
      generators: stream name -> one generator an episode.
      backgrounds: the videos, needed unless the setting is "none".
      split: "train" or "val", which maze styles.

    Returns:
      Labels with leading shape (episode, frame); an episode's labels depend on its own streams and states only,
      and a longer episode begins with the labels of a shorter one.
    """
    return DistractorSampler(task, setting, physics.shape[1], generators, backgrounds, split).whole(physics)


__all__ = [
    "KINDS",
    "SCALES",
    "Backgrounds",
    "Distractor",
    "DistractorSampler",
    "floor_alpha_for",
    "load_backgrounds",
    "sample_distractors",
]
