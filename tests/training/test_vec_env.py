"""Tasks as environments: dm_control's numbers, correct episode ends."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from dm_control import suite

from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import PHYSICS_SPEC
from dmcvb_gen.training.vec_env import TaskVecEnv


@pytest.mark.parametrize("task_id", ("walker-walk", "cheetah-run"))
def test_steps_agree_with_dm_control(task_id):
    task = get_task(task_id)
    env, peer = TaskVecEnv(task, 2, seed=3), suite.load(*task_id.split("-"))
    peer.reset()
    env.reset()
    data = mujoco.MjData(task.model)
    mujoco.mj_setState(task.model, data, env.batch.physics()[1], PHYSICS_SPEC)
    with peer.physics.reset_context():
        peer.physics.data.qpos[:], peer.physics.data.qvel[:] = data.qpos, data.qvel
    peer.physics.data.qacc_warmstart[:] = data.qacc_warmstart
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = rng.uniform(-1, 1, (2, task.action_size)).astype(np.float32)
        observation, reward, _, _ = env.step(actions)
        steps = [peer.step(actions[1]) for _ in range(2)]
        flat = np.concatenate([np.ravel(part) for part in steps[-1].observation.values()])
        np.testing.assert_allclose(observation[1], flat, rtol=1e-5, atol=1e-5)
        assert reward[1] == pytest.approx(sum(step.reward for step in steps), abs=1e-5)


def test_a_time_limit_is_a_truncation_and_shows_the_last_observation_of_the_old_episode():
    task = get_task("cheetah-run")
    env, twin = TaskVecEnv(task, 2, seed=5), TaskVecEnv(task, 2, seed=5)
    first = env.reset()
    twin.reset()
    action, total = np.full((2, task.action_size), 0.3, np.float32), np.zeros(2)
    for step in range(1, task.max_steps + 1):
        observation, reward, done, infos = env.step(action)
        last = twin.batch.step(action).state  # the same simulations, never restarted
        total += reward
        assert done.all() == (step == task.max_steps) and done.any() == done.all()
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        np.testing.assert_array_equal(info["terminal_observation"], last[i].astype(np.float32))
        assert info["episode"]["l"] == task.max_steps and info["episode"]["r"] == pytest.approx(total[i], abs=1e-2)
        assert not np.allclose(observation[i], info["terminal_observation"])
        assert not np.allclose(observation[i], first[i])  # a new initial state, not the first again


def test_only_the_episode_that_terminates_restarts_and_it_is_no_truncation(monkeypatch):
    task = get_task("walker-walk")
    env = TaskVecEnv(task, 3, seed=0)
    env.reset()
    monkeypatch.setattr(env.batch, "_control_terminated", lambda: np.array([False, True, False]))
    _, _, done, infos = env.step(np.zeros((3, task.action_size), np.float32))
    assert done.tolist() == [False, True, False]
    assert [info["TimeLimit.truncated"] for info in infos] == [False] * 3
    assert ["terminal_observation" in info for info in infos] == [False, True, False]
    assert env._length.tolist() == [1, 0, 1]


def test_a_seed_gives_the_same_episodes_again():
    task = get_task("walker-walk")
    env = TaskVecEnv(task, 2, seed=1)
    first = env.reset()
    assert not np.array_equal(env.reset(), first)
    env.seed(1)
    np.testing.assert_array_equal(env.reset(), first)
