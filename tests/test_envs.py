"""Environments: Gymnasium's checker passes; physics, rewards and pictures are those of the tasks and renderers."""

from __future__ import annotations

import subprocess
import sys
import unittest

import dm_env
import gymnasium
import numpy as np
import pytest
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.readers.dm import DmEnv
from dmcvb_gen.readers.envs import DistractedEnv
from dmcvb_gen.readers.register import MAZES, SETTINGS, TASKS, environment_ids
from dmcvb_gen.store import open_release
from dmcvb_gen.tasks import ANT_MAZE_TASKS, LOCOMOTION_TASKS, get_task

SMALL = dict(size=16, samples=1)


def test_every_task_and_distractor_is_registered():
    assert TASKS == LOCOMOTION_TASKS and MAZES == ANT_MAZE_TASKS
    assert len(environment_ids()) == len(TASKS) * len(SETTINGS) + 2 * len(MAZES)
    assert set(environment_ids()) <= set(gymnasium.registry)


def test_importing_the_package_is_enough_and_loads_no_simulator():
    code = "import dmcvb_gen, gymnasium as g, sys; print('dmcvb_gen/walker-walk-none-v0' in g.registry)"
    code += "; print('mujoco' in sys.modules, 'torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert found == ["True", "False", "False"]


@pytest.mark.parametrize("name", [f"dmcvb_gen/{task}-{s}-v0" for task, s in zip(TASKS, SETTINGS[::-1], strict=True)])
def test_gymnasiums_checker_passes(name):
    env = gymnasium.make(name, render_mode="rgb_array", **SMALL)
    check_env(env.unwrapped, skip_render_check=False)
    assert env.metadata["render_fps"] in (20, 50)
    env.close()


def test_states_and_rewards_are_the_tasks_own():
    env, task = gymnasium.make("dmcvb_gen/cheetah-run-static-v0", **SMALL), get_task("cheetah-run")
    observation, _ = env.reset(seed=4)
    batch = task.batch(1)
    batch.set_physics(env.unwrapped._stage.batch.physics())
    rng, total = np.random.default_rng(0), 0.0
    for step in range(500):
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        painted = step < 8 or step == 499
        observation, reward, terminated, truncated, _ = env.step(action) if painted else quick(env, action)
        result = batch.step(action[None])
        total += reward
        assert reward == result.reward[0] and not terminated and truncated == (step == 499)
        if observation is not None:
            np.testing.assert_array_equal(observation["state"], result.state[0].astype(np.float32))


def quick(env, action):
    """A step without its picture, to save the time of the test."""
    reward, terminated, truncated = env.unwrapped._stage.step(action[None], np.ones(1, bool))
    return None, float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}


def test_a_vector_environment_has_the_episodes_of_single_ones():
    vector = gymnasium.make_vec("dmcvb_gen/walker-walk-dynamic-v0", num_envs=3, **SMALL)
    observations, _ = vector.reset(seed=10)
    singles = [DistractedEnv("walker-walk", "dynamic", **SMALL) for _ in range(3)]
    for i, env in enumerate(singles):
        first, _ = env.reset(seed=10 + i)
        np.testing.assert_array_equal(observations["pixels"][i], first["pixels"])
    actions = np.random.default_rng(1).uniform(-1, 1, (5, 3, 6)).astype(np.float32)
    for action in actions:
        observations, rewards, *_ = vector.step(action)
        assert vector.observation_space.contains(observations)
        for i, env in enumerate(singles):
            one, reward, *_ = env.step(action[i])
            assert rewards[i] == reward
            np.testing.assert_array_equal(observations["state"][i], one["state"])
            np.testing.assert_array_equal(observations["pixels"][i], one["pixels"])
    assert len({observations["pixels"][i].tobytes() for i in range(3)}) == 3


