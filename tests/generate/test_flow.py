"""Optical flow against MuJoCo's own rays and poses, and against the pictures that it leads from one to the next."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dmcvb_gen.generate.modalities import get_modality
from dmcvb_gen.generate.render import look
from dmcvb_gen.tasks import PHYSICS_SPEC
from dmcvb_gen.tasks.cameras import camera_ids, matrices
from tests.conftest import posed
from tests.rendering.test_rendering import frames_of, renderer_of

SIZE = 64


def flow_by_rays(task, before, after, eye, next_eye, view, pixels):
    """(pixel, 2) flow of what MuJoCo's rays through pixels meet, and the geoms (-1: none) that they meet."""
    half = np.tan(np.radians(task.model.cam_fovy[camera_ids(task)[view]]) / 2)
    flows, geoms = [], []
    for row, column in pixels:
        ray = np.array([(2 * (column + 0.5) / SIZE - 1) * half, (1 - 2 * (row + 0.5) / SIZE) * half, -1.0])
        direction, geom = eye[1] @ ray, np.array([-1], np.int32)
        groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
        distance = mujoco.mj_ray(task.model, before, eye[0], direction, groups, 1, -1, geom)
        if geom[0] >= 0:
            point = eye[0] + distance * direction
            turn = before.geom_xmat[geom[0]].reshape(3, 3)
            own = turn.T @ (point - before.geom_xpos[geom[0]])
            point = after.geom_xmat[geom[0]].reshape(3, 3) @ own + after.geom_xpos[geom[0]]
            seen = next_eye[1].T @ (point - next_eye[0])
        else:
            seen = next_eye[1].T @ direction
        x, y = seen[:2] / -seen[2] / half
        flows.append([(x + 1) / 2 * SIZE - 0.5 - column, (1 - y) / 2 * SIZE - 0.5 - row])
        geoms.append(geom[0])
    return np.array(flows), np.array(geoms)


@pytest.mark.slow_cases("ant-maze-empty7x7-none")
@pytest.mark.parametrize(
    ("task_id", "setting"), [("walker-walk", "dynamic"), ("humanoid-walk", "none"), ("ant-maze-empty7x7", "none")]
)
def test_flow_is_that_of_points_on_mujocos_geoms(task_id, setting):
    task, distractor, physics, labels = frames_of(task_id, setting, 4)
    renderer, rng = renderer_of("native", task, distractor, SIZE), np.random.default_rng(0)
    view = task.views[-1]
    column = task.views.index(view)
    [seen] = look(renderer, physics[:1], labels[:1], [view], False, physics[1:2], labels[1:2])
    found = get_modality("flow").compute(seen)[0]
    segmentation = renderer.render_labels(physics[:1], labels[:1], [view])["segmentation"][0, 0]
    assert found.shape == (SIZE, SIZE, 2) and found.dtype == np.float32
    turns = matrices(labels.camera_quaternion[:2, column])
    eyes = list(zip(labels.camera_position[:2, column].astype(float), turns, strict=True))
    pixels = rng.integers(0, SIZE, (300, 2))
    poses = [posed(task.model, physics[i], PHYSICS_SPEC) for i in range(2)]
    expected, geoms = flow_by_rays(task, *poses, *eyes, column, pixels)
    same = geoms == segmentation[pixels[:, 0], pixels[:, 1]]
    assert same.mean() > 0.8  # sites, goals and mirror images apart
    moving = np.abs(found[pixels[same, 0], pixels[same, 1]] - expected[same]).max(axis=1)
    assert np.quantile(moving, 0.98) < 0.01 and len(set(geoms[same])) > 1
    renderer.close()
