"""Our batched tasks against dm_control's own environments."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from dm_control import suite
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.tasks import ACTION_REPEAT, LOCOMOTION_TASKS, PHYSICS_SPEC, get_task
from dmcvb_gen.tasks.base import tolerance

TOLERANCE = {"walker-walk": 0.0, "cheetah-run": 0.0, "humanoid-walk": 1e-15}
"""Largest difference of an observation; physics states are always equal. Humanoid's limb positions are one matrix
product for the batch here and a vector product a limb in dm_control: the order of three additions differs."""
REWARD_TOLERANCE = 1e-15
"""Rewards are the same formula, in which a square or a root of an array may round its last bit differently."""
SIMULATIONS = 2


def dm_control_observation(task_id, observation):
    names = sorted(observation) if task_id == "humanoid-walk" else observation
    return np.concatenate([np.atleast_1d(observation[name]) for name in names])


def dm_control_physics(physics, size):
    state = np.empty(size)
    mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, PHYSICS_SPEC)
    return state


def actions_of(kind, rng, size):
    if kind == "zero":
        return np.zeros(size)
    if kind == "extreme":
        return rng.choice([-1.0, 1.0, 5.0, -5.0], size)  # beyond the limits, which MuJoCo clips
    return rng.uniform(-1, 1, size)


@pytest.mark.parametrize("kind", ["random", "extreme", "zero"])
@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_a_whole_episode_agrees_with_dm_control(task_id, kind):
    task = get_task(task_id)
    batch = task.batch(SIMULATIONS)
    state = batch.reset([np.random.default_rng(seed) for seed in range(SIMULATIONS)])
    environments = [suite.load(*task_id.split("-")) for _ in range(SIMULATIONS)]
    for environment, physics, own in zip(environments, batch.physics(), state, strict=True):
        environment.reset()
        mujoco.mj_setState(environment.physics.model.ptr, environment.physics.data.ptr, physics, PHYSICS_SPEC)
        environment.physics.forward()
        theirs = dm_control_observation(task_id, environment.task.get_observation(environment.physics))
        np.testing.assert_allclose(own, theirs, rtol=0, atol=TOLERANCE[task_id])
    rng = np.random.default_rng(7)
    for _ in range(task.max_steps):
        action = actions_of(kind, rng, (SIMULATIONS, task.action_size))
        result = batch.step(action)
        assert not result.terminated.any()
        physics = batch.physics()
        for i, environment in enumerate(environments):
            reward = 0.0
            for _ in range(ACTION_REPEAT):
                step = environment.step(action[i])
                reward += step.reward
            np.testing.assert_array_equal(physics[i], dm_control_physics(environment.physics, task.physics_size))
            theirs = dm_control_observation(task_id, step.observation)
            np.testing.assert_allclose(result.state[i], theirs, rtol=0, atol=TOLERANCE[task_id])
            assert abs(result.reward[i] - reward) <= REWARD_TOLERANCE
    assert all(environment.step(action[0]).first() for environment in environments)  # their episode ended with ours


@pytest.mark.parametrize("task_id, sizes", [("walker-walk", 24), ("cheetah-run", 17), ("humanoid-walk", 67)])
def test_state_fields_cover_the_state_in_order(task_id, sizes):
    task = get_task(task_id)
    slices = list(task.state_slices.values())
    assert task.state_size == sizes == slices[-1].stop
    assert slices[0].start == 0 and all(a.stop == b.start for a, b in zip(slices, slices[1:], strict=False))


@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_a_simulation_does_not_depend_on_its_neighbors_or_threads(task_id):
    task = get_task(task_id)
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 3, task.action_size))

    def run(seeds, threads):
        batch = task.batch(len(seeds), threads)
        batch.reset([np.random.default_rng(seed) for seed in seeds])
        for action in actions:
            batch.step(action[: len(seeds)])
        return batch.physics()

    np.testing.assert_array_equal(run([0, 1, 2], 1)[:1], run([0], 1))
    np.testing.assert_array_equal(run([0, 1, 2], 1), run([0, 1, 2], 2))


@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_a_stored_physics_state_continues_with_the_same_bits(task_id):
    task, rng = get_task(task_id), np.random.default_rng(1)
    batch = task.batch(2)
    batch.reset([np.random.default_rng(5), np.random.default_rng(6)])
    for _ in range(20):
        batch.step(rng.uniform(-1, 1, (2, task.action_size)))
    stored, action = batch.physics(), rng.uniform(-1, 1, (2, task.action_size))
    expected = batch.step(action)
    other = task.batch(2)
    other.set_physics(stored)
    found = other.step(action)
    np.testing.assert_array_equal(found.state, expected.state)
    np.testing.assert_array_equal(found.reward, expected.reward)


def test_humanoid_starts_without_touching_anything():
    task = get_task("humanoid-walk")
    batch = task.batch(20)
    batch.reset([np.random.default_rng(seed) for seed in range(20)])
    assert (batch.sims.bind("ncon") == 0).all()


def test_inactive_simulations_stay_and_earn_nothing():
    task = get_task("cheetah-run")
    batch = task.batch(3)
    batch.reset([np.random.default_rng(seed) for seed in range(3)])
    before = batch.physics()
    result = batch.step(np.ones((3, 6)), active=np.array([True, False, True]))
    np.testing.assert_array_equal(batch.physics()[1], before[1])
    assert result.reward[1] == 0 and (batch.physics()[[0, 2]] != before[[0, 2]]).any()


def test_an_unknown_task_lists_the_known_ones_and_the_nearest():
    with pytest.raises(UnknownNameError, match="Did you mean 'walker-walk'.*cheetah-run"):
        get_task("walker-wakl")


@given(
    st.floats(-20, 20),
    st.floats(-5, 5),
    st.floats(0, 5),
    st.floats(0.1, 5),
    st.sampled_from(["gaussian", "linear", "quadratic"]),
    st.floats(0.05, 0.9),
)
def test_tolerance_is_dm_controls(x, lower, width, margin, sigmoid, value_at_margin):
    from dm_control.utils import rewards

    theirs = rewards.tolerance(x, (lower, lower + width), margin, sigmoid, value_at_margin)
    ours = tolerance(np.array([x]), lower, lower + width, margin, sigmoid, value_at_margin)
    assert ours[0] == pytest.approx(theirs, rel=1e-12, abs=1e-12)