def test_ended_episodes_restart_at_the_next_step_without_a_reward():
    vector = gymnasium.make_vec("dmcvb_gen/walker-walk-none-v0", num_envs=2, **SMALL)
    vector.reset(seed=0)
    vector.unwrapped._stage.frame[:] = [499, 10]
    actions = np.zeros((2, 6), np.float32)
    _, _, _, truncated, _ = vector.step(actions)
    assert list(truncated) == [True, False]
    _, rewards, terminated, truncated, _ = vector.step(actions)
    assert list(vector.unwrapped._stage.frame) == [0, 12] and not truncated.any() and not terminated.any()
    assert rewards[0] == 0 and rewards[1] > 0


def test_seeds_decide_everything_and_later_episodes_differ():
    env = DistractedEnv("walker-walk", "dynamic", **SMALL)
    first, second = env.reset(seed=1)[0], env.reset()[0]
    assert (first["pixels"] != second["pixels"]).any() and (first["state"] != second["state"]).any()
    again, second_again = env.reset(seed=1)[0], env.reset()[0]
    np.testing.assert_array_equal(first["pixels"], again["pixels"])
    np.testing.assert_array_equal(second["pixels"], second_again["pixels"])


def test_pictures_are_those_that_the_store_has_for_the_same_physics_and_labels(small_release):
    env = DistractedEnv("walker-walk", "none", **SMALL)
    env.reset(seed=0)
    episode = open_release(small_release)["walker-walk/random/none"].episode(0)
    for step in (0, 250, 500):
        env._stage.state = env._stage.batch.set_physics(episode["physics"][step : step + 1])
        np.testing.assert_array_equal(env._stage.observe()["pixels"][0], episode["pixels"][step])


def test_a_maze_shows_its_views_and_hides_its_goal():
    views = ["top", "egocentric"]
    seen, hidden = (
        gymnasium.make(f"dmcvb_gen/ant-maze-empty7x7-{goal}-v0", views=views, size=32, samples=1)
        for goal in ("visible", "hidden")
    )
    one, other = seen.reset(seed=1)[0], hidden.reset(seed=1)[0]
    np.testing.assert_array_equal(one["state"], other["state"])
    assert one["pixels"].shape == (32, 32, 6) and (one["pixels"][..., :3] != other["pixels"][..., :3]).any()
    _, reward, terminated, truncated, _ = seen.step(seen.action_space.sample())
    assert -2 <= reward <= 0 and not terminated and not truncated
    with pytest.raises(DmcvbError, match="egocentric"):
        DistractedEnv("ant-maze-empty7x7", "visible", views=["behind"])
    with pytest.raises(DmcvbError, match="hidden"):
        DistractedEnv("ant-maze-empty7x7", "dynamic")


def test_evaluation_shows_videos_that_training_does_not():
    val, train = (DistractedEnv("walker-walk", "static", split=split, **SMALL) for split in ("val", "train"))
    assert val._stage.backgrounds.digest != train._stage.backgrounds.digest


def test_mistakes_are_answered():
    with pytest.raises(DmcvbError, match="hard"):
        DistractedEnv("walker-walk", "static", difficulty="harsh")
    with pytest.raises(DmcvbError, match="8 to 1024"):
        DistractedEnv("walker-walk", size=2)
    with pytest.raises(DmcvbError, match="rgb_array"):
        DistractedEnv("walker-walk", render_mode="human")
    with pytest.raises(DmcvbError, match="call reset"):
        DistractedEnv("walker-walk").step(np.zeros(6))


class TestDmEnv(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own conformance tests."""

    def make_object_under_test(self):
        return DmEnv("walker-walk", "none", seed=0, **SMALL)

    def make_action_sequence(self):
        for _ in range(5):
            yield self.make_action()


def test_the_dm_environment_has_the_gymnasium_episodes():
    one, other = DmEnv("walker-walk", "dynamic", seed=7, **SMALL), DistractedEnv("walker-walk", "dynamic", **SMALL)
    first, (observation, _) = one.reset(), other.reset(seed=7)
    np.testing.assert_array_equal(first.observation["pixels"], observation["pixels"])
    one._env._stage.frame[:] = 499
    last = one.step(np.ones(6, np.float32))
    assert last.last() and last.discount == 1 and one.step(np.ones(6, np.float32)).step_type == dm_env.StepType.FIRST
