"""Base of all tasks: a MuJoCo model, a state with named fields, a reward; simulated as a batch of episodes.

A `Task` is the description (one per task id, shared freely). `Task.batch` makes an `EpisodeBatch` of `size` episodes
side by side. Those of DMC-VB's own tasks are each a `PhysicsBatch`: one `mujoco.batch.Batch`, stepped together. Every
other task is stepped by dm_control (see `environment`). Tasks know nothing of pixels.

One agent step is `Task.action_repeat` control steps with the same action; their rewards are summed, each times the
discounts before it, and their discounts multiplied, as an action repeat wrapper does. Step t of an episode holds the
state before action t and the reward that it earned.
"""

from __future__ import annotations

import abc
import copy
import itertools
import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from dmcvb_gen import arithmetic
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.spec import LOCOMOTION

ACTION_REPEAT = 2
"""Control steps an agent step (paper, section 3.2), unless a recipe says otherwise."""
Generators = Sequence[np.random.Generator]
Places = np.ndarray | Sequence[int] | None
"""Indices in a batch; None: all of it."""

PHYSICS_SPEC = int(
    mujoco.mjtState.mjSTATE_FULLPHYSICS
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)
"""The `mjtState` bits of the stored `physics`: all that decides what the simulation does next and how
it looks, of DMC-VB's own tasks. The solver's warm start is in, so that a step redone from a stored state gives the same
bits."""


@dataclass(frozen=True)
class StepResult:
    """Result of one agent step of a batch.

    Attributes:
      state: (size, state) float64, the states after the step.
      reward: (size,) float64, summed over the control steps, each times the discounts before it.
      terminated: (size,) bool, the task ended by itself (never by the time limit).
      truncated: (size,) bool, the task cut the episode off: what follows would have had a value.
      discount: (size,) float64, the product of the control steps' discounts; 0 where the task ended.
    """

    state: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    discount: np.ndarray


class EpisodeError(DmcvbError):
    """An episode that cannot go on: the simulation diverged, or a user's own code failed.

    Args:
      task_id: the task.
      place: index in the batch.
      step: agent steps that were made before.
      reason: what happened, and what to do.
      episode: index in the subset, if it is known.
    """

    def __init__(self, task_id: str, place: int, step: int, reason: str, episode: int | None = None):
        super().__init__(task_id, place, step, reason, episode)
        self.task_id, self.place, self.step, self.reason, self.episode = self.args

    def __str__(self) -> str:
        which = "" if self.episode is None else f"episode {self.episode}, "
        return f"task {self.task_id}, {which}step {self.step}: {self.reason}"

    def of_episode(self, episode: int) -> EpisodeError:
        """The same error, with the episode's index in its subset."""
        return EpisodeError(self.task_id, self.place, self.step, self.reason, episode)


