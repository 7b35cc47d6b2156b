"""Teach a policy of the open maze the way through a layout.

A policy that walks straight to goals gets through every maze when it is shown a point on the way instead of the
goal. A guide that has the layout before it can show such points, but behaviour policies must not see the layout; so
a small network before the policy learns to say where the guide would point, from where ant and goal are. It is asked
where the student itself walks (DAgger, Ross et al. 2011), and anywhere else in the maze too. Minutes, where
reinforcement learning in a maze takes hours; and a student half-way runs as fast as an expert, but gets lost.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import write_bytes
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.header import MAX_LAYERS, WAY_SIZE, Width
from dmcvb_gen.policies.open_maze import places
from dmcvb_gen.policies.policy_file import load_policy, read_header
from dmcvb_gen.spec import is_maze
from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout
from dmcvb_gen.tasks.ant_maze.task import GOAL_NOISE
from dmcvb_gen.tasks.ant_maze.waypoints import AHEAD, headings
from dmcvb_gen.training.episodes import Episodes, EpisodeSettings
from dmcvb_gen.training.networks import WaypointNetwork, as_arrays, as_tensors
from dmcvb_gen.training.run import Run
from dmcvb_gen.training.sac import RowBuffer
from dmcvb_gen.training.settings import Count, Natural, NonNegative, Positive, Share

GUIDE = "ant-maze-empty7x7"
"""The task whose bundled expert walks if --init-from names none."""

BASE_POLICY = "base_policy.safetensors"
"""Copy of the policy that walks, in the run's folder `resume`: what --init-from names may be gone later."""

MOST_CELLS = 15
"""Rows or columns of the largest maze that is learned: an ant runs about twenty cells in an episode (1.6 m/s, 30 s)."""

EVALUATION_STEPS = 40.0
"""Agent steps simulated in evaluations for each one trained, at most.

Here evaluations take most of the time, not a fifth of it as in SAC's runs: a step costs 3.0 ms trained and 1.8 ms
evaluated (one core, 32 simulations), so a fifth would be 0.4 steps, 28 episodes in the 40,000 steps of a run. But the
policy goes from lost to expert within 10,000 steps, and medium is picked from checkpoints 300 steps apart, each judged
on twenty episodes, whose returns have a standard deviation of 190. The bound is counted in steps, not in seconds, so
that a run that is stopped and resumed gives the same bits however busy its machine is."""
TIMES_MORE_EPISODES = 3
"""An evaluation has at most so many times the episodes of other trainings."""


@dataclass(frozen=True)
class Settings(EpisodeSettings):
    """Settings of the guided training.

    Attributes:
      updates_per_step: gradient updates an agent step (all simulations together count `simulations` steps).
      buffer_size: agent steps remembered.
      batch_size: places an update.
      learning_rate: learning rate before `ramp` and `half_life` lower it.
      ramp: agent steps in which the learning rate rises from 0: so that there are checkpoints on the way to an expert,
        which medium is picked from.
      half_life: agent steps in which the learning rate halves.
      ahead: meters down the way at which the guide points.
      greedy_fraction: share of the simulations in which the student acts by its mean, as data are made.
      drawn_share: share of a batch that lies at places drawn anew all over the maze; the rest is where students were.
      layers, width: hidden layers of the network that learns the way, and units of one.
    """

    simulations: Count = 32
    train_episode_steps: Natural = 300
    low_spawn_fraction: Share = 0.3
    updates_per_step: Positive = 0.06
    buffer_size: Count = 400_000
    batch_size: Count = 512
    learning_rate: Positive = 1e-3
    ramp: Natural = 12_000
    half_life: Positive = 12_500
    ahead: NonNegative = AHEAD
    greedy_fraction: Share = 0.5
    drawn_share: Share = 0.5
    layers: Annotated[Count, Field(le=MAX_LAYERS)] = 3
    width: Width = 256


