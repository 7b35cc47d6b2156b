"""Our batched tasks against dm_control's own environments."""

from __future__ import annotations

import shutil
import sys

import numpy as np
import pytest
from dm_control import suite
from dm_control.utils import rewards

from dmcvb_gen.arithmetic import to_unit
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.generate.resolve import code_of_task
from dmcvb_gen.own_code import TASKS as ALLOWED
from dmcvb_gen.own_code import allow
from dmcvb_gen.release.verify import verify
from dmcvb_gen.tasks import LOCOMOTION_TASKS, PHYSICS_SPEC, get_task, suite_ids
from dmcvb_gen.tasks.base import tolerance
from tests.conftest import invoke, rewrite, roll_out, small_recipe
from tests.tasks.hostile_tasks import ARM, EndedByPython, arm
from tests.tasks.test_own_tasks import check_episode, rolled

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
    "quadruped-escape",
)  # fmt: skip
"""Tasks of dm_control's suite: all domains but humanoid_CMU and stacker, whose physics costs more than it shows."""
FAST = ("ball_in_cup-catch", "finger-spin", "point_mass-easy", "quadruped-walk", "reacher-hard", "lqr-lqr_2_1")


SLOW = (("random", 2), ("extreme", 2), ("zero", 2), ("random", 1))
"""Kinds of actions and action repeats."""
OTHERS = [name for name in SUITE if name not in LOCOMOTION_TASKS]


def dm_control_observation(task_id, observation):
    names = sorted(observation) if task_id == "humanoid-walk" else observation
    return np.concatenate([np.atleast_1d(observation[name]) for name in names])


def actions_of(kind, rng, size):
    if kind == "zero":
        return np.zeros(size)
    if kind == "extreme":
        return rng.choice([-1.0, 1.0, 5.0, -5.0], size)  # beyond the limits, which MuJoCo clips
    return rng.uniform(-1, 1, size)


