"""The labels of pictures: distractors draw them, the store keeps them, and renderers paint from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np


def _label(dtype: str, *dimensions: str, optional: bool = False) -> Any:
    """A stored label: its data type, and its dimensions after episode and step; optional ones may be None."""
    metadata = {"dtype": dtype, "dimensions": dimensions}
    return field(metadata=metadata, default=None) if optional else field(metadata=metadata)


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
      light_shift: (..., 3) float32 meters, by which all lamps are moved; None if the light does not vary.
    """

    camera_position: np.ndarray = _label("float32", "view", "xyz")
    camera_quaternion: np.ndarray = _label("float32", "view", "wxyz")
    material_rgb: np.ndarray = _label("float32", "material", "rgb")
    background_video: np.ndarray = _label("int16")
    background_frame: np.ndarray = _label("int16")
    style: np.ndarray = _label("int16")
    light_shift: np.ndarray | None = _label("float32", "xyz", optional=True)

    def __getitem__(self, index: Any) -> DistractorState:
        """Index the leading axes of all labels alike."""
        return DistractorState(**{name: value[index] for name, value in self.items()})

    def __len__(self) -> int:
        return len(self.background_video)

    def items(self) -> Iterator[tuple[str, np.ndarray]]:
        """Name and values of every label that is there."""
        for label in fields(self):
            if (values := getattr(self, label.name)) is not None:
                yield label.name, values

    def flat(self) -> DistractorState:
        """Return a copy whose leading (episode, step) axes are one frame axis."""
        lead = self.background_video.ndim
        return DistractorState(**{name: value.reshape(-1, *value.shape[lead:]) for name, value in self.items()})


LABEL_DTYPES: dict[str, str] = {label.name: label.metadata["dtype"] for label in fields(DistractorState)}
"""Label, stored as "exogenous/<name>", -> its data type."""
LABEL_DIMENSIONS: dict[str, tuple[str, ...]] = {
    label.name: label.metadata["dimensions"] for label in fields(DistractorState)
}
OPTIONAL_LABELS = {"light_shift": "light"}
"""Label -> the part of a distractor that gives it; it is stored only if that part varies."""
