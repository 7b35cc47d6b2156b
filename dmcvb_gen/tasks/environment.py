"""Any dm_control task as one of ours: every episode is stepped by a dm_control `Environment`, reset for it alone.

Whatever dm_control does is what is stored: writes into the simulation, changes of the model, its own way of ending an
episode. Only the random numbers are ours, see `randomness`.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import math
import operator
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from dmcvb_gen.errors import DmcvbError, first_line
from dmcvb_gen.tasks.base import EpisodeBatch, EpisodeError, StepResult, Task, diverged, field_owner
from dmcvb_gen.tasks.randomness import held_states, seed_task, seeded, watched

DEFAULT_STEPS = 500
"""Agent steps an episode if dm_control gives no time limit."""
PROBE_STEPS = 10
"""Agent steps of the episodes that the start's check compares."""
PROBE_SEEDS = (0, 1)
"""Seeds of these episodes."""
LARGEST = float(np.finfo(np.float32).max)
"""Of what observations, rewards and discounts are stored as."""
MAX_ENTRIES = 10_000
"""Values of a model's field that may change in an episode, at most: each row of `physics` holds them."""
TERRAIN, TERRAIN_KEY = "hfield_data", 3
"""The field that may have more if the start of an episode draws it, and how many numbers of a row stand for it."""
ASSETS = ("mesh_", "oct_", "skin_", "tex_")
"""Beginnings of the names of large fields of a model, which only the start's check compares."""
BAD_STATES = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC", "CTRL")]
"""Warnings after which MuJoCo has reset a simulation; a task cannot hide them."""


@contextlib.contextmanager
def starting(task_id: str) -> Iterator[None]:
    """An exception of the user's own code becomes one line."""
    try:
        yield
    except DmcvbError:
        raise
    except Exception as error:
        raise DmcvbError(f"cannot start task {task_id} ({first_line(error)}); make it run by itself first") from error


