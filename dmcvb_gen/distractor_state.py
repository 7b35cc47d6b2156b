"""The labels of pictures: what distractors draw, the store keeps and renderers paint; arrays in, rows of them out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np


@dataclass(frozen=True)
class DistractorState:
    """Labels of the distractors, a row a frame; the leading shape is (frame,) or (episode, step).

    Pictures are painted from these very values, so a stored frame can be painted again from its labels.

    Attributes:
      camera_position: (..., view, 3) float32, world frame, meters.
      camera_quaternion: (..., view, 4) float32, w x y z, MuJoCo's camera frame (looks along -z, y up).
      material_rgb: (..., material, 3) float32 in [0, 1], the model's materials in their order.
      background_video: (...,) int16, index of the video seen through the sky; -1: the model's own sky.
      background_frame: (...,) int16, frame of that video; -1 with the model's own sky.
      style: (...,) int16, visual look of a maze, its style * 100 + variant; -1: none.
    """

    camera_position: np.ndarray
    camera_quaternion: np.ndarray
    material_rgb: np.ndarray
    background_video: np.ndarray
    background_frame: np.ndarray
    style: np.ndarray

    def __getitem__(self, index: Any) -> DistractorState:
        """Index the leading axes of all labels alike."""
        return DistractorState(**{name: value[index] for name, value in self.items()})

    def __len__(self) -> int:
        return len(self.background_video)

    def items(self) -> Iterator[tuple[str, np.ndarray]]:
        for field in fields(self):
            yield field.name, getattr(self, field.name)

    def flat(self) -> DistractorState:
        """With the leading (episode, step) axes made one frame axis."""
        lead = self.background_video.ndim
        return DistractorState(**{name: value.reshape(-1, *value.shape[lead:]) for name, value in self.items()})


DISTRACTOR_STATE_NAMES = tuple(field.name for field in fields(DistractorState))
"""Names of the labels, stored as "exogenous/<name>"."""
