"""Teach a policy of the open maze the way through a layout.

A policy that walks straight to goals gets through every maze when it is shown a point on the way instead of the
goal. A guide that has the layout before it can show such points, but behaviour policies must not see the layout; so
a small network before the policy learns to say where the guide would point, from where ant and goal are. It is asked
where the student itself walks (DAgger, Ross et al. 2011), and anywhere else in the maze too. Minutes, where
reinforcement learning in a maze takes hours; and a student half-way runs as fast as an expert, but gets lost.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import copy_file
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.header import MAX_LAYERS, WAY_SIZE, Width
from dmcvb_gen.policies.open_maze import places
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.spec import is_maze
from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout
from dmcvb_gen.tasks.ant_maze.task import GOAL_NOISE
from dmcvb_gen.tasks.ant_maze.waypoints import AHEAD, headings
from dmcvb_gen.training.episodes import Episodes
from dmcvb_gen.training.networks import WaypointNetwork, as_arrays, as_tensors
from dmcvb_gen.training.row_files import check_rows
from dmcvb_gen.training.runs import ProgressCallback, Report, Run
from dmcvb_gen.training.sac import RowBuffer
from dmcvb_gen.training.settings import Count, Natural, NonNegative, Positive, Share

GUIDE = "ant-maze-empty7x7"
"""The task whose bundled expert walks if --init-from names none."""

WALKER = "walker.safetensors"

MOST_CELLS = 15
"""Rows or columns of the largest maze that is learned: an ant runs about twenty cells in an episode (1.6 m/s, 30 s)."""

EVALUATION_STEPS = 40.0
"""Agent steps simulated in evaluations for each one trained, at most.

