"""Compute forward optical flow exactly, from depth, segmentation and the physics states of two frames."""

from __future__ import annotations

import numpy as np

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import Kinematics, camera_ids, matrices

NEAR = 1e-3
"""Meters in front of the camera below which a point has no place in the picture."""


def render_flow(
    renderer: Renderer,
    physics: np.ndarray,
    labels: DistractorState,
    next_physics: np.ndarray,
    next_labels: DistractorState,
    view: str,
    hide_goal: bool = False,
) -> np.ndarray:
    """Return how far what each pixel shows moves in the picture until the next frame.

    A point of a geom moves with the geom, the sky turns with the camera alone (a video on it has no flow of its own),
    and sites and tendons count as standing still. Shadows and mirror images move otherwise than what they lie on.

    Args:
      physics, labels: (frame, ...), the frames.
      next_physics, next_labels: (frame, ...), the frame after each of them.
      view: name out of `task.views`.
      hide_goal: see `Renderer.render`.

    Returns:
      (frame, size, size, 2) float32, pixels to the right and down; 0 for points that get behind the camera.
    """
    task, column = renderer.task, renderer.task.views.index(view)
    found = renderer.render_labels(physics, labels, [view], hide_goal)
    depth, geom = found["depth"][:, 0].astype(np.float64), found["segmentation"][:, 0]
    half, rays = _rays(task, column, renderer.size)
    points = np.where(depth[..., None] > 0, rays * depth[..., None], rays)  # the sky: directions
    turn, position = _camera(labels, column)
    world = np.einsum("fij,fyxj->fyxi", turn, points) + np.where(depth[..., None] > 0, position[:, None, None], 0)
    world = _moved(task, world, geom, physics, next_physics)
    next_turn, next_position = _camera(next_labels, column)
    world -= np.where(depth[..., None] > 0, next_position[:, None, None], 0)
    seen = np.einsum("fji,fyxj->fyxi", next_turn, world)
    ahead = -seen[..., 2]
    slopes = seen[..., :2] / np.where(ahead > NEAR, ahead, 1)[..., None]
    moved = (slopes - rays[..., :2]) * np.array([1, -1]) * renderer.size / (2 * half)
    return np.where((ahead > NEAR)[..., None], moved, 0).astype(np.float32)


def _rays(task: Task, view: int, size: int) -> tuple[float, np.ndarray]:
    """Slope of the picture's edge, and the rays through the middles of pixels: (size, size, 3), at depth 1."""
    half = float(np.tan(np.radians(task.model.cam_fovy[camera_ids(task)[view]]) / 2))
    row, column = np.mgrid[:size, :size] + 0.5
    x, y = (2 * column / size - 1) * half, (1 - 2 * row / size) * half
    return half, np.stack([x, y, -np.ones_like(x)], axis=-1)


def _camera(labels: DistractorState, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (frame, 3, 3) and position (frame, 3) of a view's camera."""
    return matrices(labels.camera_quaternion[:, view]), labels.camera_position[:, view].astype(np.float64)


def _moved(
    task: Task, world: np.ndarray, geom: np.ndarray, physics: np.ndarray, next_physics: np.ndarray
) -> np.ndarray:
    """Where points (frame, row, column, 3) of geoms (frame, row, column) are after they moved with their geoms."""
    kinematics = Kinematics(task, ("geom_xpos", "geom_xmat"))
    before, after = kinematics(physics), kinematics(next_physics)
    frame = np.arange(len(world))[:, None, None]
    shape = (len(world), -1, 3, 3)
    turn = np.einsum("fgij,fgkj->fgik", after["geom_xmat"].reshape(shape), before["geom_xmat"].reshape(shape))
    own = world - before["geom_xpos"][frame, geom]
    moved = np.einsum("fyxij,fyxj->fyxi", turn[frame, geom], own) + after["geom_xpos"][frame, geom]
    return np.where((geom >= 0)[..., None], moved, world)
