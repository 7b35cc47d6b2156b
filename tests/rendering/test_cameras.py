"""Kinematics of stored states: MuJoCo's own, the same in any batch, one kept batch a task, also from threads."""

import copy
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from dmcvb_gen.tasks import cameras, get_task
from dmcvb_gen.tasks.cameras import Kinematics, centers_of_mass, nominal_cameras
from tests.conftest import TINY_MAZE, posed
from tests.distractors.test_distractors import physics_of
from tests.tasks import hostile_tasks as h
from tests.tasks.test_own_tasks import task_of

TASKS = ("walker-walk", TINY_MAZE, h.sleeping, h.drawn_model, h.DrawsItsModel)
FIELDS = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "subtree_com")


@pytest.mark.parametrize("task", TASKS)
def test_poses_are_mujocos_and_do_not_depend_on_the_frames_beside_them(task):
    task = get_task(task) if isinstance(task, str) else task_of(task)
    physics = physics_of(task, 5, 4)[:, -1]
    together = Kinematics(task)(physics, FIELDS)
    model = copy.deepcopy(task.model)
    for frame, state in enumerate(physics):
        task.apply_entries(model, state)
        data = posed(model, state, task.physics_spec)
        alone = Kinematics(task)(state[None], FIELDS)
        for name in FIELDS:
            expected = getattr(data, name)
            np.testing.assert_allclose(together[name][frame].ravel(), expected.ravel(), atol=1e-12)
            np.testing.assert_array_equal(alone[name][0], together[name][frame])
    np.testing.assert_array_equal(nominal_cameras(task, physics)[1][3:4], nominal_cameras(task, physics[3:4])[1])
    assert centers_of_mass(task, physics[:0]).shape == (0, 3)


def test_more_states_than_a_batch_holds_have_their_own_poses():
    task = type(get_task("walker-walk"))()  # for which no batch is kept
    few = physics_of(task, 3, 4)[:, -1]
    expected, many = centers_of_mass(task, few), np.tile(few, (cameras.CHUNK // 2, 1))
    np.testing.assert_array_equal(centers_of_mass(task, many), np.tile(expected, (cameras.CHUNK // 2, 1)))


def test_threads_get_their_own_states_poses():
    task = get_task("walker-walk")
    physics = physics_of(task, 8, 4)[:, -1]
    expected = [centers_of_mass(task, state[None]) for state in physics]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda i: centers_of_mass(task, physics[i % 8][None]), range(400)))
    for index, value in enumerate(found):
        np.testing.assert_array_equal(value, expected[index % 8])
