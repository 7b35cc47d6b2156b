"""Tasks of a user's own: stored as dm_control's own environment plays them, or refused in one line."""

from __future__ import annotations

import copy
import dataclasses
import functools
import random
import time
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
from dm_env import specs

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.actor import RandomPolicy
from dmcvb_gen.policies.simulate import replay, simulate
from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.environment import EnvironmentTask
from dmcvb_gen.tasks.locomotion import WalkerWalk
from dmcvb_gen.tasks.own import _of_class
from tests.tasks import hostile_tasks as h
from tests.tasks.hostile_tasks import having


def late(physics):
    """After the episodes of the start's check."""
    return physics.time() > 0.45


def observed(value):
    return having("Observes", get_observation=lambda self, physics: value(physics))


def rewarded(value):
    return having("Earns", get_reward=lambda self, physics: value(physics))


HALF_A_DISCOUNT = having("Ends", get_termination=lambda self, physics: 0.5 if physics.time() > 0.2 else None)
DISCRETE = having("Discrete", action_spec=lambda self, physics: specs.DiscreteArray(3))
NAMES, SEED = ("own", "random"), 5
FULL = mujoco.mjtState.mjSTATE_INTEGRATION

EQUAL = (
    h.plain, h.WritesIntoTheSimulation, h.DrawsItsModel, h.own_step_and_reset, h.EndedByPython, HALF_A_DISCOUNT,
    h.ThreeActionsForTwoMotors, h.odd_bounds, h.flat_torques, h.odd_limit, h.sleeping, h.hills, h.muscles,
    h.CountsEpisodes, h.keeps_physics,
)  # fmt: skip
SEEDED = (h.DrawsElsewhereAtTheStart, h.GeneratorOfItsOwn, h.drawn_model)
LATE = "^task t, episode 8, step 1[0-2]: .*"
"""What is not seen at the start is told with its place."""
REFUSED = {
    h.NumpyInAStep: "drew from a global random generator in a step; draw from self.random",
    rewarded(lambda physics: random.random()): "drew from a global random generator in a step",
    h.NumpyInALateStep: "drew from a global random generator in a step",
    h.NewGeneratorInAStep: "made a random generator without a seed in a step",
    h.FixedGenerator: "holds a random generator with a fixed seed, which begins every episode alike",
    h.GeneratorOfTheModule: "gives another episode for the same seed",
    observed(lambda physics: {"t": np.array([time.perf_counter()])}): "gives another episode for the same seed",
    observed(lambda physics: {"name": "arm"}): "observes 'name' as <U3; give numbers",
    observed(lambda physics: {"arm": {"position": physics.data.qpos}}): "observes 'arm' as object; give numbers",
    h.early_quake: "changes hfield_data of the model in its episodes, which cannot be stored",
    observed(lambda physics: 1.0): "observes a float; get_observation must give a",
    observed(lambda physics: {}): "observes nothing; get_observation must give a dictionary",
    observed(lambda physics: dict.fromkeys("xy"[: 1 + (physics.time() > 0.1)], 0)): "'y' in different sizes .0 and 1.",
    observed(lambda physics: {"x": np.full(2, 1e300)}): "'x' with values that are no finite numbers of float32",
    rewarded(lambda physics: 1e300): "gave the reward .*e.300; its reward must be a finite number of float32",
    observed(lambda physics: {"x": np.zeros(1 + (physics.time() > 0.1))}): "observes 'x' in different sizes",
    observed(lambda physics: {"b" if physics.time() > 0.03 else "a": 0.0}): "observes 'a' in different sizes",
    observed(lambda physics: {"x": np.array([1.0, np.nan])}): "observes 'x' with values that are no finite numbers",
    rewarded(lambda physics: None): "failed .TypeError: .*None",
    rewarded(lambda physics: {}["left"]): "failed .KeyError: 'left'",
    h.no_motor: "takes float64 of shape .0,. as actions; give it actuators",
    DISCRETE: "takes int32 of shape .. as actions",
    h.no_camera: "has no camera to look through",
    h.other_models: "changes .* of the model in its episodes, which cannot be stored",
    h.PaintedAnew: "changes tex_data of the model in its episodes, which cannot be stored",
    h.restarts_itself: "began another episode within a step",
    lambda: 7: "gives a int; give a function that returns",
    lambda: 1 / 0: "cannot start task t .division by zero",
    observed(lambda physics: {"x": np.nan if late(physics) else 1.0}): LATE + "observes 'x' with values that are no",
    rewarded(lambda physics: np.nan if late(physics) else 1.0): LATE + "gave the reward nan",
    rewarded(lambda physics: {}["left"] if late(physics) else 0.0): LATE + "failed .KeyError: 'left'",
    h.diverges: LATE + "the simulation diverged .mjWARN_BAD",
    h.diverges_quietly: LATE + "the simulation diverged .mjWARN_BAD",
    h.quake: LATE + "changed hfield_data of the model in a step",
    h.LateChange: LATE + "changed geom_rgba of the model, and its first episodes did not",
    h.one_environment: "gives environments that share their task, and episodes run side by side; make a new one",
    h.one_physics: "gives environments that share their physics, and",
    h.one_model: "gives environments that share their physics.model, and",
}  # fmt: skip


