"""Our batched tasks against dm_control's own environments."""

from __future__ import annotations

import sys

import mujoco
import numpy as np
import pytest
from dm_control import suite
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.own_code import TASKS as ALLOWED
from dmcvb_gen.own_code import allow
from dmcvb_gen.release.verify import verify
from dmcvb_gen.tasks import ACTION_REPEAT, LOCOMOTION_TASKS, PHYSICS_SPEC, REGISTRY, get_task, register_task, suite_ids
from dmcvb_gen.tasks.base import tolerance
from dmcvb_gen.tasks.suite import REFUSED, SuiteTask
from tests.conftest import roll_out

TOLERANCE = {"walker-walk": 0.0, "cheetah-run": 0.0, "humanoid-walk": 1e-15}
"""Largest difference of an observation; physics states are always equal. Humanoid's limb positions are one matrix
product for the batch here and a vector product a limb in dm_control: the order of three additions differs."""
REWARD_TOLERANCE = 1e-15
"""Rewards are the same formula, in which a square or a root of an array may round its last bit differently."""
SIMULATIONS = 2
SUITE = (
    "acrobot-swingup", "ball_in_cup-catch", "cartpole-balance", "cartpole-swingup", "cheetah-run", "dog-walk",
    "finger-spin", "finger-turn_hard", "fish-swim", "hopper-hop", "hopper-stand", "humanoid-stand", "humanoid-walk",
    "humanoid-run", "pendulum-swingup", "point_mass-easy", "quadruped-walk", "reacher-easy", "reacher-hard",
    "swimmer-swimmer6", "walker-stand", "walker-walk", "walker-run", "manipulator-bring_ball", "lqr-lqr_2_1",
)  # fmt: skip
"""Tasks of dm_control's suite: all domains but humanoid_CMU and stacker, whose physics costs more than it shows."""


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


@pytest.mark.slow
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


@pytest.mark.parametrize(
    "task_id",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "dog-walk" else ())
        for name in SUITE
        if name not in LOCOMOTION_TASKS
    ],
)
def test_a_task_of_the_suite_agrees_with_dm_control_step_by_step(task_id):
    task = get_task(task_id)
    batch = task.batch(SIMULATIONS)
    state = batch.reset([np.random.default_rng(seed) for seed in range(SIMULATIONS)])
    names, rows = task_id.split("-", 1), batch.physics()
    environments = [suite.load(*names, task_kwargs={"random": 0}) for _ in range(SIMULATIONS)]
    for i, environment in enumerate(environments):
        environment.reset()
        physics = environment.physics
        for name, columns, values in task.split_entries(rows):
            getattr(physics.model.ptr, name).reshape(-1)[columns] = values[i]
        size = mujoco.mj_stateSize(task.model, PHYSICS_SPEC)
        mujoco.mj_setState(physics.model.ptr, physics.data.ptr, rows[i, :size], PHYSICS_SPEC)
        physics.after_reset()
        theirs = environment.task.get_observation(physics)
        assert {name: np.size(part) for name, part in theirs.items()} == task.state_fields
        np.testing.assert_allclose(state[i], np.concatenate([np.ravel(part) for part in theirs.values()]), atol=1e-6)
    rng = np.random.default_rng(7)
    for _ in range(15):
        action = rng.uniform(-1, 1, (SIMULATIONS, task.action_size)).astype(np.float32)
        result = batch.step(action)
        for i, environment in enumerate(environments):
            steps = [environment.step(action[i]) for _ in range(ACTION_REPEAT)]
            theirs = np.concatenate([np.ravel(part) for part in steps[-1].observation.values()])
            np.testing.assert_allclose(result.state[i], theirs, rtol=0, atol=1e-6)
            assert abs(result.reward[i] - sum(step.reward for step in steps)) <= 1e-6
    other = task.batch(SIMULATIONS)
    known = np.ones(task.state_size, bool)
    for name in task.unstored_fields:
        known[task.state_slices[name]] = False
    np.testing.assert_array_equal(other.set_physics(batch.physics())[:, known], result.state[:, known])
    action = rng.uniform(-1, 1, action.shape)
    one, two = batch.step(action), other.step(action)
    np.testing.assert_array_equal(one.state, two.state)
    np.testing.assert_array_equal(one.reward, two.reward)