class Student:
    """A student beside its guide: it notes where it was and where the guide would have pointed, and learns that.

    Attributes:
      base: the policy that walks; it stays as it is.
      updates: gradient updates so far.
      loss: the last one's mean squared error, square meters.
    """

    def __init__(self, run: Run, base: Policy):
        self.settings, self.base, self.header = run.settings, base, run.header
        settings = run.settings
        torch.manual_seed(run.config.seed)
        self.way = WaypointNetwork((settings.width,) * settings.layers)
        self.optimizer = torch.optim.Adam(self.way.parameters(), lr=settings.learning_rate, fused=True)
        rows = max(settings.buffer_size, settings.simulations)
        self.buffer = RowBuffer(rows, {"place": (WAY_SIZE,), "heading": (2,)})
        self.rng = np.random.default_rng([run.config.seed, 0xB0FF])
        self.noise = self.rng.spawn(settings.simulations)
        self.layout = run.task.layout  # type: ignore[attr-defined]  # a maze's
        self.owed, self.updates, self.loss = 0.0, 0, 0.0

    def weights(self) -> dict[str, torch.Tensor]:
        """Return the weights of the whole policy: it walks as before and knows the way as far as learned."""
        known = {name: value for name, value in self.base.weights.items() if not name.startswith("way.")}
        return as_tensors(known) | self.way.weights()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Actions, (n, action) float32, by mean and drawn; where the guide would point is noted."""
        place = places(observation)
        self.buffer.add(place=place, heading=self.shown(place))
        policy = Policy(self.header, as_arrays(self.weights()), "")
        action = policy.act(observation, deterministic=True)
        by_mean = round(self.settings.greedy_fraction * len(observation))
        if by_mean < len(observation):
            action[by_mean:] = policy.act(observation[by_mean:], self.noise[by_mean:])
        return action

    def shown(self, place: np.ndarray) -> np.ndarray:
        """(n, `WAY_SIZE`) -> (n, 2) float32: where the guide points."""
        return headings(self.layout, place[:, :2], place[:, 2:], self.settings.ahead).astype(np.float32)

    def learn(self, step: int) -> None:
        """The updates that a step of all simulations is worth."""
        settings = self.settings
        risen = min(1.0, step / max(settings.ramp, 1))
        self.optimizer.param_groups[0]["lr"] = settings.learning_rate * risen * 0.5 ** (step / settings.half_life)
        self.owed += settings.updates_per_step * settings.simulations
        drawn = round(settings.drawn_share * settings.batch_size)
        while self.owed >= 1:
            place = draw_places(self.layout, self.rng, drawn)
            batch = self.buffer.sample(self.rng, settings.batch_size - drawn)
            seen = torch.cat([batch["place"], torch.from_numpy(place)])
            pointed = torch.cat([batch["heading"], torch.from_numpy(self.shown(place))])
            loss = ((self.way(seen) - pointed) ** 2).sum(dim=1).mean()
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            self.loss = float(loss.detach())
            self.owed -= 1
            self.updates += 1

    def state(self) -> dict[str, Any]:
        """Everything that learning continues from."""
        return {
            "way": self.way.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "rng": json.dumps([rng.bit_generator.state for rng in (self.rng, *self.noise)]),
            "buffer": self.buffer.state(),
            "owed": self.owed,
            "updates": self.updates,
            "loss": self.loss,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.way.load_state_dict(state["way"])
        self.optimizer.load_state_dict(state["optimizer"])
        for rng, saved in zip((self.rng, *self.noise), json.loads(state["rng"]), strict=True):
            rng.bit_generator.state = saved
        self.buffer.load_state(state["buffer"])
        self.owed, self.updates, self.loss = state["owed"], state["updates"], state["loss"]


def base_policy(run: Run) -> Policy:
    """The policy that walks; it does not know where to.

    Raises:
      DmcvbError: the task is no maze, or the policy does not fit.
    """
    if not is_maze(run.task.id):
        raise DmcvbError(f"--algo guided is for ant mazes, there is no way to a goal in {run.task.id}")
    path = _base_file(run)
    return load_policy(path, None if is_maze(read_header(path).task) else run.task)  # whatever way it knows goes


def _base_file(run: Run) -> Path:
    kept, source = run.folder / "resume" / BASE_POLICY, run.config.init_from
    return kept if kept.exists() else resolve_policies(run.task.id if source else GUIDE, "expert", source)[0]


def network(run: Run) -> dict[str, Any]:
    """The header's fields that say how the actor is built: as the policy that walks, with a way before it."""
    base = base_policy(run)
    kept = ("hidden", "activation", "distribution", "noise", "clip_observation")
    fields = {name: getattr(base.header, name) for name in kept}
    return fields | {"way": (run.settings.width,) * run.settings.layers, "training": {"walker": base.digest}}


def check(run: Run) -> None:
    """Refuse, before anything is written, a maze that is too large to learn.

    Raises:
      DmcvbError: what is wrong and the cure.
    """
    layout = run.task.layout  # type: ignore[attr-defined]  # a maze's
    if max(layout.shape) > MOST_CELLS:
        raise DmcvbError(
            f"maze {layout.name} is {layout.shape[0]} x {layout.shape[1]} cells; an episode of {run.task.max_steps} "
            f"steps is too short to cross more than {MOST_CELLS} x {MOST_CELLS}, so give a smaller layout"
        )


def train(run: Run) -> None:
    """Train until the run's last step, or until it is stopped."""
    base, settings = base_policy(run), run.settings
    if not (kept := run.folder / "resume" / BASE_POLICY).exists():
        write_bytes(kept, _base_file(run).read_bytes())
    student, saved = Student(run, base), run.saved()
    episodes = Episodes(run.task, settings, run.config.seed, student.rng)

    def state() -> dict[str, Any]:
        return {"learner": student.state(), "episodes": episodes.saved()}

    if saved:
        student.load_state(saved["learner"])
        episodes.restore(saved["episodes"])
    else:
        run.save(state())
    while run.step < run.config.steps:
        episodes.step(student.act(episodes.observation))
        run.advance(settings.simulations)
        student.learn(run.step)
        if run.evaluation_is_due():
            run.record(student.weights(), student.updates, {"squared_error": student.loss})
        run.checkpoint_if_due(state, student.weights)
    run.save(state())


def draw_places(layout: Layout, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, `WAY_SIZE`) float32: an ant anywhere on the floor and a goal where goals are put, meters."""
    free = np.array([layout.world(cell) for cell in layout.free])
    ant, goal = free[rng.integers(len(free), size=(2, count))]
    ant = ant + rng.uniform(-CELL / 2, CELL / 2, ant.shape)
    goal = goal + rng.uniform(-GOAL_NOISE, GOAL_NOISE, goal.shape)
    return np.concatenate([ant, goal], axis=1, dtype=np.float32)
