"""Interface of all renderers, which turn physics states and distractor labels into pictures."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from importlib import metadata
from typing import Any

import mujoco
import numpy as np

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import RenderingError, UnknownNameError
from dmcvb_gen.tasks.base import Task

Views = Sequence[str] | None
"""Names of views; None: all of the task's."""
MIN_SIZE, MAX_SIZE = 8, 1024
"""Pixels a side that a renderer accepts."""


class Renderer(abc.ABC):
    """Paints frames of one task at one size.

    Pixels are a pure function of (physics, labels, renderer settings, size, view): a frame comes out the
    same however many frames are painted in one call and in whatever order.
    """

    name: str
    samples: int

    def __init__(
        self, task: Task, size: int, *, backgrounds=None, floor_alpha: float = 1.0, samples: int | None = None
    ):
        """Start it.

        Args:
          size: pixels a side.
          backgrounds: the videos that labels may name (`load_backgrounds`).
          floor_alpha: opacity of the ground plane (`distractors.floor_alpha_for`).
          samples: samples a pixel; None: the default.

        Raises:
          RenderingError: it cannot start here.
        """
        check_size(size)
        self.task, self.size, self.floor_alpha, self.backgrounds = task, size, float(floor_alpha), backgrounds

    @classmethod
    def unavailable(cls) -> str | None:
        """Why this renderer cannot start on this machine and what to do, or None."""
        return None

    @classmethod
    def check_task(cls, task: Task) -> None:
        """Raise RenderingError if this renderer does not paint a task; most paint every one."""
        return

    def check_sky(self) -> None:
        """Raise RenderingError if this renderer cannot show videos on its task; most can."""
        return

    @abc.abstractmethod
    def render(
        self, physics: np.ndarray, exogenous: DistractorState, views: Views = None, hide_goal: bool = False
    ) -> np.ndarray:
        """Paint frames.

        Args:
          physics: (frame, physics) float64 states.
          exogenous: labels with leading shape (frame,).
          views: names out of `task.views`; all by default.
          hide_goal: leave out `task.goal_geoms`.

        Returns:
          (frame, view, size, size, 3) uint8.
        """

    def render_pair(
        self, physics: np.ndarray, exogenous: DistractorState, views: Views = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The frames as `render` paints them, and the same with `hide_goal`."""
        return self.render(physics, exogenous, views), self.render(physics, exogenous, views, hide_goal=True)

    @abc.abstractmethod
    def render_labels(
        self, physics: np.ndarray, exogenous: DistractorState, views: Views = None, hide_goal: bool = False
    ) -> dict[str, np.ndarray]:
        """Depth and segmentation of frames, arguments as `render`.

        Returns:
          "depth" -> (frame, view, size, size) float32 in meters (0: sky); "segmentation" -> the same shape, int16
          ids of geoms (-1: sky).
        """

    def describe(self) -> dict[str, Any]:
        """Name and every setting that decides a pixel, for the manifest."""
        return {
            "name": self.name,
            "samples": self.samples,
            "floor_alpha": self.floor_alpha,
            "mujoco": metadata.version("mujoco"),
        }

    def close(self) -> None:  # noqa: B027  (a renderer may hold nothing)
        """Free what the renderer holds; it cannot be used afterwards."""


def moved_lamps(
    model: mujoco.MjModel, position: np.ndarray, direction: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move lamps by a shift. A directional one turns as if it stood at its height (0: a meter) and kept to its point.

    Args:
      position, direction: (frame, lamp, 3) float64, of all lamps of the model.
      shift: (frame, 3) meters.

    Returns:
      Position and direction, as given.
    """
    shift = shift.astype(np.float64)[:, None]
    spot = (model.light_type != mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)[None, :, None]
    height = np.abs(position[..., 2:])
    turned = direction * np.where(height > 0, height, 1.0) - shift
    turned /= np.maximum(np.sqrt((turned * turned).sum(axis=-1, keepdims=True)), 1e-9)
    return np.where(spot, position + shift, position), np.where(spot, direction, turned)


def check_size(size: int) -> None:
    """Raise RenderingError for a size that no renderer takes."""
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise RenderingError(
            f"size {size} is out of range; give {MIN_SIZE} to {MAX_SIZE} pixels a side (DMC-VB has 64)"
        )


def check_frames(task: Task, physics: np.ndarray, exogenous: DistractorState, views: Views) -> list[int]:
    """Return the indices of the requested views; raise if frames and labels do not belong together."""
    if physics.ndim != 2 or physics.shape[1] != task.physics_size or len(physics) != len(exogenous):
        raise ValueError(f"physics {physics.shape} and {len(exogenous)} labels are not frames of {task.id}")
    for view in views or ():
        if view not in task.views:
            raise UnknownNameError(f"view of {task.id}", view, task.views)
    return [task.views.index(view) for view in views or task.views]


def empty_labels(frames: int, views: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Room for depth (frame, view, size, size) float32 and segmentation int16."""
    shape = (frames, views, size, size)
    return np.empty(shape, np.float32), np.empty(shape, np.int16)
