"""Base of all agents: the batch that they learn from, the base classes of their parts, and the registry of parts.

An agent is a policy, on its own encoder or on one that was pre-trained. `paper.py`, `td3_bc.py` and `dino.py` hold the
parts, which read like their equations: o is an observation (frame stack or state), already normalized and augmented; a
the action taken there. Squared errors are means over batch and dimensions. `register_agent` makes a part known by name.
"""

from __future__ import annotations

import abc
import copy
import functools
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import nn

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.registry import Registry

EMA_DECAY = 0.99
"""Decay of LFD's target encoder and TD3-BC's target networks."""


@dataclass(frozen=True)
class Batch:
    """Transitions; tensors with leading axis (batch,).

    Attributes:
      observation, next_observation: what the agent sees at t and t + k; None if it is not asked for.
      later_observation: at t + k, if next_observation is that of t + 1 (`TrainingData.batch`, later); None elsewhere.
      state: (batch, state) normalized state at t.
      action: (batch, action) in [-1, 1].
      reward, discount: (batch,) of the action at t; discount 0 if the task ended the episode.
      k: (batch,) long, how many steps lie between the two observations.
      latent, next_latent: (batch, latent) of a frozen encoder, of data that are encoded once; None elsewhere.
      labeled: transitions whose actions may be learned from (`Learner.needs_labels`); None elsewhere.
    """

    observation: torch.Tensor | None
    state: torch.Tensor
    action: torch.Tensor
    reward: torch.Tensor
    discount: torch.Tensor
    next_observation: torch.Tensor | None = None
    later_observation: torch.Tensor | None = None
    k: torch.Tensor | None = None
    latent: torch.Tensor | None = None
    next_latent: torch.Tensor | None = None
    labeled: Batch | None = None

    def seen_by(self, encoder: nn.Module) -> torch.Tensor:
        """phi(o): the latents that were computed once, if the batch has them, else what `encoder` makes of o."""
        return encoder(self.observation) if self.latent is None else self.latent


def adam(modules: Iterable[nn.Module]) -> torch.optim.Adam:
    """Adam over all trainable parameters of the modules (one fused kernel: the trunk alone has 4 million)."""
    parameters = [p for module in modules for p in module.parameters() if p.requires_grad]
    return torch.optim.Adam(parameters, fused=True)  # at its usual rate, the paper's 1e-3


@torch.no_grad()
def move_towards(target: nn.Module, source: nn.Module, decay: float = EMA_DECAY) -> None:
    """target <- decay x target + (1 - decay) x source, parameter by parameter."""
    for old, new in zip(target.parameters(), source.parameters(), strict=True):
        old.lerp_(new, 1 - decay)


def frozen_copy(module: nn.Module) -> nn.Module:
    """A copy that no gradient reaches."""
    return copy.deepcopy(module).requires_grad_(False)


class Learner(nn.Module, abc.ABC):
    """Base: one loss, one Adam called "main".

    `update` makes one step and gives its losses; `metrics` gives the losses without learning (hold-out). A learner that
    is registered is made as `cls(encoder, sizes, architecture, **options)`, a policy with `frozen=` besides.

    Attributes:
      optimizers: by name; each holds the parameters that its loss moves and no others. By default one Adam, "main", of
        all that can be trained, made when it is first asked for.
      half: compute losses in bfloat16 if autocast finds it safe; weights and optimizers stay float32.
      encoder: phi, if there is one.
    """

    draws: Mapping[str, Any] = {}
    """How its batches are drawn: next_observation, k, sample_k, later and pictures of `TrainingData.batch`."""
    shifts = True
    """Whether it learns from pictures that are shifted at random, where the budget shifts them."""
    needs_labels = False
    """Whether batches need `labeled`: it pre-trains an encoder with the actions of the policy's episodes alone."""
    compiled = ("losses",)
    """The methods that torch.compile is worth trying on."""
    pretrains = True
    """Whether it may pre-train the encoder of another policy."""
    options: Mapping[str, int | bool] = {}
    """Its options in an agent's name and their defaults: True or False for a word, a number for word=1..64."""

    half = False

    @functools.cached_property
    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"main": adam([self])}

    @abc.abstractmethod
    def losses(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Named losses; the one called "loss" is minimized."""

    def precision(self) -> torch.autocast:
        """The context that losses and actions are computed in."""
        return torch.autocast(next(self.parameters()).device.type, torch.bfloat16, enabled=self.half)

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One gradient step; the losses before it."""
        with self.precision():
            losses = self.losses(batch)
        if "loss" not in losses:
            raise DmcvbError(f"{type(self).__name__}.losses gives {list(losses)}; call the one to minimize 'loss'")
        self._descend("main", losses["loss"])
        return {name: value.detach() for name, value in losses.items()}

    def _descend(self, name: str, loss: torch.Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    @torch.no_grad()
    def metrics(self, batch: Batch) -> dict[str, torch.Tensor]:
        """The losses on a batch, without learning from it."""
        with self.precision():
            return self.losses(batch)


class Policy(Learner):
    """A learner that acts."""

    pretrains = False
    only_learns: tuple[str, ...] = ()
    """Beginnings of the weights' names that learning alone needs."""

    @abc.abstractmethod
    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """(batch, action) in [-1, 1]."""

    def acts_by(self, weight: str) -> bool:
        """Return True if actions depend on the weight of that name."""
        return not weight.startswith(self.only_learns)


Part = TypeVar("Part", bound=type[nn.Module])
PARTS: Registry[Any] = Registry("agent", "dmcvb_gen.agents", "dmcvb_gen.agents")


def register_agent(name: str) -> Callable[[Part], Part]:
    """Class decorator that makes a part of agents known by name.

    A `Policy` gives the agents "NAME" and "state-NAME", and "PRETRAIN+NAME" with every encoder; another `Learner`
    pre-trains an encoder, as in "NAME+bc".

    Raises:
      ValueError: the name is no plain word, or begins as those of agents that see states do.
      DmcvbError: another class has that name already.
    """
    if not re.fullmatch(r"[a-z][a-z0-9-]*", name) or name.startswith("state-"):
        raise ValueError(
            f"agent {name!r}: give a word of small letters, digits and '-' that does not start with state-"
        )

    def register(part: Part) -> Part:
        PARTS.add(name, part)
        return part

    return register