@pytest.mark.parametrize(
    "kind, repeat", [("random", 4), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
@pytest.mark.parametrize("task_id", LOCOMOTION_TASKS)
def test_a_whole_episode_agrees_with_dm_control(task_id, kind, repeat):
    task = get_task(task_id).at(repeat)
    assert task.max_steps * repeat == 1000 and task.at(2) is get_task(task_id).at(2)
    batch = task.batch(SIMULATIONS)
    state = batch.reset([np.random.default_rng(seed) for seed in range(SIMULATIONS)])
    environments = [suite.load(*task_id.split("-")) for _ in range(SIMULATIONS)]
    for environment, physics, own in zip(environments, batch.physics(), state, strict=True):
        environment.reset()
        environment.physics.set_state(physics, PHYSICS_SPEC)
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
            for _ in range(repeat):
                step = environment.step(action[i])
                reward += step.reward
            np.testing.assert_array_equal(physics[i], environment.physics.get_state(PHYSICS_SPEC))
            theirs = dm_control_observation(task_id, step.observation)
            np.testing.assert_allclose(result.state[i], theirs, rtol=0, atol=TOLERANCE[task_id])
            assert abs(result.reward[i] - reward) <= REWARD_TOLERANCE
    assert all(environment.step(action[0]).first() for environment in environments)  # their episode ended with ours


@pytest.mark.parametrize(
    "task_id", [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in OTHERS]
)
def test_a_task_of_the_suite_is_dm_controls(task_id, monkeypatch):
    task = get_task(task_id)
    monkeypatch.setattr(task, "most_at_once", 1)  # the second episode in the same environment
    made = rolled(task, [0, 1], max_steps=8)
    for place in range(2):
        environment = suite.load(*task_id.split("-", 1), {"random": 0})  # from which lqr draws its model
        environment.physics._make_rendering_contexts = lambda: None  # terrain would be put on a graphics card
        check_episode(task, made, place, environment)


def test_actions_reach_the_bounds_of_quadruped_and_no_further():
    task = get_task("quadruped-walk")
    low, high = (task.from_unit(np.full((1, task.action_size), value, np.float32))[0] for value in (-1, 1))
    spec = suite.load("quadruped", "walk").action_spec()
    np.testing.assert_allclose([low, high], [spec.minimum, spec.maximum], rtol=1e-6)
    assert (low >= spec.minimum).all() and (high <= spec.maximum).all() and high.max() > 1
    quarter = task.from_unit(np.full((1, 12), 0.25, np.float32))
    np.testing.assert_allclose(to_unit(quarter, task.action_low, task.action_high), 0.25, atol=1e-6)


def test_the_suite_is_known_without_importing_it():
    assert {f"{domain}-{name}" for domain, name in suite.ALL_TASKS} == set(suite_ids())


def ten_lines(tmp_path, monkeypatch, code):
    """A module of one's own, `arm_tasks`, in the working directory."""
    (tmp_path / "arm_tasks.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "arm_tasks", raising=False)
    monkeypatch.delenv(ALLOWED, raising=False)


OWN = """
from dmcvb_gen.tasks.own import mjcf_environment
from tests.tasks.hostile_tasks import ARM, EndedByPython, arm

def ends():
    return arm(EndedByPython())

def from_file():
    with open("arm.xml", "w") as file:
        file.write(ARM)
    return mjcf_environment("arm.xml", lambda physics: 1.0, initialize=start, time_limit=0.1)

def start(physics, random):
    physics.data.qpos[:] = random.uniform(-1, 1, 2)
"""


def test_the_code_of_a_task_of_ones_own_runs_only_if_a_person_named_it(tmp_path, monkeypatch):
    ten_lines(tmp_path, monkeypatch, OWN)
    with pytest.raises(DmcvbError, match="set DMCVB_GEN_TASKS"):
        get_task("arm_tasks:from_file")
    allow(["arm_tasks:missing"])
    with pytest.raises(DmcvbError, match="cannot find task arm_tasks:missing"):
        get_task("arm_tasks:missing")
    monkeypatch.setenv(ALLOWED, "other:task, a:b arm_tasks:from_file ,")  # as people write lists
    task = get_task("arm_tasks:from_file")
    starts = task.batch(2).reset([np.random.default_rng(seed) for seed in range(2)])
    assert task.max_steps == 5 and (starts[0] != starts[1]).any()


def test_a_release_of_ones_own_task_is_verified_by_replay_and_not_checked_without_its_code(tmp_path, monkeypatch):
    ten_lines(tmp_path, monkeypatch, OWN)
    monkeypatch.setenv(ALLOWED, "arm_tasks:ends")
    roll_out(small_recipe(tasks="arm_tasks:ends", settings="none", renderer={}), tmp_path / "r")
    assert verify(tmp_path / "r").sound

    name = "arm_tasks-ends/random/none"
    shutil.copytree(tmp_path / "r", tmp_path / "wrong")
    rewrite(tmp_path / "wrong", name, lambda group: group["reward"].__setitem__((1, 3), 0.25))
    found = verify(tmp_path / "wrong").findings
    assert ("rewards", 1, 3) in {(issue.check, issue.episode, issue.step) for issue in found}

    monkeypatch.setattr("arm_tasks.ends", lambda: arm(EndedByPython(), ARM.replace('size=".05"', 'size=".06"')))
    get_task.cache_clear()
    assert f"behind {name} is not that which made these data" in str(verify(tmp_path / "r").unchecked[0])

    monkeypatch.delenv(ALLOWED)
    get_task.cache_clear()
    found = verify(tmp_path / "r")
    assert found.sound and not found.complete and "set DMCVB_GEN_TASKS=arm_tasks:ends" in str(found.unchecked[0])
    invoke("verify", tmp_path / "r", code=3)
    for to in ("rlds", "minari"):
        invoke("export", tmp_path / "r", "--to", to, "--out", tmp_path / to, code=0)


def test_another_model_of_the_same_code_is_another_task(tmp_path, monkeypatch):
    ten_lines(tmp_path, monkeypatch, OWN)
    monkeypatch.setenv(ALLOWED, "arm_tasks:from_file")
    before = code_of_task("arm_tasks:from_file")
    get_task.cache_clear()
    assert code_of_task("arm_tasks:from_file") == before
    monkeypatch.setattr("arm_tasks.ARM", ARM.replace('size=".05"', 'size=".06"'))
    get_task.cache_clear()
    assert code_of_task("arm_tasks:from_file") != before


def test_a_class_of_ones_own_steps_a_batch_by_itself(tmp_path, monkeypatch):
    ten_lines(tmp_path, monkeypatch, "from dmcvb_gen.tasks.locomotion import WalkerWalk as Walker")
    monkeypatch.setenv(ALLOWED, "arm_tasks:Walker,__main__:task")
    task = get_task("arm_tasks:Walker")
    assert task.id == "arm_tasks:Walker" and task.batch(2).state().shape == (2, 24)
    with pytest.raises(DmcvbError, match="put it into a module that workers can import"):
        get_task("__main__:task")


@pytest.mark.parametrize("task_id", [*LOCOMOTION_TASKS, "reacher-hard"])
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


@pytest.mark.parametrize("task_id", [*LOCOMOTION_TASKS, "ant-maze-easy7x7a"])
def test_a_stored_physics_state_continues_with_the_same_bits(task_id):
    """Putting it back gives the stored state, but for what the step before left in the sensors of the ant."""
    task, rng = get_task(task_id), np.random.default_rng(1)
    batch, other = task.batch(2), task.batch(2)
    batch.reset([np.random.default_rng(5), np.random.default_rng(6)])
    known = np.ones(task.state_size, bool)
    for name in task.unstored_fields:
        known[task.state_slices[name]] = False
    assert known.sum() == {24: 24, 17: 17, 67: 67, 167: 154}[task.state_size]
    for _ in range(20):
        action = rng.uniform(-1, 1, (2, task.action_size))
        other.set_physics(batch.physics())
        expected, found = batch.step(action), other.step(action)
        np.testing.assert_array_equal(found.state, expected.state)
        np.testing.assert_array_equal(found.reward, expected.reward)
        np.testing.assert_array_equal(other.set_physics(batch.physics())[:, known], expected.state[:, known])


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
    with pytest.raises(UnknownNameError, match="unknown task 'zzzz'. Known: [a-z0-9-]+, .* and .* more"):
        get_task("zzzz")
    for domain, name in (("walker", "walker-walk"), ("humanoid", "humanoid-walk"), ("ant-maze", "ant-maze-empty7x7")):
        with pytest.raises(UnknownNameError, match=f"Did you mean '{name}'"):  # DMC-VB's own come first
            get_task(domain)


@pytest.mark.parametrize("value_at_margin", [0.05, 0.5, 0.9])
@pytest.mark.parametrize("sigmoid", ["gaussian", "linear", "quadratic"])
def test_tolerance_is_dm_controls(sigmoid, value_at_margin):
    x = np.linspace(-20, 20, 997)
    theirs = rewards.tolerance(x, (-1.5, 2), 3.0, sigmoid, value_at_margin)
    np.testing.assert_allclose(tolerance(x, -1.5, 2, 3.0, sigmoid, value_at_margin), theirs, rtol=1e-12, atol=1e-12)
