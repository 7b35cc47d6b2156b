"""Where cameras, bodies, geoms and lights are: physics states in, poses out, in batches and in float64."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from dmcvb_gen.tasks.base import Task, physics_columns

CHUNK = 512
"""States per call; only memory depends on it."""


class Kinematics:
    """Forward kinematics of stored physics states.

    Args:
      task: whose model it is.
      fields: MjData fields to give, e.g. ("geom_xpos", "cam_xmat").
    """

    def __init__(self, task: Task, fields: Sequence[str], threads: int = 1):
        self._batch = Batch(task.model, CHUNK, nthread=threads)
        self._columns = physics_columns(task.model)
        self._fields = {name: self._batch.bind(name) for name in fields}

    def __call__(self, physics: np.ndarray) -> dict[str, np.ndarray]:
        """(frame, physics) -> each field with a leading frame axis, float64."""
        physics = np.asarray(physics, np.float64)
        out = {name: np.empty((len(physics), *value.shape[1:])) for name, value in self._fields.items()}
        for first in range(0, len(physics), CHUNK):
            count = min(CHUNK, len(physics) - first)
            ids = np.arange(count)
            self._batch.state[np.ix_(ids, self._columns)] = physics[first : first + count]
            self._batch.forward(ids=ids, stage=int(mujoco.mjtStage.mjSTAGE_POS))
            for name, value in self._fields.items():
                out[name][first : first + count] = value[:count]
        return out


def camera_ids(task: Task) -> list[int]:
    """The model's camera behind each view."""
    return [camera if isinstance(camera, int) else task.model.camera(camera).id for camera in task.cameras]


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) as quaternions (..., 4), w x y z with w >= 0."""
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat(canonical=True)
    return xyzw[:, [3, 0, 1, 2]].reshape(*matrices.shape[:-2], 4)


def matrices(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4), w x y z, normalized here, as rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def nominal_cameras(task: Task, physics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The model's own cameras at physics states.

    Args:
      physics: (frame, physics) float64.

    Returns:
      position (frame, view, 3) and quaternion (frame, view, 4), float32.
    """
    ids = camera_ids(task)
    found = Kinematics(task, ("cam_xpos", "cam_xmat"))(physics)
    position = found["cam_xpos"][:, ids]
    rotation = found["cam_xmat"][:, ids].reshape(len(physics), len(ids), 3, 3)
    return position.astype(np.float32), quaternions(rotation).astype(np.float32)


def centers_of_mass(task: Task, physics: np.ndarray) -> np.ndarray:
    """(frame, physics) -> (frame, 3) float64: centre of mass of the body that the first camera tracks, meters."""
    body = int(task.model.cam_bodyid[camera_ids(task)[0]])
    return Kinematics(task, ("subtree_com",))(physics)["subtree_com"][:, body]
