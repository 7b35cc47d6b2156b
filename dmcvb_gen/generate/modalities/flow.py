"""Compute forward optical flow exactly, from depth, segmentation and the physics states of two frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.generate.modalities.base import Modality, register_modality

if TYPE_CHECKING:
    from dmcvb_gen.tasks.base import Task

STEP = 1 / 8
"""Pixels of flow that one level of a color stands for."""
NEAR = 1e-3
"""Meters in front of the camera below which a point has no place in the picture."""


@register_modality
class Flow(Modality):
    """Pixels to the right and down that what a pixel shows moves until the next frame.

    A point of a geom moves with the geom, the sky turns with the camera alone (a video on it has no flow of its own),
    and sites and tendons count as standing still. Shadows and mirror images move otherwise than what they lie on.
    Points that get behind the camera have no flow.
    """

    name, shape, needs_next = "flow", (2,), True
    encoding = f"R = 128 + {round(1 / STEP)} pixels to the right, G = 128 + {round(1 / STEP)} down; 0, 255: or farther"

    def compute(self, seen):
        task, column = seen.task, seen.task.views.index(seen.view)
        depth, sky = seen.depth.astype(np.float64), seen.depth == 0
        half, rays = _rays(task, column, seen.size)
        points = np.where(sky[..., None], rays, rays * depth[..., None])  # the sky: directions
        turn, position = _camera(seen.labels, column)
        world = np.einsum("fij,fyxj->fyxi", turn, points) + np.where(sky[..., None], 0, position[:, None, None])
        world = _moved(task, world, seen.geom, seen.physics, seen.next_physics)
        next_turn, next_position = _camera(seen.next_labels, column)
        world -= np.where(sky[..., None], 0, next_position[:, None, None])
        shown = np.einsum("fji,fyxj->fyxi", next_turn, world)
        ahead = -shown[..., 2]
        slopes = shown[..., :2] / np.where(ahead > NEAR, ahead, 1)[..., None]
        moved = (slopes - rays[..., :2]) * np.array([1, -1]) * seen.size / (2 * half)
        return np.where((ahead > NEAR)[..., None], moved, 0).astype(np.float32)

    def color(self, values):
        moved = np.clip(np.rint(128 + values / STEP), 0, 255)
        return np.concatenate([moved, np.full((*moved.shape[:-1], 1), 128)], axis=-1).astype(np.uint8)


def _rays(task: Task, view: int, size: int) -> tuple[float, np.ndarray]:
    """Slope of the picture's edge, and the rays through the middles of pixels: (size, size, 3), at depth 1."""
    from dmcvb_gen.tasks.cameras import camera_ids

    half = float(np.tan(np.radians(task.model.cam_fovy[camera_ids(task)[view]]) / 2))
    row, column = np.mgrid[:size, :size] + 0.5
    x, y = (2 * column / size - 1) * half, (1 - 2 * row / size) * half
    return half, np.stack([x, y, -np.ones_like(x)], axis=-1)


def _camera(labels: DistractorState, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (frame, 3, 3) and position (frame, 3) of a view's camera."""
    from dmcvb_gen.tasks.cameras import matrices

    return matrices(labels.camera_quaternion[:, view]), labels.camera_position[:, view].astype(np.float64)


def _moved(
    task: Task, world: np.ndarray, geom: np.ndarray, physics: np.ndarray, next_physics: np.ndarray
) -> np.ndarray:
    """Where points (frame, row, column, 3) of geoms (frame, row, column) are after they moved with their geoms."""
    from dmcvb_gen.tasks.cameras import Kinematics

    fields = ("geom_xpos", "geom_xmat")
    before, after = (Kinematics(task)(states, fields) for states in (physics, next_physics))
    frame = np.arange(len(world))[:, None, None]
    shape = (len(world), -1, 3, 3)
    turn = np.einsum("fgij,fgkj->fgik", after["geom_xmat"].reshape(shape), before["geom_xmat"].reshape(shape))
    own = world - before["geom_xpos"][frame, geom]
    moved = np.einsum("fyxij,fyxj->fyxi", turn[frame, geom], own) + after["geom_xpos"][frame, geom]
    return np.where((geom >= 0)[..., None], moved, world)