def test_episodes_of_a_suite_task_depend_on_their_own_streams_alone():
    task = get_task("reacher-hard")
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, task.action_size))

    def run(seeds, threads):
        batch = task.batch(len(seeds), threads)
        batch.reset([np.random.default_rng(seed) for seed in seeds])
        for action in actions:
            batch.step(action[: len(seeds)])
        return batch.physics()

    np.testing.assert_array_equal(run([0, 1, 2], 2)[:1], run([0], 1))
    assert len(np.unique(run([0, 1, 2], 1)[:, -1])) == 3  # each has its own target


def test_the_suite_is_known_without_importing_it():
    assert {f"{domain}-{name}" for domain, name in suite.ALL_TASKS} == {*suite_ids(), *REFUSED}


@pytest.mark.parametrize("task_id", REFUSED)
def test_a_suite_task_that_cannot_be_used_is_refused_in_one_line(task_id):
    with pytest.raises(DmcvbError, match="a new terrain"):
        get_task(task_id)


def ten_lines(tmp_path, monkeypatch, code):
    """A module of one's own, `arm_tasks`, in the working directory."""
    (tmp_path / "arm_tasks.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "arm_tasks", raising=False)
    monkeypatch.delenv(ALLOWED, raising=False)


ARM = """<mujoco><worldbody><light pos="0 0 3"/><camera name="side" pos="0 -2 1"/>
<body pos="0 0 .8"><joint name="hinge" axis="0 1 0"/><geom type="capsule" size=".05" fromto="0 0 0 .5 0 0"/></body>
</worldbody><actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
GROWING = (
    """
from dm_control import suite
def reach():
    environment = suite.load("reacher", "easy")
    environment.task.get_observation = lambda physics: {"contacts": physics.data.qpos[: 1 + (physics.time() > 0.03)]}
    return environment
def number():
    return 7
def broken():
    return 1 / 0
def strong():
    return mjcf_environment(ARM.replace("-1 1", "-5 5"))
def odd():
    environment = mjcf_environment(ARM)
    environment.task.before_step = lambda action, physics: physics.set_control(2 * action - 1)
    return environment
def blind():
    return mjcf_environment(ARM.replace('<camera name="side" pos="0 -2 1"/>', ""))
ARM = """
    + repr(ARM)
    + """
def mjcf_environment(xml):
    import tempfile
    from dmcvb_gen.tasks import own
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(xml)
        file.flush()
        return own.mjcf_environment(file.name, lambda physics: 0.0)
"""
)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("reach", "observes 'contacts' in different shapes"),
        ("number", "gives a int; give a function that returns"),
        ("broken", "cannot start task arm_tasks:broken .division by zero"),
        ("missing", "cannot find task arm_tasks:missing"),
        ("strong", "takes actions from -5 to 5; actions here are from -1 to 1"),
        ("odd", "changes actions in before_step"),
        ("blind", "has no camera to look through"),
    ],
)
def test_a_task_of_ones_own_that_cannot_be_used_is_refused(tmp_path, monkeypatch, name, message):
    ten_lines(tmp_path, monkeypatch, GROWING)
    with pytest.raises(DmcvbError, match="set DMCVB_GEN_TASKS"):
        get_task(f"arm_tasks:{name}")
    allow([f"arm_tasks:{name}"])
    with pytest.raises(DmcvbError, match=message):
        get_task(f"arm_tasks:{name}")


FAILING = (
    "ARM = "
    + repr(ARM)
    + """
from dmcvb_gen.tasks import own
def made(reward, observe=None):
    with open("arm.xml", "w") as file:
        file.write(ARM)
    return own.mjcf_environment("arm.xml", reward, observe)
def late(physics):
    if physics.time() > 0.03:
        raise ValueError("no", "two")
    return {"position": physics.data.qpos.copy()}
def reward_of_a_dictionary(physics):
    raise KeyError("left")
def breaks():
    return made(reward_of_a_dictionary)
def blinks():
    return made(lambda physics: 0.0, late)
def nothing():
    return made(lambda physics: None)
def nan():
    return made(lambda physics: float("nan") if physics.time() > 0.03 else 1.0)
def infinite():
    return made(lambda physics: float("inf"))
"""
)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("breaks", r"failed \(KeyError: 'left'\)"),
        ("blinks", r"failed \(ValueError: \('no', 'two'\)\)"),
        ("nothing", r"failed \(TypeError: .*None.*\)"),
        ("nan", "gave the reward nan; its reward must be a finite number"),
        ("infinite", "gave the reward inf; its reward must be a finite number"),
    ],
)
def test_a_task_of_ones_own_that_fails_in_an_episode_is_told_in_one_line(tmp_path, monkeypatch, name, message):
    ten_lines(tmp_path, monkeypatch, FAILING)
    monkeypatch.setenv(ALLOWED, f"other:task, arm_tasks:{name} ,")  # as people write lists
    task = get_task(f"arm_tasks:{name}")
    batch = task.batch(2)
    batch.reset([np.random.default_rng(seed) for seed in range(2)])
    with pytest.raises(DmcvbError, match=f"^task arm_tasks:{name} {message}$"):
        for _ in range(40):
            batch.step(np.zeros((2, 1)))


GOAL = (
    "ARM = "
    + repr(ARM.replace('pos="0 -2 1"', 'pos="0 -2 1" xyaxes="1 0 0 0 .4 1"'))
    + """
from dm_control.rl import control
from dm_control.suite import base
from dm_control import mujoco
class Reach(base.Task):
    def initialize_episode(self, physics):
        self._goal = self.random.uniform(-1, 1)
    def get_observation(self, physics):
        return {"position": physics.data.qpos.copy(), "goal": [self._goal]}
    def get_reward(self, physics):
        return -abs(physics.data.qpos[0] - self._goal)
def reach():
    return control.Environment(mujoco.Physics.from_xml_string(ARM), Reach(), time_limit=0.4)
"""
)


def test_what_a_task_keeps_in_python_alone_is_not_taken_for_damage(tmp_path, monkeypatch):
    ten_lines(tmp_path, monkeypatch, GOAL)
    monkeypatch.setenv(ALLOWED, "arm_tasks:reach")
    assert get_task("arm_tasks:reach").unstored_fields == ("goal",)
    assert get_task("reacher-easy").unstored_fields == ()  # its target lies in the model
    pattern = {"tasks": "arm_tasks:reach", "levels": "random", "settings": "none", "episodes": 2}
    roll_out(make_recipe({"name": "r", "size": 16, "subsets": [pattern]}), tmp_path / "r")
    assert verify(tmp_path / "r").sound


def test_a_third_party_registers_a_task():
    register_task("cartpole-mine", lambda: SuiteTask("cartpole-mine", lambda: suite.load("cartpole", "balance")))
    try:
        assert get_task("cartpole-mine").state_size == 5
        with pytest.raises(DmcvbError, match="there is a task 'cartpole-mine' already"):
            register_task("cartpole-mine", lambda: None)
        get_task.cache_clear()
        REGISTRY["cartpole-mine"] = lambda: 3
        with pytest.raises(DmcvbError, match="task cartpole-mine is a int; register a function that returns a Task"):
            get_task("cartpole-mine")
    finally:
        REGISTRY.pop("cartpole-mine")
        get_task.cache_clear()


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
    with pytest.raises(UnknownNameError, match="Did you mean 'walker-walk'.*walker-run.* and .* more") as caught:
        get_task("walker-wakl")
    assert len(str(caught.value)) < 300
    with pytest.raises(UnknownNameError, match="unknown task 'zzzz'. Known: [a-z-]+, .* and .* more"):
        get_task("zzzz")
    for domain, name in (("walker", "walker-walk"), ("humanoid", "humanoid-walk"), ("ant-maze", "ant-maze-empty7x7")):
        with pytest.raises(UnknownNameError, match=f"Did you mean '{name}'"):  # DMC-VB's own come first
            get_task(domain)


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
