"""Compute the poses of cameras, bodies, geoms and lights from physics states, in batches and in float64."""

from __future__ import annotations

import copy
import functools
import threading
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch

from dmcvb_gen.tasks.base import Task, physics_columns

CHUNK = 512
"""States a call into MuJoCo at most; only memory depends on it."""
KEPT = 2
"""Tasks whose simulations are kept, those asked for last."""


@functools.lru_cache(maxsize=KEPT)
class Kinematics:
    """Forward kinematics of a task's physics states; may be called from several threads.

    A task's simulations are made once, as many as the largest call needs (up to `CHUNK`).

    Args:
      task: whose model it is.
    """

    def __init__(self, task: Task):
        self._task, self._columns = task, physics_columns(task.model, task.physics_spec)
        self._lock = threading.Lock()  # the simulations are one caller's until it has copied its poses
        self._size = 0

    def __call__(self, physics: np.ndarray, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """(frame, physics) float64 -> each field of MjData with a leading frame axis, float64.

        A frame's poses do not depend on the other frames.
        """
        lead, physics = physics.shape[:-1], physics.reshape(-1, physics.shape[-1])
        with self._lock:
            if (size := min(max(len(physics), 1), CHUNK)) > self._size:
                self._make(size)
            self._bound |= {name: self._batch.bind(name) for name in fields if name not in self._bound}
            out = {name: np.empty((len(physics), *self._bound[name].shape[1:])) for name in fields}
            for first in range(0, len(physics), self._size):
                count = min(self._size, len(physics) - first)
                ids = np.arange(count)
                rows = physics[first : first + count]
                self._batch.state[np.ix_(ids, self._columns)] = rows[:, : len(self._columns)]
                for name, columns, values in self._task.split_entries(rows):
                    if name in self._entries:
                        self._entries[name].reshape(self._size, -1)[np.ix_(ids, columns)] = values
                self._batch.forward(ids=ids, stage=int(mujoco.mjtStage.mjSTAGE_POS))
                for name in fields:
                    out[name][first : first + count] = self._bound[name][:count]
        return {name: value.reshape(*lead, *value.shape[1:]) for name, value in out.items()}

    def _make(self, size: int) -> None:
        self._size = 1 << (size - 1).bit_length()
        model = self._task.model
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            model = copy.deepcopy(model)  # simulations that share memory cannot sleep, and poses do not depend on it
            model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        self._batch = Batch(model, self._size, nthread=1)
        self._bound: dict[str, Any] = {}
        moving = (name for name in self._task.model_entries if name in MODEL_FIELDS)  # others move nothing
        self._entries = {name: self._batch.expand(name) for name in moving}


def camera_ids(task: Task) -> list[int]:
    """The model's camera behind each view."""
    return [camera if isinstance(camera, int) else task.model.camera(camera).id for camera in task.cameras]


def seen_materials(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the materials of what MuJoCo draws: geoms, and the sites and tendons of the groups 0, 1 and 2."""
    shown = [model.geom_matid, model.site_matid[model.site_group < 3], model.tendon_matid[model.tendon_group < 3]]
    return np.unique(np.concatenate(shown))


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) as quaternions (..., 4), w x y z with w >= 0."""
    # Scipy takes a fifth of a second, which commands that list or show need not wait for.
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(matrices.reshape(-1, 3, 3))
    return rotation.as_quat(canonical=True, scalar_first=True).reshape(*matrices.shape[:-2], 4)


def matrices(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4), w x y z, normalized here, as rotation matrices (..., 3, 3) float64."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(np.asarray(quaternion, np.float64).reshape(-1, 4), scalar_first=True)
    return rotation.as_matrix().reshape(*quaternion.shape[:-1], 3, 3)


def nominal_cameras(task: Task, physics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The model's own cameras at physics states.

    Args:
      physics: (frame, physics) float64.

    Returns:
      position (frame, view, 3) and quaternion (frame, view, 4), float32.
    """
    ids = camera_ids(task)
    found = Kinematics(task)(physics, ("cam_xpos", "cam_xmat"))
    position, rotation = found["cam_xpos"][..., ids, :], found["cam_xmat"][..., ids, :]
    rotation = rotation.reshape(*position.shape, 3)
    return position.astype(np.float32), quaternions(rotation).astype(np.float32)


def centers_of_mass(task: Task, physics: np.ndarray) -> np.ndarray:
    """(frame, physics) -> (frame, 3) float64: centre of mass of the body that the first camera tracks, meters.

    A camera of the world tracks nothing: it stays by the centre of mass of the model's own pose.
    """
    camera = camera_ids(task)[0]
    body = int(task.model.cam_bodyid[camera])
    if body == 0:
        return np.tile(task.model.cam_pos0[camera] - task.model.cam_poscom0[camera], (*physics.shape[:-1], 1))
    return Kinematics(task)(physics, ["subtree_com"])["subtree_com"][..., body, :]
