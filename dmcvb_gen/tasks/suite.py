"""Any dm_control task as one of ours: `SuiteTask` wraps a dm_control `Environment`, here for the whole control suite.

Physics is stepped for all episodes at once (`mujoco.batch`). Rewards and observations are dm_control's own Python code,
called for each episode: correct for every task, and slower than the three tasks that this package writes for a batch.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import importlib.util
import logging
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks.base import ACTION_REPEAT, PHYSICS_SPEC, EpisodeBatch, Task

_log = logging.getLogger(__name__)
DEFAULT_STEPS = 500
"""Agent steps an episode if dm_control gives no time limit."""
PROBES = 6
"""Episodes begun to learn which parts of the model an episode changes."""
ACCELERATION_FIELDS = (
    "act_dot", "actuator_force", "cacc", "cfrc_ext", "cfrc_int", "qacc", "qacc_smooth", "qfrc_actuator",
    "qfrc_constraint",
)  # fmt: skip
"""Fields of MjData that a position and a velocity alone do not give."""


REFUSED = {"quadruped-escape": "it draws a new terrain for every episode"}
"""Tasks of the suite that cannot be used, and why."""


@functools.cache
def suite_ids() -> tuple[str, ...]:
    """Usable task ids "<domain>-<task>" of dm_control's suite, read from its source: importing it takes a second."""
    found = importlib.util.find_spec("dm_control")
    assert found and found.submodule_search_locations  # a dependency of ours, and a package
    names = []
    for path in sorted((Path(found.submodule_search_locations[0]) / "suite").glob("*.py")):
        added = re.findall(r"^@SUITE\.add\([^)]*\)\ndef (\w+)\(", path.read_text(), re.MULTILINE)
        names += [f"{path.stem}-{task}" for task in added]
    return tuple(name for name in names if name not in REFUSED)


def import_suite() -> Any:
    """`dm_control.suite`; its first import warns of a display that nobody needs."""
    with warnings.catch_warnings(action="ignore"):
        return importlib.import_module("dm_control.suite")


def suite_task(task_id: str) -> SuiteTask:
    """The task of dm_control's suite with this id, one of `suite_ids`."""
    domain, _, name = task_id.partition("-")

    def make():
        return import_suite().load(domain, name, task_kwargs={"random": 0})

    return SuiteTask(task_id, make, domain)