class Task(abc.ABC):
    """A task, as DMC-VB means it.

    Attributes:
      id: the task's name, e.g. "walker-walk".
      family: "locomotion" or "ant-maze": which settings it takes.
      model: the compiled MuJoCo model. Never change it: renderers and batches share it.
      state_fields: name -> size of each part of the state, in the state's order.
      max_steps: agent steps at which the time limit ends an episode of data.
      evaluation_steps: the same for the online evaluation of agents.
      action_repeat: control steps an agent step; see `at`.
      substeps: physics steps a control step.
      views: the names of the pictures made of each frame; ("pixels",) for a task with one.
      return_range: (lowest, highest) return an episode of data can have.
      observation: the name of what behaviour policies see, `EpisodeBatch.behaviour_observation`; policy files hold it.
      behaviour_size: how many numbers these are.
    """

    id: str
    family: str = LOCOMOTION
    model: mujoco.MjModel
    state_fields: Mapping[str, int]
    max_steps: int
    evaluation_steps: int
    action_repeat: int = ACTION_REPEAT
    substeps: int
    views: tuple[str, ...] = ("pixels",)
    return_range: tuple[float, float] = (-math.inf, math.inf)
    observation: str = "state"

    cameras: tuple[int | str, ...] = (0,)
    """The model's camera behind each of `views`."""
    goal_geoms: tuple[int, ...] = ()
    """Geoms left out of the hidden-goal pictures."""

    unstored_fields: tuple[str, ...] = ()
    """Fields of the state that a physics state alone does not give."""
    replayed: bool = False
    """True if a stored episode is checked by replaying its actions from its start, False if by single steps."""
    ends_itself: bool = False
    """True if an episode cannot be longer than `max_steps`."""
    most_at_once: int | None = None
    """Episodes that are simulated side by side at most, for their memory; None: any number."""
    physics_spec: int = PHYSICS_SPEC
    """The `mjtState` bits that each row of the stored `physics` begins with."""

    floor_alpha: float = 0.3
    """Opacity of the ground plane under distractors (Distracting Control Suite)."""
    model_entries: Mapping[str, np.ndarray] = {}
    """Model field -> flat indices of the entries that an episode sets; `physics` rows end with their values."""
    draws_terrain: bool = False
    """True if each episode draws height fields too large for a row of `physics`."""

    @property
    def picture_model(self) -> mujoco.MjModel:
        """Model for renderers: `model` with its textures, if `model` itself has none."""
        return self.model

    def styles(self, split: str) -> tuple[tuple[int, ...], ...]:
        """The looks (labels `style`) of each visual style of data ("train") or evaluation ("val"); none without styles.

        All looks of a style are as likely.
        """
        return ()

    def style_geom_matid(self, look: int) -> np.ndarray | None:
        """(geom,) int: material of every geom under a visual look; None if a task has no styles."""
        return None

    @property
    def material_colors(self) -> np.ndarray:
        """(material, 3) float64: the model's own colors in [0, 1]; one row of ones if it has no material."""
        return np.asarray(self.model.mat_rgba[:, :3], np.float64) if self.model.nmat else np.ones((1, 3))

    @property
    def action_size(self) -> int:
        """Actions are float32 (action_size,) between `action_low` and `action_high`."""
        return self.model.nu

    @property
    def action_low(self) -> np.ndarray:
        """(action,) float32: the least action that the task takes."""
        return np.full(self.action_size, -1, np.float32)

    @property
    def action_high(self) -> np.ndarray:
        """(action,) float32: the largest action that the task takes."""
        return np.full(self.action_size, 1, np.float32)

    def from_unit(self, actions: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1], (..., action), as a policy gives them, scaled to the task's own bounds."""
        return arithmetic.from_unit(actions, self.action_low, self.action_high)

    @property
    def array_attributes(self) -> dict[str, dict[str, Any]]:
        """What is stored with the arrays of a subset, by name; nothing of DMC-VB's own tasks, which are all alike."""
        return {}

    @property
    def state_size(self) -> int:
        return sum(self.state_fields.values())

    @property
    def state_slices(self) -> dict[str, slice]:
        """Slice of each field in the state."""
        return slices_of(self.state_fields)

    @property
    def behaviour_size(self) -> int:
        return self.state_size

    @property
    def physics_size(self) -> int:
        """Length of a stored physics state (float64): `physics_spec`, then the values of `model_entries`."""
        return mujoco.mj_stateSize(self.model, self.physics_spec) + sum(map(len, self.model_entries.values()))

    def split_entries(self, physics: np.ndarray) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Fields of `model_entries`, their flat indices, and their values (frame, index) in (frame, physics) rows."""
        first = mujoco.mj_stateSize(self.model, self.physics_spec)
        for name, columns in self.model_entries.items():
            yield name, columns, physics[:, first : first + len(columns)]
            first += len(columns)

    def apply_entries(self, model: mujoco.MjModel, row: np.ndarray) -> None:
        """Put the model entries of a (physics,) row into a model of the caller's own."""
        for name, columns, values in self.split_entries(row[None]):
            owner, field = field_owner(model, name)
            value = getattr(owner, field)
            if isinstance(value, np.ndarray):
                value.reshape(-1)[columns] = values[0]
            else:
                setattr(owner, field, type(value)(values[0, 0]))

    @property
    def control_timestep(self) -> float:
        """Seconds a control step."""
        return self.substeps * self.model.opt.timestep

    @property
    def seconds_per_step(self) -> float:
        """Seconds an agent step."""
        return self.action_repeat * self.control_timestep

    def at(self, action_repeat: int) -> Task:
        """This task at an action repeat; its time limits last as long, in other numbers of agent steps."""
        made = self.__dict__.setdefault("_at", {self.action_repeat: self})  # which copies share
        if action_repeat not in made:
            made[action_repeat] = other = copy.copy(self)
            other.action_repeat = action_repeat
            for name in ("max_steps", "evaluation_steps"):
                setattr(other, name, math.ceil(getattr(self, name) * self.action_repeat / action_repeat))
        return made[action_repeat]

    @abc.abstractmethod
    def batch(self, size: int, threads: int = 1) -> EpisodeBatch:
        """`size` episodes side by side, stepped on `threads` threads (the result does not depend on them)."""


