"""Base and registry of modalities."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from dmcvb_gen.registry import Registry

if TYPE_CHECKING:
    from dmcvb_gen.distractor_state import DistractorState
    from dmcvb_gen.tasks.base import Task


@dataclass(frozen=True)
class Seen:
    """Frames of one view, as a modality is computed from them.

    Attributes:
      task, view: the task that is shown, a name out of `task.views`. size: pixels a side.
      depth: (frame, size, size) float32, meters along the line of sight's axis; 0 is the sky.
      geom: (frame, size, size) int16, MuJoCo's number of the geom; -1 is the sky.
      physics, labels: (frame, ...) states and distractor labels.
      next_physics, next_labels: those of the frame after each; None unless the modality asks for it.
    """

    task: Task
    view: str
    size: int
    depth: np.ndarray
    geom: np.ndarray
    physics: np.ndarray
    labels: DistractorState
    next_physics: np.ndarray | None = None
    next_labels: DistractorState | None = None


class Modality(abc.ABC):
    """A value, or some, of each pixel.

    Attributes:
      name: name for `--label`, and of the stored array.
      dtype: numpy name.
      shape: shape of a pixel's value; () for a number.
      bounds: lowest and highest value, for environments.
      needs_next: True if it is computed from the next frame too. Environments do not have such a modality, and it is
        zero in the last row of an episode.
      encoding: words for how `color`'s images hold the values.
    """

    name: ClassVar[str]
    dtype: ClassVar[str] = "float32"
    shape: ClassVar[tuple[int, ...]] = ()
    bounds: ClassVar[tuple[float, float]] = (-np.inf, np.inf)
    needs_next: ClassVar[bool] = False
    encoding: ClassVar[str]

    @property
    def levels(self) -> str | None:
        """Words for the values of `gray`'s images; None if it makes none."""
        low, high = self.bounds
        if self.shape or np.dtype(self.dtype).kind not in "iu" or high - low >= 2**16:
            return None
        return f"16-bit level = value + {-low}" if low else "16-bit level = value"

    def gray(self, values: np.ndarray) -> np.ndarray:
        """(..., height, width) values -> uint16 images of the same shape, for formats that know images of 16 bits."""
        return (values.astype(np.int64) - int(self.bounds[0])).astype(np.uint16)

    @abc.abstractmethod
    def compute(self, seen: Seen) -> np.ndarray:
        """(frame, size, size, *shape): the values of frames."""

    @abc.abstractmethod
    def color(self, values: np.ndarray) -> np.ndarray:
        """(..., height, width, *shape) values -> (..., height, width, 3) uint8, for formats that know images alone."""


_registry: Registry[Modality] = Registry("modality", "dmcvb_gen.generate.modalities", "dmcvb_gen.modalities")


def register_modality(modality: type[Modality]) -> type[Modality]:
    """Class decorator that makes a modality known by its name.

    Raises:
      DmcvbError: another class has that name already.
    """
    _registry.add(modality.name, modality(), modality)
    return modality


def all_modalities() -> Mapping[str, Modality]:
    """All modalities by name."""
    return _registry.all()


def get_modality(name: str) -> Modality:
    """The modality of a name.

    Raises:
      UnknownNameError: there is none.
    """
    return _registry.get(name)