class SuiteTask(Task):
    """A task made from a dm_control `Environment` (`dm_control.rl.control`).

    An episode may change the model (a target's position, say). Those entries are found by starting a few episodes, and
    stored behind MuJoCo's state in each row of `physics`, so that physics rows alone still decide every picture.

    Args:
      id: the task's name.
      make: makes the environment.
      domain: dm_control's domain; decides the floor's opacity under distractors.

    Raises:
      DmcvbError: the environment is none of dm_control's, or its observations or model cannot be stored.
    """

    def __init__(self, id: str, make: Callable[[], Any], domain: str = ""):
        _log.info("%s: dm_control computes rewards and observations episode by episode, which takes longer", id)
        self.id = id
        self.floor_alpha = {"walker": 1.0, "cheetah": 1.0, "reacher": 0.0}.get(domain, 0.3)
        try:
            environment = make()
            _check_environment(id, environment)
        except DmcvbError:
            raise
        except Exception as error:  # from a user's own task
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise DmcvbError(
                f"cannot start task {id} ({reason}); make its environment run in dm_control first"
            ) from error
        if not domain:
            _check_actions(id, environment)
        self._environment = environment
        self.substeps = environment._n_sub_steps
        limit = environment._step_limit / ACTION_REPEAT
        self.max_steps = math.ceil(limit - 1e-6) if math.isfinite(limit) else DEFAULT_STEPS
        self.evaluation_steps = self.max_steps
        self.return_range = (-math.inf, math.inf) if domain in ("", "lqr") else (0.0, 2.0 * self.max_steps)
        self._begin(0)
        physics = environment.physics
        self._model = copy.deepcopy(physics.model._model)
        if not self._model.ncam:
            raise DmcvbError(f"{id} has no camera to look through; add a <camera> to its model")
        self.model_entries = self._changed_entries()
        self.state_fields = {
            name: int(np.size(part)) for name, part in environment.task.get_observation(physics).items()
        }
        drawn, self.unstored_reward = self._kept_in_python()
        unstored = {*drawn, *self._fields_of_accelerations()}
        self.unstored_fields = tuple(name for name in self.state_fields if name in unstored)

    @property
    def model(self) -> mujoco.MjModel:
        return self._model

    def batch(self, size: int, threads: int = 1) -> EpisodeBatch:
        return SuiteBatch(self, size, threads)

    def _begin(self, seed: int) -> None:
        """Begin an episode in the shared physics."""
        with _seeded(self._environment.task, np.random.RandomState(seed)):
            with self._environment.physics.reset_context():
                self._environment.task.initialize_episode(self._environment.physics)

    def _changed_entries(self) -> dict[str, np.ndarray]:
        """Model field -> flat indices of the entries that differ from episode to episode."""
        model, own = self._environment.physics.model._model, self._model
        names = [name for name in dir(own) if not name.startswith("_") and isinstance(getattr(own, name), np.ndarray)]
        changed: dict[str, np.ndarray] = {}
        for seed in range(1, PROBES):
            self._begin(seed)
            for name in names:
                now, before = getattr(model, name).reshape(-1), getattr(own, name).reshape(-1)
                if not np.array_equal(now, before, equal_nan=now.dtype.kind == "f"):
                    changed[name] = changed.get(name, np.zeros(now.size, bool)) | (now != before)
        for name in set(changed) - set(MODEL_FIELDS):
            raise DmcvbError(f"{self.id} changes {name} of the model in every episode, which cannot be stored; fix it")
        return {name: np.flatnonzero(mask) for name, mask in sorted(changed.items())}

    def _kept_in_python(self) -> tuple[tuple[str, ...], bool]:
        """Fields of the observation that need what the task drew for an episode and keeps in Python; so does reward."""
        physics = self._environment.physics
        tasks = [copy.deepcopy(self._environment.task) for _ in range(2)]
        for seed, task in enumerate(tasks):
            with _seeded(task, np.random.RandomState(seed)), physics.reset_context():
                task.initialize_episode(physics)
        first, second = (task.get_observation(physics) for task in tasks)  # both look at the second episode
        fields = tuple(name for name in first if not np.array_equal(first[name], second[name], equal_nan=True))
        with contextlib.suppress(Exception):  # of a user's own code, which may need a step first
            return fields, bool(fields) or bool(tasks[0].get_reward(physics) != tasks[1].get_reward(physics))
        return fields, bool(fields)

    def _fields_of_accelerations(self) -> tuple[str, ...]:
        """Fields of the observation that need accelerations or contact forces of the step before."""
        self._begin(0)
        physics, task, model = self._environment.physics, self._environment.task, self._model
        before = task.get_observation(physics)
        late = model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
        for address, size in zip(model.sensor_adr[late], model.sensor_dim[late], strict=True):
            physics.data.sensordata[address : address + size] += 1.0
        for name in ACCELERATION_FIELDS:
            getattr(physics.data, name)[...] += 1.0
        after = task.get_observation(physics)
        return tuple(name for name in before if not np.array_equal(before[name], after[name]))


def _check_environment(id: str, environment: Any) -> None:
    from dm_control.rl import control

    if not isinstance(environment, control.Environment):
        raise DmcvbError(
            f"{id} gives a {type(environment).__name__}; give a function that returns a "
            "dm_control.rl.control.Environment"
        )
    task, physics, shapes = environment.task, environment.physics, []
    for seed in range(2):
        with _seeded(task, np.random.RandomState(seed)), physics.reset_context():
            task.initialize_episode(physics)
        for _ in range(2):
            physics.step(environment._n_sub_steps)
            observation = task.get_observation(physics)
            if not isinstance(observation, dict):
                raise DmcvbError(
                    f"{id} observes a {type(observation).__name__}; get_observation must give a dictionary"
                )
            shapes.append({name: np.shape(value) for name, value in observation.items()})
    for now in shapes:
        if now != shapes[0]:
            name = next((name for name in shapes[0] if now.get(name) != shapes[0][name]), next(iter(now)))
            raise DmcvbError(
                f"{id} observes {name!r} in different shapes ({shapes[0].get(name)} and {now.get(name)}); "
                "observations must have a fixed shape"
            )


def _check_actions(id: str, environment: Any) -> None:
    """Refuse an environment that does not take actions as they are here: from -1 to 1, straight to the actuators."""
    task, physics = environment.task, environment.physics
    low, high = task.action_spec(physics).minimum, task.action_spec(physics).maximum
    if (np.isfinite(low) & (low != -1)).any() or (np.isfinite(high) & (high != 1)).any():
        raise DmcvbError(
            f"{id} takes actions from {np.min(low):g} to {np.max(high):g}; actions here are from -1 to 1: give its "
            'actuators ctrlrange="-1 1", and their strength as gear'
        )
    for value in (-1.0, 0.5):
        action = np.full(physics.model.nu, value)
        with physics.reset_context():
            task.initialize_episode(physics)
        task.before_step(action, physics)
        if not np.array_equal(physics.control(), action):
            raise DmcvbError(
                f"{id} changes actions in before_step, which does not run here; let its actuators take them as they are"
            )