class EnvironmentTask(Task):
    """A task made from a dm_control `Environment` (`dm_control.rl.control`).

    Each row of `physics` holds the whole state of the simulation and those fields of the model that episodes change.

    Args:
      id: the task's name.
      make: makes an environment; called again for every episode.
      domain: dm_control's domain, for its own suite; decides the floor's opacity under distractors.

    Raises:
      DmcvbError: the environment is none of dm_control's, gives another episode for the same seed, or has what cannot
        be stored.
    """

    physics_spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    replayed = True
    action_low = action_high = np.zeros(0, np.float32)
    control_timestep = 0.0
    most_at_once = 8  # an environment holds a model and its data: 12 MB for most of the suite, 80 for the dog

    def __init__(self, id: str, make: Callable[[], Any], domain: str = ""):
        self.id, self._make = id, make
        self._terrain = functools.lru_cache(maxsize=64)(self._draw_terrain)  # images come in the order of their videos
        self.floor_alpha = {"walker": 1.0, "cheetah": 1.0, "reacher": 0.0}.get(domain, 0.3)
        self.trusted = bool(domain)  # the tests compare the suite's tasks with dm_control
        self.state_fields, self.model_entries = {}, {}
        self._fixed: dict[str, np.ndarray] = {}
        with starting(id):
            environment = self.make_environment(PROBE_SEEDS[0])
            self.action_low, self.action_high = _bounds(id, environment)
            self._control_steps = environment._step_limit
            self.substeps, self.control_timestep = environment._n_sub_steps, environment.control_timestep()
        self.ends_itself = math.isfinite(self._control_steps)
        if not self.ends_itself:
            self._control_steps = DEFAULT_STEPS * self.action_repeat
        self._set_limits()
        most = float(self.action_repeat * self.max_steps)
        self.return_range = (-math.inf, math.inf) if domain in ("", "lqr") else (0.0, most)
        self._examine(environment)

    @property
    def action_size(self) -> int:
        return len(self.action_low)

    @property
    def array_attributes(self) -> dict[str, dict[str, Any]]:
        """The actions' bounds, and where a row of `physics` holds the simulation's state and the model's fields."""
        place = mujoco.mj_stateSize(self.model, self.physics_spec)
        fields = {"state": [0, place]}
        for name, columns in self.model_entries.items():
            fields[f"model.{name}"] = [place, place + len(columns)]
            place += len(columns)
        if self.draws_terrain:
            fields[f"seed and CRC-32 of model.{TERRAIN}"] = [place, place + TERRAIN_KEY]
        bounds = {"low": self.action_low.tolist(), "high": self.action_high.tolist()}
        return {"action": bounds, "physics": {"fields": fields, "mjtState": self.physics_spec}}

    @property
    def physics_size(self) -> int:
        return super().physics_size + TERRAIN_KEY * self.draws_terrain

    def terrain_of(self, row: np.ndarray) -> tuple[int, ...]:
        """High and low half of the seed that draws a row's terrain, CRC-32 of its heights; empty if none is drawn."""
        return tuple(row[len(row) - TERRAIN_KEY * self.draws_terrain :].astype(int).tolist())

    def apply_entries(self, model: mujoco.MjModel, row: np.ndarray) -> None:
        """See `Task`; terrain is drawn again from the row's seed.

        Raises:
          DmcvbError: it is not the stored one.
        """
        super().apply_entries(model, row)
        if key := self.terrain_of(row):
            model.hfield_data[:] = self._terrain(key)

    def _draw_terrain(self, key: tuple[int, ...]) -> np.ndarray:
        episode = _Episode(self, self.make_environment(seed := key[0] << 32 | key[1]))
        episode.reset(seed)
        if episode.terrain != key:
            raise self.error("draws other terrain than is stored; install dm_control, numpy and scipy as they were")
        return episode.model.hfield_data.copy()

    def at(self, action_repeat: int) -> Task:
        other = super().at(action_repeat)
        assert isinstance(other, EnvironmentTask)
        other._set_limits()  # an odd number of control steps
        return other

    def _set_limits(self) -> None:
        self.max_steps = self.evaluation_steps = math.ceil(self._control_steps / self.action_repeat - 1e-6)

    def batch(self, size: int, threads: int = 1) -> EpisodeBatch:
        return EnvironmentBatch(self, size)

    def make_environment(self, seed: int) -> Any:
        """A new environment; what it draws while it is made follows from `seed`."""
        with seeded(seed):
            return self._make()

    def error(self, reason: str) -> DmcvbError:
        return DmcvbError(f"task {self.id} {reason}")

    # -- the check at the start -------------------------------------------------------------------

    def _examine(self, environment: Any) -> None:
        """Learn the state's fields and the model's changes from short episodes; compare those of a user's own task.

        Args:
          environment: a new one, made with the first seed.
        """
        first, second = PROBE_SEEDS
        probes = [_Probe(self, environment, first)]
        self.model = copy.deepcopy(environment.physics.model._model)
        if not self.model.ncam:
            raise DmcvbError(f"{self.id} has no camera to look through; add a <camera> to its model")
        with starting(self.id):
            probes += [_Probe(self, self.make_environment(seed), seed) for seed in (second, second, first)]
        if not self.trusted:
            self._check_probes(probes)
        with starting(self.id):
            for probe in probes:
                probe.environment.close()
        start, assets = probes[0].models[0], probes[0].assets
        changed = {name for probe in probes for name in probe.changed(start)}
        self._fixed = {name: value for name, value in start.items() if not self.trusted and name not in changed}
        self.draws_terrain = TERRAIN in changed and start[TERRAIN].size > MAX_ENTRIES
        if self.draws_terrain and not any(TERRAIN in probe.changed(probe.models[0]) for probe in probes):
            changed.remove(TERRAIN)
        self.model_entries = {name: np.arange(start[name].size) for name in sorted(changed)}
        repainted = {name for probe in probes for name in assets if probe.assets.get(name) != assets[name]}
        large = {name for name in changed if start[name].size > MAX_ENTRIES}
        resized = {name for probe in probes for name in changed if probe.models[0][name].shape != start[name].shape}
        for name in sorted(repainted | large | resized):
            raise DmcvbError(
                f"{self.id} changes {name} of the model in its episodes, which cannot be stored; leave it as it is, or "
                "make a task for each"
            )

    def _check_probes(self, probes: Sequence[_Probe]) -> None:
        """Refuse a task whose episodes do not follow from their seeds."""
        one, two, two_again, one_again = probes
        parts = ["task", "physics", "physics.data.ptr"]
        if any(probe.changed(one.models[0]) for probe in probes):
            parts.append("physics.model.ptr")
        for part in parts:
            if len({id(operator.attrgetter(part)(probe.environment)) for probe in probes}) < len(probes):
                raise DmcvbError(
                    f"{self.id} gives environments that share their {part.removesuffix('.ptr')}, and episodes run side "
                    "by side; make a new one in each call"
                )
        if set(one.held) & set(two.held):
            raise DmcvbError(
                f"{self.id} holds a random generator with a fixed seed, which begins every episode alike; draw from "
                "self.random"
            )
        if one.differs(one_again) or two.differs(two_again):
            raise DmcvbError(
                f"{self.id} gives another episode for the same seed; draw every random number from self.random, and "
                "keep nothing outside of the environment"
            )

    def fixed_values(self, model: mujoco.MjModel) -> list[tuple[str, Callable[[], Any], Any]]:
        """The fields that no short episode of the start's check changed: name, what gives it now, its value there."""
        found = list[tuple[str, Callable[[], Any], Any]]()
        for name, value in self._fixed.items():
            owner, field = field_owner(model, name)
            now = getattr(owner, field)  # an array is a view, which is quicker to ask than the model
            whole = (now.tobytes, value.tobytes()) if isinstance(now, np.ndarray) else None
            found.append((name, *(whole or (functools.partial(getattr, owner, field), value[0]))))
        return found