def named(table):
    return pytest.mark.parametrize("case", [pytest.param(case, id=case.__name__) for case in table])


def make(case):
    """The environment of a function that gives one, or of a task."""
    return h.arm(case()) if isinstance(case, type) else case()


def task_of(case):
    return EnvironmentTask("t", functools.partial(make, case))


def rolled(task, episodes, max_steps=None):
    return simulate(task, [RandomPolicy(task)], episodes, SEED, NAMES, max_steps=max_steps)


def numbers(model):
    owners = [model, model.opt, *(getattr(model.vis, part) for part in dir(model.vis) if part[0] != "_")]
    for owner in owners:
        for name in dir(owner):
            value = getattr(owner, name)
            if name[0] != "_" and not callable(value) and isinstance(value, np.ndarray | int | float):
                yield name, np.array(value)


def check_model(task, row, theirs):
    """The stored row gives the very model that dm_control has."""
    model = copy.deepcopy(task.model)
    task.apply_entries(model, row)
    for (name, ours), (_, wanted) in zip(numbers(model), numbers(theirs), strict=True):
        np.testing.assert_array_equal(ours, wanted, err_msg=name)


def check_episode(task, made, place, environment):
    """An episode is the one that dm_control's own environment plays with the stored actions."""
    seed = int(episode_stream(SEED, NAMES, int(made.episodes[place]), "initial_state").integers(2**63))
    environment.task.random.set_state(np.random.RandomState(np.random.MT19937(seed)).get_state())
    step, length, last = environment.reset(), int(made.length[place]), False
    for row in range(length + 1):
        physics = environment.physics
        seen = np.concatenate([np.ravel(value) for value in step.observation.values()])
        np.testing.assert_array_equal(made.state[place, row], seen.astype(np.float32))
        full = physics.get_state(FULL)
        np.testing.assert_array_equal(made.physics[place, row, : len(full)], full)
        if row in (0, length // 2, length):
            check_model(task, made.physics[place, row], physics.model.ptr)
        if row == length:
            break
        assert not last
        action, reward, discount = made.action[place, row].astype(float), 0.0, 1.0
        environment.action_spec().validate(action)
        for _ in range(task.action_repeat):
            step = environment.step(action)
            reward, last = reward + discount * step.reward, step.last()
            discount *= step.discount
            if last:
                break
        assert made.reward[place, row] == np.float32(reward) and made.discount[place, row] == np.float32(discount)
    assert last or length == made.action.shape[1] - 1 < task.max_steps
    assert made.terminated[place] == (step.discount == 0)


@named(EQUAL)
def test_what_dm_control_does_is_what_is_stored(case):
    task = task_of(case)
    check_episode(task.at(1), rolled(task.at(1), [2]), 0, make(case))
    together, alone = rolled(task, [0, 1]), rolled(task, [1])
    for place in range(2):
        check_episode(task, together, place, make(case))
    for name, values in alone.arrays().items():
        np.testing.assert_array_equal(values[0], together.arrays()[name][1], err_msg=name)
    assert (together.state[0, 0] != together.state[1, 0]).any() or case in (h.flat_torques, h.own_step_and_reset)


@named([h.plain, h.DrawsItsModel, h.EndedByPython, h.CountsEpisodes, h.hills, h.keeps_physics, *SEEDED])
def test_an_episode_depends_on_its_index_alone_and_can_be_replayed(case):
    task, other = task_of(case), task_of(case)
    task.most_at_once = 3
    many = rolled(task, [2, 0, 1, 3])
    again = rolled(other, [3])
    replayed = replay(task, many.action[3, : many.length[3]], 3, SEED, NAMES)
    for name in ("state", "physics", "reward", "discount"):
        ours = getattr(many, name)[3]
        np.testing.assert_array_equal(ours, getattr(again, name)[0], err_msg=name)
        np.testing.assert_array_equal(ours[: len(getattr(replayed, name)[0])], getattr(replayed, name)[0])
    assert len({many.physics[place].tobytes() for place in range(4)}) == 4


@named(REFUSED)
def test_what_cannot_be_repeated_or_stored_is_refused_in_one_line(case):
    with pytest.raises(DmcvbError, match=REFUSED[case]) as caught:
        rolled(task_of(case), [8])
    assert "\n" not in str(caught.value)


def test_a_task_for_a_batch_is_refused_if_float32_does_not_hold_what_it_gives(monkeypatch):
    task = get_task("walker-walk")
    monkeypatch.setattr(type(task.batch(1)), "_control_reward", lambda batch: np.full(batch.size, 1e300))
    with pytest.raises(DmcvbError, match="^task walker-walk, episode 8, step 0: its reward is no finite number"):
        rolled(task, [8], max_steps=2)


def test_what_a_task_keeps_late_in_an_episode_does_not_reach_the_next_one():
    many, alone = rolled(task_of(h.CountsLate), range(3)), rolled(task_of(h.CountsLate), [2])
    np.testing.assert_array_equal(many.physics[2], alone.physics[0])


def test_environments_in_threads_leave_every_generator_as_it_was():
    task = task_of(h.plain)

    def play(_):
        batch, rng = task.batch(2), np.random.default_rng(3)
        batch.alone = False
        for _ in range(20):
            batch.reset([np.random.default_rng(place) for place in range(2)])
            batch.step(rng.uniform(-1, 1, (2, 2)))
            np.random.rand(3)
        return len({np.random.default_rng().integers(2**60) for _ in range(5)})

    with ThreadPoolExecutor(4) as pool:
        done = list(pool.map(play, range(4)))
    assert done == [5] * 4 and np.random.default_rng().integers(2**60) != np.random.default_rng().integers(2**60)


@named([h.flat_torques, h.own_step_and_reset, h.plain])
def test_a_batch_goes_on_from_stored_physics_whatever_the_environment_observes(case):
    task, generators = task_of(case), [np.random.default_rng(0)]
    batches = [task.batch(1) for _ in range(2)]
    batches[0].reset(generators)
    batches[0].step(np.ones((1, task.action_size)))
    batches[1].set_physics(batches[0].physics())
    after = [batch.step(np.ones((1, task.action_size))).state for batch in batches]
    np.testing.assert_array_equal(*after)


WRONG_CLASSES = {
    "cameras = (7,)": "has views .'pixels',. and cameras .7,., and its model has [0-9]; name a camera of the model",
    "cameras = ('nosuch',)": "cannot start task t .*nosuch",
    "views = ('side', 'back')": "has views .'side', 'back'. and cameras .0,.",
    "max_steps = 20.0": "has max_steps 20.0; give an int",
    "batch = column": "gives reward of shape .2, 1. for two simulations; let it be .2,.",
}


def column(task, size, threads=1):
    batch = WalkerWalk.batch(task, size)
    step = batch.step

    def stepped(actions):
        found = step(actions)
        return dataclasses.replace(found, reward=found.reward[:, None])

    batch.step = stepped
    return batch


@pytest.mark.parametrize("wrong", WRONG_CLASSES)
def test_a_class_of_ones_own_that_cannot_be_shown_or_stored_is_refused_in_one_line(wrong):
    name, value = wrong.split(" = ")
    kind = type("Own", (WalkerWalk,), {name: eval(value)})
    with pytest.raises(DmcvbError, match=WRONG_CLASSES[wrong]) as caught:
        _of_class("t", kind)
    assert "\n" not in str(caught.value)


def test_terrain_that_is_drawn_otherwise_than_it_was_stored_is_refused():
    task = task_of(h.hills)
    row = rolled(task, [0]).physics[0, 0]
    task.apply_entries(copy.deepcopy(task.model), row)
    row[-1] += 1
    with pytest.raises(DmcvbError, match="draws other terrain than is stored; install dm_control, numpy and scipy"):
        task.apply_entries(copy.deepcopy(task.model), row)
