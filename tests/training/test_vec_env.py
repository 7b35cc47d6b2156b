"""Tasks as environments of Stable-Baselines3: dm_control's numbers, correct episode ends."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from dm_control import suite

from dmcvb_gen.tasks import get_task
from dmcvb_gen.training.vec_env import TaskVecEnv


@pytest.mark.parametrize("task_id", ("walker-walk", "quadruped-walk"))
def test_steps_agree_with_dm_control(task_id):
    """Quadruped's bounds are not -1 to 1."""
    task = get_task(task_id)
    env, peer = TaskVecEnv(task, 2, seed=3), suite.load(*task_id.split("-"))
    peer.reset()
    env.reset()
    data = mujoco.MjData(task.model)
    mujoco.mj_setState(task.model, data, env.episodes._batch.physics()[1], task.physics_spec)
    with peer.physics.reset_context():
        peer.physics.data.qpos[:], peer.physics.data.qvel[:] = data.qpos, data.qvel
    peer.physics.data.act[:], peer.physics.data.qacc_warmstart[:] = data.act, data.qacc_warmstart
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.uniform(task.action_low, task.action_high, (2, task.action_size)).astype(np.float32)
        _, reward, _, _ = env.step(actions)
        assert reward[1] == pytest.approx(sum(peer.step(actions[1]).reward for _ in range(2)), abs=1e-4)


def test_an_episode_that_ends_shows_its_last_observation_and_whether_only_time_ended_it(monkeypatch):
    task = get_task("walker-walk")
    env, twin = (TaskVecEnv(task, 2, seed=5) for _ in range(2))
    first = env.reset()
    np.testing.assert_array_equal(first, twin.reset())
    action = np.full((2, task.action_size), 0.3, np.float32)
    for step in range(1, task.max_steps + 1):
        observation, _, done, infos = env.step(action)
        if step < task.max_steps // 2:
            twin.step(action)
        if step == task.max_steps // 2:  # so that ends do not fall together, the second one's first episode is short
            twin.episodes._elapsed[:] = 0
            assert done.tolist() == [False, True] and infos[1]["TimeLimit.truncated"]
            np.testing.assert_array_equal(infos[1]["terminal_observation"], twin.step(action)[0][1])
            assert not np.allclose(observation[1], infos[1]["terminal_observation"])
            assert not np.allclose(observation[1], first[1])  # a new initial state, not the first again
    assert done.tolist() == [True, False]
    monkeypatch.setattr(env.episodes._batch, "_control_terminated", lambda: np.array([False, True]))
    _, _, done, infos = env.step(action)
    assert done.tolist() == [False, True] and not any(info["TimeLimit.truncated"] for info in infos)
    assert ["terminal_observation" in info for info in infos] == [False, True]
