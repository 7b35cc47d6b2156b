"""Imitating a guide through a maze: a policy of the open maze in, an actor that knows one layout out.

A policy that walks straight to goals gets through every maze when it is shown a point on the way instead
of the goal. This guide knows the layout, which behaviour policies must not see; so a student, which sees what
behaviour policies see, learns to act as it does (DAgger, Ross et al. 2011: the student walks, the guide
says what it would have done there). Minutes, where reinforcement learning in a maze takes hours.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from dmcvb_gen.behaviours.learning.episodes import Episodes
from dmcvb_gen.behaviours.learning.networks import Actor, as_tensors
from dmcvb_gen.behaviours.learning.runs import SAVE_SECONDS, Report, Run, Tick
from dmcvb_gen.behaviours.learning.sac import RowBuffer
from dmcvb_gen.behaviours.learning.settings import Count, Natural, NonNegative, Positive, Share
from dmcvb_gen.behaviours.policies.actor import Policy
from dmcvb_gen.behaviours.policies.bundled import resolve_policies
from dmcvb_gen.behaviours.policies.policy_file import load_policy
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.names import ANT_MAZE
from dmcvb_gen.tasks.ant_maze.waypoints import AHEAD

GUIDE = "ant-maze-empty7x7"
"""The task whose bundled expert is the guide where --init-from names none."""


@dataclass(frozen=True)
class GuidedSettings:
    """Settings of `GuidedRun`.

    Attributes:
      simulations: episodes stepped side by side.
      updates_per_step: gradient updates an agent step (all simulations together count `simulations` steps).
      buffer_size: agent steps remembered.
      ahead: how far down the way the guide is shown where to go, meters.
      mean_share: share of the simulations in which the student acts by its mean, as data are made: it learns what the
        guide would do where its own mean stands still.
      sunken_starts: share of training episodes that start deep in the floor, see sac's.
      guided_share: share of training episodes that the guide walks itself.
      least_std: the guide's standard deviations count as at least this, so that no action weighs without bound.
      train_episode_steps: cut training episodes off after so many agent steps (0: the task's limit).
      fresh: begin with random weights instead of the guide's: in an open maze, where the guide's own weights are an
        expert from the first step on, a student that learns to run passes through what medium is picked from.
      half_life: agent steps in which the learning rate halves.
      layers: hidden layers of the student; those that the guide lacks begin as identities. More fit a fixed set of
        steps better (medium7x7a, an earlier guide, after 7,500 updates: 1.9, 1.5 and 1.4 nats on unseen steps with 2,
        3 and 4 layers of 256), but an update of 4 takes twice the time of 2, and no student with 4 was seen to walk
        better.
    """

    simulations: Count = 32
    batch_size: Count = 512
    learning_rate: Positive = 1e-3
    half_life: Positive = 25_000
    layers: Count = 2
    fresh: bool = False
    updates_per_step: Positive = 0.25
    buffer_size: Count = 400_000
    ahead: NonNegative = AHEAD
    guided_share: Share = 0.2
    mean_share: Share = 0.5
    sunken_starts: Share = 0.3
    least_std: Positive = 0.3
    train_episode_steps: Natural = 300


class GuidedRun(Run):
    """A run of guided imitation. The student starts from the guide's weights, or from none of them."""

    @functools.cached_property
    def guide(self) -> Policy:
        """The policy that is shown the way."""
        if self.task.family != ANT_MAZE:
            raise DmcvbError(f"--algo guided is for ant mazes, there is no way to a goal in {self.task.id}")
        source = self.config.init_from
        path = resolve_policies(self.task.id if source else GUIDE, "expert", source)[0]
        policy = load_policy(path, self.task)
        header = policy.header
        if (header.distribution, header.activation, header.layer_norm) != ("squashed_gaussian", "relu", False):
            raise DmcvbError(
                f"the guide {path} must be a squashed Gaussian on plain ReLU layers, as policies of sac are"
            )
        return policy

    def network(self) -> dict[str, Any]:
        header = self.guide.header
        more = max(0, self.settings.layers - len(header.hidden))
        return {
            "hidden": (*header.hidden, *[header.hidden[-1]] * more),
            "activation": header.activation,
            "clip_observation": header.clip_observation,
        }

    def describe(self) -> dict[str, Any]:
        return {"guide": self.guide.digest}

    def warmup(self) -> int:
        return 0

    def _train(self, saved: dict[str, Any] | None, report: Report, tick: Tick) -> None:
        settings, config = self.settings, self.config
        learner, next_evaluation = Imitation(self), config.evaluate_every
        if saved:
            learner.load_state(saved["learner"])
            next_evaluation = saved["next_evaluation"]
        episodes = Episodes(self, learner.rng)
        if saved:
            observation = episodes.restore(saved["episodes"])
        else:
            observation = episodes.start(np.arange(settings.simulations))
            learner.choose_walkers(np.arange(settings.simulations))
        last_saved = self._started

        def save() -> None:
            parts = {"learner": learner.state(), "episodes": episodes.saved(observation)}
            self.save(parts | {"next_evaluation": next_evaluation})

        while self.step < config.steps:
            action = learner.act(observation, episodes.batch.guided_observation(settings.ahead))
            result = episodes.batch.step(action)
            self.step += settings.simulations
            observation = episodes.restart_ended(episodes.batch.behaviour_observation(), result.terminated)
            learner.choose_walkers(np.flatnonzero(episodes.elapsed == 0))
            learner.learn(self.step)
            tick(settings.simulations)
            if self.step >= min(next_evaluation, config.steps):
                metrics = {"divergence": learner.loss}
                progress = self.record(learner.student.state_dict(), learner.updates, metrics, report)
                next_evaluation = self.next_evaluation(progress.evaluation, next_evaluation)
                if self._started - last_saved > SAVE_SECONDS:
                    save()
                    last_saved = self._started
        save()


class Imitation:
    """A student beside its guide: it acts, notes what the guide would have done, and learns that.

    Attributes:
      updates: gradient updates so far.
      loss: the last one's divergence, nats an action.
    """

    def __init__(self, run: GuidedRun):
        self.run, self.settings = run, run.settings
        task, config, settings = run.task, run.config, run.settings
        torch.manual_seed(config.seed)
        self.student = Actor(run.header)
        begin = deepened(as_tensors(run.guide.weights), self.student.state_dict())
        if settings.fresh:
            begin = self.student.state_dict() | {name: begin[name] for name in ("observation_mean", "observation_std")}
        self.student.load_state_dict(begin)
        self.guide = Actor(run.guide.header).requires_grad_(False)
        self.guide.load_state_dict(as_tensors(run.guide.weights))
        self.optimizer = torch.optim.Adam(self.student.parameters(), lr=settings.learning_rate, fused=True)
        shapes = {"observation": (task.behaviour_size,), "mean": (task.action_size,), "std": (task.action_size,)}
        rows = max(min(settings.buffer_size, config.steps), settings.simulations)
        self.buffer = RowBuffer(rows, shapes, run.folder / "resume")
        self.rng = np.random.default_rng([config.seed, 0xB0FF])
        self.guided = np.zeros(settings.simulations, bool)
        self.owed, self.updates, self.loss = 0.0, 0, 0.0

    def choose_walkers(self, ids: np.ndarray) -> None:
        """Draw who walks in the new episodes of the simulations `ids`, the guide or the student."""
        self.guided[ids] = self.rng.random(len(ids)) < self.settings.guided_share

    def act(self, observation: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Actions of whoever walks, (n, action) float32; what the guide would have done is noted.

        Args:
          observation: (n, observation), what the student sees.
          shown: (n, observation), what the guide is shown.
        """
        with torch.no_grad():
            own_mean, own_std = self.student(torch.from_numpy(observation))
            mean, std = self.guide(torch.from_numpy(shown))
            walks = torch.from_numpy(self.guided)[:, None]
            noise = torch.randn_like(mean)
            noise[: round(self.settings.mean_share * len(noise))] = 0
            action = torch.tanh(torch.where(walks, mean, own_mean) + torch.where(walks, std, own_std) * noise)
        self.buffer.add(observation=observation, mean=mean.numpy(), std=std.numpy())
        return action.numpy()

    def learn(self, step: int) -> None:
        """The updates that a step of all simulations is worth."""
        settings = self.settings
        if len(self.buffer) < settings.batch_size:
            return
        self.optimizer.param_groups[0]["lr"] = settings.learning_rate * 0.5 ** (step / settings.half_life)
        self.owed += settings.updates_per_step * settings.simulations
        while self.owed >= 1:
            self.loss = self.update(self.buffer.sample(self.rng, settings.batch_size))
            self.owed -= 1
            self.updates += 1

    def update(self, batch: dict[str, torch.Tensor]) -> float:
        """One gradient step; gives the divergence before it."""
        std = batch["std"].clamp(min=self.settings.least_std)
        loss = divergence(batch["mean"], std, *self.student(batch["observation"]))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        self.buffer.flush()
        return {
            "guide": self.run.guide.digest,
            "student": self.student.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "torch_rng": torch.get_rng_state(),
            "rng": json.dumps(self.rng.bit_generator.state),
            "buffer": {"position": self.buffer.position, "full": self.buffer.full, "rows": self.buffer.size},
            "guided": torch.from_numpy(self.guided.copy()),
            "owed": self.owed,
            "updates": self.updates,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`.

        Raises:
          DmcvbError: it learned from another guide.
        """
        if state["guide"] != self.run.guide.digest:
            raise DmcvbError(
                f"{self.run.folder} learned from another guide than the one that is here now; choose another --out"
            )
        self.student.load_state_dict(state["student"])
        self.optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["torch_rng"])
        self.rng.bit_generator.state = json.loads(state["rng"])
        self.buffer.restore(**state["buffer"])
        self.guided = state["guided"].numpy().copy()
        self.owed, self.updates = state["owed"], state["updates"]


def deepened(weights: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights of a deeper actor that acts as the given one does: layers it lacks are identities.

    After a ReLU an identity with another ReLU changes nothing (Net2Net, Chen et al. 2016).
    """
    grown = {}
    for name, value in wanted.items():
        if name in weights:
            grown[name] = weights[name].clone()
        else:
            grown[name] = torch.zeros_like(value) if name.endswith("bias") else torch.eye(len(value))
    return grown


def divergence(mean: torch.Tensor, std: torch.Tensor, own_mean: torch.Tensor, own_std: torch.Tensor) -> torch.Tensor:
    """Mean Kullback-Leibler divergence of the student's Gaussian from the guide's, nats an action, (1).

    Of the Gaussians before squashing; means count as within +-3, where tanh leaves nothing to tell.
    """
    limit = 3.0
    # Beyond the limit there is no gradient outwards, so a student may be further out, where the guide is out too.
    apart = torch.where(mean.abs() < limit, own_mean - mean, own_mean.clamp(-limit, limit) - mean.clamp(-limit, limit))
    log_ratio = own_std.log() - std.log()
    return (log_ratio + (std**2 + apart**2) / (2 * own_std**2) - 0.5).sum(dim=1).mean()