def _failed(task_id: str, error: Exception) -> DmcvbError:
    """The error for an exception of a task's own code."""
    reason = (str(error).splitlines() or [""])[0]
    return DmcvbError(f"task {task_id} failed ({type(error).__name__}: {reason})")


@contextlib.contextmanager
def _seeded(task: Any, random: np.random.RandomState) -> Iterator[None]:
    """dm_control's own random numbers of a task come from `random`, numpy's global ones from a seed of it."""
    if hasattr(task, "_random"):
        task._random = random
    kept = np.random.get_state()
    np.random.seed(random.randint(2**31) if not hasattr(task, "_random") else 0)
    try:
        yield
    finally:
        np.random.set_state(kept)


class SuiteBatch(EpisodeBatch):
    """Episodes of a `SuiteTask`: physics steps together, dm_control's task is asked for one episode after the other.

    An exception of the task's own code becomes a `DmcvbError` of one line that names the task.
    """

    task: SuiteTask

    def __init__(self, task: SuiteTask, size: int, threads: int = 1):
        super().__init__(task, size, threads)
        environment = task._environment
        self._physics = environment.physics.copy(share_model=False)
        self._tasks = [copy.deepcopy(environment.task) for _ in range(size)]
        self._values = {name: self.sims.expand(name) for name in task.model_entries}
        self._flags = self.sims.expand("opt.disableflags")
        self._states = np.zeros((size, task.state_size))
        self._moved = self._all  # the simulations of the last step
        self._stale = np.zeros(size, bool)  # whose state is to be observed again

    # -- one simulation at a time -----------------------------------------------------------------

    def _look_at(self, sim: int) -> Any:
        """dm_control's physics in the state of a simulation."""
        self.sims.get_data(sim, self._physics.data.ptr)
        for name, columns in self.task.model_entries.items():
            values = self._values[name][sim].reshape(-1)[columns]
            getattr(self._physics.model._model, name).reshape(-1)[columns] = values
        return self._physics

    def _initialize(self, ids, generators):
        model = self._physics.model._model
        for sim, generator in zip(ids, generators, strict=True):
            task = self._tasks[sim]
            with _seeded(task, np.random.RandomState(np.random.MT19937(int(generator.integers(2**63))))):
                with self._physics.reset_context():
                    try:
                        task.initialize_episode(self._physics)
                    except Exception as error:  # from a user's own task
                        raise _failed(self.task.id, error) from error
            row = np.empty(len(self._physics_columns))
            mujoco.mj_getState(model, self._physics.data.ptr, row, PHYSICS_SPEC)
            self.sims.state[sim, self._physics_columns] = row
            for name, columns in self.task.model_entries.items():
                self._values[name][sim].reshape(-1)[columns] = getattr(model, name).reshape(-1)[columns]
        self._refresh(ids)

    def _refresh(self, ids):
        """Compute everything without actuation, as dm_control does after a reset."""
        flags = self._flags[ids].copy()
        self._flags[ids] = flags | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        self.sims.forward(ids=ids)
        self._flags[ids] = flags
        self._stale[ids] = True

    def _advance(self, ids):
        super()._advance(ids)
        self._moved = self._all if ids is None else ids
        self._stale[self._moved] = True

    def state(self):
        for sim in np.flatnonzero(self._stale).tolist():
            physics = self._look_at(sim)
            try:
                observation = self._tasks[sim].get_observation(physics)
                self._states[sim] = np.concatenate([np.ravel(part) for part in observation.values()])
            except Exception as error:  # from a user's own task
                raise _failed(self.task.id, error) from error
        self._stale[:] = False
        return self._states.copy()

    def _control_reward(self):
        reward, self._ended = np.zeros(self.size), np.zeros(self.size, bool)
        for sim in self._moved.tolist():
            physics, task = self._look_at(sim), self._tasks[sim]
            try:
                task.after_step(physics)
                reward[sim] = float(task.get_reward(physics))  # numpy would make NaN of None
                self._ended[sim] = task.get_termination(physics) is not None
            except Exception as error:  # from a user's own task
                raise _failed(self.task.id, error) from error
        return reward

    def _control_terminated(self):
        return self._ended

    # -- physics rows: MuJoCo's state, then the entries of the model ------------------------------

    def physics(self):
        parts = [self._values[name].reshape(self.size, -1)[:, at] for name, at in self.task.model_entries.items()]
        return np.concatenate([super().physics(), *parts], axis=1)

    def set_physics(self, physics, ids: np.ndarray | Sequence[int] | None = None):
        ids = self._all if ids is None else np.asarray(ids, int)
        physics = np.asarray(physics, np.float64)
        for name, columns, values in self.task.split_entries(physics):
            for sim, row in zip(ids, values, strict=True):
                self._values[name][sim].reshape(-1)[columns] = row
        return super().set_physics(physics[:, : len(self._physics_columns)], ids)