def slices_of(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Slice of each field, name -> size, of fields one after another."""
    ends = itertools.accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def field_owner(model: mujoco.MjModel, name: str) -> tuple[Any, str]:
    """The object that holds a field of a model, "geom_size" or "opt.gravity", and the field's name in it."""
    owner, _, field = name.rpartition(".")
    return (operator.attrgetter(owner)(model) if owner else model), field


class EpisodeBatch(abc.ABC):
    """`size` episodes of one task, simulated together. A simulation never influences its neighbors.

    Attributes:
      alone: False if other threads may draw random numbers meanwhile. Draws of a user's task from global generators
        are not detected then.
    """

    alone = True

    def __init__(self, task: Task, size: int):
        self.task = task
        self.size = size
        self._all = np.arange(size)

    @abc.abstractmethod
    def _start(self, ids: np.ndarray, generators: Generators) -> None:
        """Start new episodes in the simulations `ids`, one generator each."""

    @abc.abstractmethod
    def state(self) -> np.ndarray:
        """(size, state) float64: the current states, fields as in `task.state_fields`."""

    @abc.abstractmethod
    def physics(self) -> np.ndarray:
        """(size, physics) float64: the states to set back into MuJoCo (`task.physics_spec`), then model entries."""

    @abc.abstractmethod
    def set_physics(self, physics: np.ndarray, ids: Places = None) -> np.ndarray:
        """Put simulations into stored physics states; gives all states (size, state).

        Args:
          physics: (len(ids), physics) float64.
        """

    @abc.abstractmethod
    def step(self, actions: np.ndarray, active: np.ndarray | None = None) -> StepResult:
        """One agent step.

        Args:
          actions: (size, action) in the task's bounds; MuJoCo clips them to the control limits as in dm_control.
          active: (size,) bool, the simulations to step; the others stay as they are and earn nothing.
            All by default.

        An episode that terminates at a control step is frozen for the rest: its state stays what it was at the end and
        it earns nothing more (as an action repeat wrapper that breaks).

        Raises:
          EpisodeError: a simulation diverged, or a user's own task failed or gave what is no finite number.
        """

    def behaviour_observation(self) -> np.ndarray:
        """(size, behaviour_size) float32: what behaviour policies see, `task.observation`; the state by default."""
        return self.state().astype(np.float32)

    def reset(self, generators: Generators, ids: Places = None) -> np.ndarray:
        """Start new episodes.

        Args:
          generators: one a simulation of `ids`; each is used for that episode's initial state alone.
          ids: the simulations to restart; all by default.

        Returns:
          (size, state) float64, the states of all simulations.
        """
        ids = self._all if ids is None else np.asarray(ids, int)
        if len(ids):
            self._start(ids, generators)
        return self.state()

    def reset_fixed(self, generators: Generators, pairs: Sequence[tuple], ids: Places = None) -> np.ndarray:
        """Do as `reset` at given (start, goal) cells, which mazes have.

        Raises:
          DmcvbError: the task has no goals.
        """
        raise DmcvbError(f"{self.task.id} has no cells to start at; give an ant-maze task")


class PhysicsBatch(EpisodeBatch):
    """Episodes of one of DMC-VB's own tasks, written for a whole batch.

    Built on a persistent `mujoco.batch.Batch` stepped with `mjSTAGE_VEL`, which makes positions,
    velocities and sensors current after each control step as dm_control does.
    """

    def __init__(self, task: Task, size: int, threads: int = 1):
        super().__init__(task, size)
        self.sims = Batch(task.model, size, nthread=threads, persistent=True)
        bind = self.sims.bind
        self._qpos, self._qvel, self._ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        self._xmat, self._xpos, self._sensors = bind("xmat"), bind("xpos"), bind("sensordata")
        self._steps = np.zeros(size, int)
        self._physics_columns = physics_columns(task.model)

    # -- what a task must say ---------------------------------------------------------------

    @abc.abstractmethod
    def _initialize(self, ids: np.ndarray, generators: Generators) -> None:
        """Set the initial physics state of the simulations `ids`, one generator each; end with `_refresh`."""

    @abc.abstractmethod
    def _control_reward(self) -> np.ndarray:
        """(size,) float64: the reward of the control step just taken."""

    def _control_terminated(self) -> np.ndarray:
        """(size,) bool: whether the control step just taken ended the episode."""
        return np.zeros(self.size, bool)

    # -- what callers use -------------------------------------------------------------------

    def _start(self, ids, generators):
        self._clear(ids)
        self._initialize(ids, generators)

    def _clear(self, ids: np.ndarray) -> None:
        """Put simulations into the model's own pose, with nothing computed yet."""
        self.sims.reset(ids=ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self.sims.warning[ids] = 0
        self._steps[ids] = 0

    def step(self, actions, active=None):
        moving = np.ones(self.size, bool) if active is None else np.array(active, bool)
        self._ctrl[moving] = np.asarray(actions, np.float64)[moving]
        reward = np.zeros(self.size)
        terminated = np.zeros(self.size, bool)
        stepped = np.flatnonzero(moving)
        for _ in range(self.task.action_repeat):
            if not moving.any():
                break
            self._advance(None if moving.all() else np.flatnonzero(moving))
            reward += np.where(moving, self._control_reward(), 0.0)
            ended = self._control_terminated() & moving
            terminated |= ended
            moving &= ~ended
        counts = self.sims.warning[..., 1]
        for sim in stepped[counts[stepped].any(axis=1)].tolist():  # its state means nothing
            names = [mujoco.mjtWarning(kind).name for kind in np.flatnonzero(counts[sim])]
            raise EpisodeError(self.task.id, sim, int(self._steps[sim]), diverged(names))
        self._steps[stepped] += 1
        nothing = np.zeros(self.size, bool)
        return StepResult(self.state(), reward, terminated, nothing, np.where(terminated, 0.0, 1.0))

    def _advance(self, ids: np.ndarray | None) -> None:
        self.sims.step(ids=ids, nstep=self.task.substeps, stage=int(mujoco.mjtStage.mjSTAGE_VEL))

    def _refresh(self, ids: np.ndarray) -> None:
        """Make derived fields current after a write to the state."""
        self.sims.forward(ids=ids, stage=int(mujoco.mjtStage.mjSTAGE_VEL))

    def physics(self):
        return self.sims.state[:, self._physics_columns].copy()

    def set_physics(self, physics, ids=None):
        ids = self._all if ids is None else np.asarray(ids, int)
        self._clear(ids)
        self.sims.state[np.ix_(ids, self._physics_columns)] = physics
        self._refresh(ids)
        return self.state()


def diverged(warnings: Sequence[str]) -> str:
    """The reason of an `EpisodeError` for MuJoCo's warnings."""
    return f"the simulation diverged ({', '.join(warnings)}); make its model stable, or its actions smaller"


def physics_columns(model: mujoco.MjModel, spec: int = PHYSICS_SPEC) -> np.ndarray:
    """Indices of the components of `spec` inside a state vector of `mjSTATE_INTEGRATION`."""
    whole = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    columns = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_extractState(model, np.arange(mujoco.mj_stateSize(model, whole), dtype=float), whole, columns, spec)
    return columns.astype(int)


def tolerance(x, lower, upper=np.inf, margin=1.0, sigmoid="gaussian", value_at_margin=0.1):
    """1 where x lies in [lower, upper], falling to `value_at_margin` at `margin` outside (elementwise).

    The reward shape of the DeepMind Control Suite, for arrays: sigmoid "gaussian", "linear" or "quadratic".
    """
    x = np.asarray(x, np.float64)
    inside = (lower <= x) & (x <= upper)
    distance = np.where(x < lower, lower - x, x - upper) / margin
    if sigmoid == "gaussian":
        scale = math.sqrt(-2 * math.log(value_at_margin))
        value = arithmetic.exp(-0.5 * (distance * scale) ** 2)
    elif sigmoid == "linear":
        scaled = distance * (1 - value_at_margin)
        value = np.where(np.abs(scaled) < 1, 1 - scaled, 0.0)
    else:
        scaled = distance * math.sqrt(1 - value_at_margin)
        value = np.where(np.abs(scaled) < 1, 1 - scaled**2, 0.0)
    return np.where(inside, 1.0, value)