def model_values(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """All numbers of a model but its assets, flat, by name: "geom_size", "opt.gravity", "vis.headlight.ambient"."""
    found = {name: value for name, value in _arrays(model).items() if not name.startswith(ASSETS)}
    owners = [("opt.", model.opt), ("stat.", model.stat)]
    owners += [(f"vis.{part}.", getattr(model.vis, part)) for part in dir(model.vis) if not part.startswith("_")]
    for prefix, owner in owners:
        values = {name: getattr(owner, name) for name in dir(owner) if not name.startswith("_")}
        found |= {prefix + name: np.ravel(value).copy() for name, value in values.items() if not callable(value)}
    return found


def model_digest(model: mujoco.MjModel) -> str:
    """SHA-256 of all numbers of a model, rounded to float32, but where its assets' paths lie."""
    found = hashlib.sha256()
    for name, values in sorted((model_values(model) | _arrays(model, ASSETS)).items()):
        if values.dtype.kind in "biuf" and not name.endswith("pathadr"):
            found.update(name.encode() + np.asarray(values, np.float32).tobytes())
    return found.hexdigest()


def _arrays(model: mujoco.MjModel, beginnings: tuple[str, ...] = ("",)) -> dict[str, np.ndarray]:
    """Copies of a model's arrays, flat, by name."""
    names = [name for name in dir(model) if name.startswith(beginnings) and not name.startswith("_")]
    values = {name: getattr(model, name) for name in names}
    return {name: np.ravel(value).copy() for name, value in values.items() if isinstance(value, np.ndarray)}


class _Probe:
    """An episode of a few steps, for the check at the start.

    Attributes:
      models: the model's values after the start and after each step.
      held: states of the generators that the task held before the start.
      assets: digest of the model's textures, meshes and the like at the end.
    """

    def __init__(self, task: EnvironmentTask, environment: Any, seed: int):
        self.environment, self.held = environment, held_states(environment.task)
        episode, rng = _Episode(task, environment), np.random.default_rng(seed)
        episode.reset(seed)
        self.models, self._rows = [model_values(episode.model)], [np.append(episode.full_state(), episode.state)]
        for _ in range(PROBE_STEPS):
            with watched(task.error):
                numbers = episode.step(rng.uniform(task.action_low, task.action_high))
            self._rows.append(np.concatenate([episode.full_state(), episode.state, numbers]))
            if not task.trusted:
                self.models.append(model_values(episode.model))
            if episode.over:
                break
        self.models.append(model_values(episode.model))
        self.assets = {name: zlib.crc32(value.data) for name, value in _arrays(episode.model, ASSETS).items()}

    def changed(self, start: Mapping[str, np.ndarray]) -> set[str]:
        """Names of the model's fields that are ever other than in `start`."""
        return {name for model in self.models for name in start if not same(model[name], start[name])}

    def differs(self, other: _Probe) -> bool:
        """Return True if another run of the same episode is not the same in all."""
        ours, theirs = (
            [*probe._rows, *(value for model in probe.models for value in model.values())] for probe in (self, other)
        )
        return len(ours) != len(theirs) or not all(map(same, ours, theirs))


def same(one: np.ndarray, two: np.ndarray) -> bool:
    """Return True if two arrays have the same shape and the same values."""
    return one.shape == two.shape and bool(((one == two) | (one != one) & (two != two)).all())


def _bounds(id: str, environment: Any) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest actions, (action,) float32; [-1, 1] where there are none."""
    from dm_control.rl import control

    if not isinstance(environment, control.Environment):
        given = type(environment).__name__
        raise DmcvbError(f"{id} gives a {given}; give a function that returns a dm_control.rl.control.Environment")
    spec = environment.action_spec()
    shape, dtype = spec.shape, np.dtype(spec.dtype)
    if len(shape) != 1 or not shape[0] or dtype.kind != "f":
        raise DmcvbError(
            f"{id} takes {dtype} of shape {shape} as actions; give it actuators, and one row of numbers that drives "
            "them"
        )
    low = np.broadcast_to(getattr(spec, "minimum", -np.inf), shape).astype(float)
    high = np.broadcast_to(getattr(spec, "maximum", np.inf), shape).astype(float)
    lowest, highest = low <= -mujoco.mjMAXVAL, high >= mujoco.mjMAXVAL  # none, that is
    low = np.where(lowest, np.minimum(-1, high - 2), low)
    high = np.where(highest, np.maximum(1, low + 2), high)
    if not (low < high).all():
        raise DmcvbError(f"{id} takes actions from {low} to {high}; the first must be less than the second")
    inner = [bound.astype(np.float32) for bound in (low, high)]  # rounded towards each other
    inner[0] = np.where(inner[0] < low, np.nextafter(inner[0], np.float32(np.inf)), inner[0])
    inner[1] = np.where(inner[1] > high, np.nextafter(inner[1], np.float32(-np.inf)), inner[1])
    return inner[0], inner[1]


class _Episode:
    """One episode in one environment: what dm_control gives, checked, as numbers.

    Attributes:
      state: (state,) float64, the last observation.
      terminated, truncated: how it ended; both false while it runs.
    """

    def __init__(self, task: EnvironmentTask, environment: Any, place: int = 0):
        self.task, self.environment, self.place = task, environment, place
        self.steps, self.terminated, self.truncated = 0, False, False
        self.state, self.terrain = np.zeros(0), tuple[int, ...]()
        self._checked: mujoco.MjModel | None = None

    @property
    def over(self) -> bool:
        return self.terminated or self.truncated

    def reset(self, seed: int) -> None:
        """Begin."""
        with self._told(), seeded(seed):
            seed_task(self.environment.task, seed)
            self._observe(self.environment.reset().observation)
        self.terrain = seed >> 32, seed & 0xFFFFFFFF, zlib.crc32(self.model.hfield_data)
        self._warned = self._warnings()
        self.check_model()

    def step(self, action: np.ndarray) -> tuple[float, float]:
        """Reward and discount of an agent step."""
        total, discount = 0.0, 1.0
        with self._told():
            for _ in range(self.task.action_repeat):
                found = self.environment.step(action.copy())
                if found.first():
                    raise self.error("it began another episode within a step; end an episode with a last TimeStep")
                total += discount * float(found.reward)  # numpy would make NaN of None
                discount *= float(found.discount)
                if found.last():
                    self.terminated, self.truncated = found.discount == 0, found.discount != 0
                    break
            self._observe(found.observation)
        if not self.task.trusted:
            self.check_model()
        for name, value in (("reward", total), ("discount", discount)):
            if not abs(value) <= LARGEST:
                raise self.error(f"it gave the {name} {value}; its {name} must be a finite number of float32")
        if (risen := self._warnings() > self._warned).any():  # a task may have hidden them
            raise self.error(diverged([mujoco.mjtWarning(kind).name for kind in np.array(BAD_STATES)[risen]]))
        self.steps += 1
        return total, discount

    @property
    def model(self) -> mujoco.MjModel:
        """The episode's model as it is now."""
        return self.environment.physics.model._model

    def full_state(self) -> np.ndarray:
        """All that MuJoCo needs to go on from here."""
        return self.environment.physics.get_state(self.task.physics_spec)

    def row(self) -> np.ndarray:
        """(physics,) float64: the simulation's state, then the model's entries."""
        owners = (field_owner(self.model, name) for name in self.task.model_entries)
        entries = [np.ravel(getattr(owner, name)) for owner, name in owners]
        return np.concatenate([self.full_state(), *entries, self.terrain if self.task.draws_terrain else ()])

    def put(self, row: np.ndarray) -> None:
        """Set the simulation to a stored row. The task's Python state and its last observation do not change."""
        physics, spec = self.environment.physics, self.task.physics_spec
        with self._told():
            self.task.apply_entries(self.model, row)
            self.terrain = self.task.terrain_of(row)
            physics.reset()
            physics.set_state(row[: mujoco.mj_stateSize(self.task.model, spec)], spec)
            physics.after_reset()
            if self.task.trusted:
                self._observe(None)

    def error(self, reason: str) -> EpisodeError:
        return EpisodeError(self.task.id, self.place, self.steps, reason)

    def check_model(self) -> None:
        """Raise EpisodeError if the episode changed the model where the episodes of the start's check did not."""
        if self.task.draws_terrain and zlib.crc32(self.model.hfield_data) != self.terrain[-1]:
            raise self.error(f"it changed {TERRAIN} of the model in a step; change it at the start of an episode alone")
        if self.model is not self._checked:
            self._checked, self._values = self.model, self.task.fixed_values(self.model)
        for name, read, value in self._values:
            if read() != value:
                raise self.error(
                    f"it changed {name} of the model, and its first episodes did not; change it in every episode"
                )

    def _warnings(self) -> np.ndarray:
        return self.environment.physics.data.warning.number[BAD_STATES]

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """An exception of the task's own code, or of dm_control, becomes one line that says where it happened."""
        from dm_control.rl.control import PhysicsError

        try:
            yield
        except DmcvbError:
            raise
        except PhysicsError as error:
            raise self.error(diverged([str(error).rpartition(": ")[2]])) from error
        except Exception as error:
            raise self.error(f"it failed ({type(error).__name__}: {first_line(error)})") from error

    def _observe(self, observation: Any) -> None:
        """Take an observation; a task of the suite is asked for it, see `suite`.

        Raises:
          EpisodeError: it is no dictionary of finite numbers with the names and sizes of the first one.
        """
        if self.task.trusted:
            observation = self.environment.task.observe(self.environment.physics)
        if not isinstance(observation, Mapping):
            raise self.error(f"it observes a {type(observation).__name__}; get_observation must give a dictionary")
        if not observation:
            raise self.error("it observes nothing; get_observation must give a dictionary of numbers")
        parts, fields = [np.ravel(value) for value in observation.values()], self.task.state_fields
        for name, part in zip(observation, parts, strict=True):
            if part.dtype.kind not in "biuf":
                raise self.error(f"it observes {name!r} as {part.dtype}; give numbers")
        sizes = dict(zip(observation, map(len, parts), strict=True))
        if not fields:
            self.task.state_fields = fields = sizes
        if list(sizes.items()) != list(fields.items()):
            pairs = {name: (fields.get(name, 0), sizes.get(name, 0)) for name in (*fields, *sizes)}
            for name, (before, now) in pairs.items():
                if before != now:
                    raise self.error(f"it observes {name!r} in different sizes ({before} and {now}); fix it")
            raise self.error(f"it observes {list(sizes)} after {list(fields)}; keep their order")
        self.state = np.concatenate(parts, dtype=np.float64)
        for name, part in zip(observation, parts, strict=True):
            if not (np.abs(part) <= LARGEST).all():
                raise self.error(
                    f"it observes {name!r} with values that are no finite numbers of float32; give finite ones"
                )


class EnvironmentBatch(EpisodeBatch):
    """Episodes of an `EnvironmentTask`, one environment each."""

    task: EnvironmentTask

    def __init__(self, task: EnvironmentTask, size: int):
        super().__init__(task, size)
        self._episodes: list[_Episode | None] = [None] * size

    def _start(self, ids, generators):
        for sim, generator in zip(ids.tolist(), generators, strict=True):
            self._begin(sim, int(generator.integers(2**63)))

    def _begin(self, sim: int, seed: int) -> _Episode:
        """A new episode in a place, in an environment of its own."""
        if before := self._episodes[sim]:
            before.environment.close()
        episode = self._episodes[sim] = _Episode(self.task, self.task.make_environment(seed), sim)
        episode.reset(seed)
        return episode

    def _running(self, sim: int) -> _Episode:
        """The episode of a place; a place that was never reset gets one."""
        return self._episodes[sim] or self._begin(sim, 0)

    def state(self):
        return np.array([self._running(sim).state for sim in range(self.size)], float)

    def physics(self):
        return np.array([self._running(sim).row() for sim in range(self.size)])

    def set_physics(self, physics, ids=None):
        """See `EpisodeBatch`. A task's Python state does not change, so an episode may continue differently.

        The returned states of a user's own task are those of its last step: it observes again in the next one.
        """
        ids = self._all if ids is None else np.asarray(ids, int)
        for sim, row in zip(ids.tolist(), np.asarray(physics, np.float64), strict=True):
            self._running(sim).put(row)
        return self.state()

    def step(self, actions, active=None):
        actions = np.asarray(actions, np.float64)
        reward, discount = np.zeros(self.size), np.ones(self.size)
        moving = self._all if active is None else np.flatnonzero(active)
        episodes = [episode for sim in moving.tolist() if not (episode := self._running(sim)).over]
        terminated, truncated = np.zeros((2, self.size), bool)
        with contextlib.nullcontext() if self.task.trusted else watched(self.task.error, self.alone):
            for episode in episodes:
                sim = episode.place
                reward[sim], discount[sim] = episode.step(actions[sim])
                terminated[sim], truncated[sim] = episode.terminated, episode.truncated
        return StepResult(self.state(), reward, terminated, truncated, discount)