Here evaluations take most of the time, not a fifth of it as in SAC's runs: a step costs 3.0 ms trained and 1.8 ms
evaluated (one core, 32 simulations), so a fifth would be 0.4 steps, 28 episodes in the 40,000 steps of a run. But the
policy goes from lost to expert within 10,000 steps, and medium is picked from checkpoints 300 steps apart, each judged
on twenty episodes, whose returns have a standard deviation of 190. Above 900, a larger --evaluate-every takes less, at
`most_evaluation_episodes`. The bound is counted in steps, not in seconds, so that a run that is stopped and resumed
gives the same bits however busy its machine is."""


@dataclass(frozen=True)
class GuidedSettings:
    """Settings of `GuidedRun`.

    Attributes:
      simulations: episodes stepped side by side.
      updates_per_step: gradient updates an agent step (all simulations together count `simulations` steps).
      buffer_size: agent steps remembered.
      batch_size: places an update.
      learning_rate: largest learning rate.
      ramp: agent steps in which the learning rate rises to `learning_rate`: so that there are checkpoints on the way to
        an expert, which medium is picked from.
      half_life: agent steps in which the learning rate halves.
      ahead: meters down the way at which the guide points.
      mean_share: share of the simulations in which the student acts by its mean, as data are made.
      drawn_share: share of a batch that lies at places drawn anew all over the maze; the rest is where students were.
      sunken_starts: share of training episodes that start deep in the floor, see sac's.
      train_episode_steps: cut training episodes off after so many agent steps (0: the task's limit).
      layers, width: hidden layers of the network that learns the way, and units of one.
    """

    simulations: Count = 32
    batch_size: Count = 512
    learning_rate: Positive = 1e-3
    ramp: Natural = 12_000
    half_life: Positive = 12_500
    layers: Annotated[Count, Field(le=MAX_LAYERS)] = 3
    width: Width = 256
    updates_per_step: Positive = 0.06
    buffer_size: Count = 400_000
    ahead: NonNegative = AHEAD
    mean_share: Share = 0.5
    drawn_share: Share = 0.5
    sunken_starts: Share = 0.3
    train_episode_steps: Natural = 300


class GuidedRun(Run):
    """A run that learns the way. The student walks as the policy that it starts from, which stays as it is."""

    @functools.cached_property
    def walker(self) -> Policy:
        """The policy that walks; it does not know where to."""
        if not is_maze(self.task.id):
            raise DmcvbError(f"--algo guided is for ant mazes, there is no way to a goal in {self.task.id}")
        return load_policy(self._walker_file(), self.task)

    def _walker_file(self) -> Path:
        kept, source = self.folder / "resume" / WALKER, self.config.init_from
        if kept.exists():
            return kept
        return resolve_policies(self.task.id if source else GUIDE, "expert", source)[0]

    def network(self) -> dict[str, Any]:
        header, settings = self.walker.header, self.settings
        kept = ("hidden", "activation", "layer_norm", "distribution", "noise", "clip_observation")
        return {name: getattr(header, name) for name in kept} | {"way": (settings.width,) * settings.layers}

    def describe(self) -> dict[str, Any]:
        return {"walker": self.walker.digest}

    def warmup(self) -> int:
        return 0

    def problem(self) -> str | None:
        rows, columns = self.task.layout.shape
        if max(rows, columns) > MOST_CELLS:
            return (
                f"maze {self.task.layout.name} is {rows} x {columns} cells; an episode of {self.task.max_steps} steps "
                f"is too short to cross more than {MOST_CELLS} x {MOST_CELLS}, so give a smaller layout"
            )
        return self.too_few_updates(0)

    def evaluation_steps(self) -> float:
        return EVALUATION_STEPS

    def most_evaluation_episodes(self) -> int:
        return 3 * super().most_evaluation_episodes()

    def _train(self, saved: dict[str, Any] | None, report: Report, tick: ProgressCallback) -> None:
        settings, config = self.settings, self.config
        if not (kept := self.folder / "resume" / WALKER).exists():
            copy_file(self._walker_file(), kept)  # what --init-from names may be gone later
        learner, next_evaluation = Student(self), config.evaluate_every
        if saved:
            learner.load_state(saved["learner"])
            next_evaluation = saved["next_evaluation"]
        episodes = Episodes(self, learner.rng)
        if saved:
            observation = episodes.restore(saved["episodes"])
        else:
            observation = episodes.start(np.arange(settings.simulations))

        def state() -> dict[str, Any]:
            parts = {"learner": learner.state(), "episodes": episodes.saved(observation)}
            return parts | {"next_evaluation": next_evaluation}

        while self.step < config.steps:
            result = episodes.batch.step(learner.act(observation))
            self.step += settings.simulations
            observation = episodes.restart_ended(episodes.batch.behaviour_observation(), result)
            learner.learn(self.step)
            tick(settings.simulations)
            if self.step >= min(next_evaluation, config.steps):
                metrics = {"squared_error": learner.loss}
                progress = self.record(learner.weights(), learner.updates, metrics, report)
                next_evaluation = self.next_evaluation(progress.evaluation, next_evaluation)
            self.between_rounds(state)
        self.save(state())


class Student:
    """A student beside its guide: it walks, notes where it was and where the guide would have pointed, and learns that.

    Attributes:
      updates: gradient updates so far.
      loss: the last one's mean squared error, square meters.
    """

    def __init__(self, run: GuidedRun):
        self.run, self.settings = run, run.settings
        task, config, settings = run.task, run.config, run.settings
        torch.manual_seed(config.seed)
        self.way = WaypointNetwork((settings.width,) * settings.layers)
        self.optimizer = torch.optim.Adam(self.way.parameters(), lr=settings.learning_rate, fused=True)
        rows = max(min(settings.buffer_size, config.steps), settings.simulations)
        self.buffer = RowBuffer(rows, {"place": (WAY_SIZE,), "heading": (2,)}, run.folder / "resume")
        self.rng = np.random.default_rng([config.seed, 0xB0FF])
        self.noise = self.rng.spawn(settings.simulations)
        self.layout = task.layout
        self.owed, self.updates, self.loss = 0.0, 0, 0.0

    def weights(self) -> dict[str, torch.Tensor]:
        """Return the weights of the whole policy: it walks as before and knows the way as far as learned."""
        known = {name: value for name, value in self.run.walker.weights.items() if not name.startswith("way.")}
        return as_tensors(known) | self.way.weights()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Actions, (n, action) float32, by mean and drawn; where the guide would point is noted."""
        place = places(observation)
        self.buffer.add(place=place, heading=self._shown(place))
        policy = Policy(self.run.header, as_arrays(self.weights()), "")
        action = policy.act(observation, deterministic=True)
        by_mean = round(self.settings.mean_share * len(observation))
        if by_mean < len(observation):
            action[by_mean:] = policy.act(observation[by_mean:], self.noise[by_mean:])
        return action

    def _shown(self, place: np.ndarray) -> np.ndarray:
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
            self.loss = self.update(
                torch.cat([batch["place"], torch.from_numpy(place)]),
                torch.cat([batch["heading"], torch.from_numpy(self._shown(place))]),
            )
            self.owed -= 1
            self.updates += 1

    def update(self, place: torch.Tensor, heading: torch.Tensor) -> float:
        """One gradient step; gives the error before it."""
        loss = ((self.way(place) - heading) ** 2).sum(dim=1).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())

    def state(self) -> dict[str, Any]:
        """Everything that learning continues from."""
        self.buffer.flush()
        return {
            "walker": self.run.walker.digest,
            "way": self.way.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "rng": json.dumps([rng.bit_generator.state for rng in (self.rng, *self.noise)]),
            "buffer": {"position": self.buffer.position, "full": self.buffer.full, "rows": self.buffer.size},
            "owed": self.owed,
            "updates": self.updates,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`.

        Raises:
          DmcvbError: it walked as another policy.
        """
        if state["walker"] != self.run.walker.digest:
            raise DmcvbError(
                f"{self.run.folder} was begun with another walking policy than the one here; choose another --out"
            )
        check_rows(self.run.folder, self.buffer.found, **state["buffer"])
        self.way.load_state_dict(state["way"])
        self.optimizer.load_state_dict(state["optimizer"])
        for rng, saved in zip((self.rng, *self.noise), json.loads(state["rng"]), strict=True):
            rng.bit_generator.state = saved
        self.buffer.restore(**state["buffer"])
        self.owed, self.updates = state["owed"], state["updates"]


def draw_places(layout: Layout, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, `WAY_SIZE`) float32: an ant anywhere on the floor and a goal where goals are put, meters."""
    free = np.array([layout.world(cell) for cell in layout.free])
    ant, goal = free[rng.integers(len(free), size=(2, count))]
    ant = ant + rng.uniform(-CELL / 2, CELL / 2, ant.shape)
    goal = goal + rng.uniform(-GOAL_NOISE, GOAL_NOISE, goal.shape)
    return np.concatenate([ant, goal], axis=1, dtype=np.float32)
