"""What the agents learn: a batch in, one gradient step (or a loss) out; each class reads like its equation.

A learner owns its networks and optimizers. `update(batch)` makes one step and gives its losses; `metrics(batch)`
gives the losses without learning (hold-out). Policies also `act`. o is an observation (frame stack or state),
already normalized and augmented; a the action taken there. Squared errors are means over batch and dimensions.
"""

from __future__ import annotations

import abc
import copy
from collections.abc import Iterable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.networks import (
    LATENT,
    MLP,
    PAPER,
    Architecture,
    Encoder,
    ObservationDecoder,
    Trunk,
    initialize,
    state_decoder,
)

EMA_DECAY = 0.99
"""Of LFD's target encoder and TD3-BC's target networks."""
LEARNING_RATE = 1e-3


@dataclass(frozen=True)
class Batch:
    """Transitions; tensors with leading axis (batch,).

    Attributes:
      observation, next_observation: what the agent sees at t and t + k; None if nobody asks for it.
      state: (batch, state) normalized state at t.
      action: (batch, action) in [-1, 1].
      reward, discount: (batch,) of the action at t; discount 0 where the task ended the episode.
      k: (batch,) long, how many steps lie between the two observations.
      latent, next_latent: (batch, latent) of a frozen encoder, of data that are encoded once; None elsewhere.
    """

    observation: torch.Tensor | None
    state: torch.Tensor
    action: torch.Tensor
    reward: torch.Tensor
    discount: torch.Tensor
    next_observation: torch.Tensor | None = None
    k: torch.Tensor | None = None
    latent: torch.Tensor | None = None
    next_latent: torch.Tensor | None = None


def adam(modules: Iterable[nn.Module], lr: float = LEARNING_RATE) -> torch.optim.Adam:
    """Adam over all trainable parameters of the modules (one fused kernel: the trunk alone has 4 million)."""
    parameters = [p for module in modules for p in module.parameters() if p.requires_grad]
    return torch.optim.Adam(parameters, lr=lr, fused=True)


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

    Attributes:
      optimizers: by name; each holds the parameters that its loss moves and no others.
      half: compute losses in bfloat16 where autocast finds it safe; weights and optimizers stay float32.
      encoder: phi, where there is one.
    """

    needs_next = False
    """Whether batches need `next_observation`."""
    needs_pictures = True
    """Whether batches need observations even if they hold the latents of a frozen encoder."""
    k_max, sample_k = 1, False
    """How far off the next observation is."""
    compiled = ("losses",)
    """The methods that torch.compile is worth trying on."""

    def __init__(self):
        super().__init__()
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self.half = False

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

    only_learns: tuple[str, ...] = ()
    """Beginnings of the weights' names that learning alone needs."""

    @abc.abstractmethod
    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """(batch, action) in [-1, 1]."""

    def acts_by(self, weight: str) -> bool:
        """Whether actions depend on the weight of that name."""
        return not weight.startswith(self.only_learns)


# -- representation learning (paper, section 4.2) -------------------------------------------------


class InverseDynamics(Learner):
    """ID: || a_t - f(phi(o_t), phi(o_t+k), k) ||^2 (equation 4).

    Args:
      k_max: observations lie up to this many steps apart.
      sample_k: k is drawn from 1..k_max and its 64-d linear embedding given to f; else k = k_max always.
    """

    needs_next = True

    def __init__(self, encoder: Encoder, action_size: int, k_max: int = 1, sample_k: bool = False, lr=LEARNING_RATE):
        super().__init__()
        self.encoder, self.k_max, self.sample_k = encoder, k_max, sample_k
        self.embed_k = initialize(nn.Linear(1, LATENT)) if sample_k else None
        self.f = MLP(2 * encoder.features + sample_k * LATENT, action_size, tanh=True)
        self.optimizers = {"main": adam([self], lr)}

    def losses(self, batch):
        both = self.encoder(torch.cat([batch.observation, batch.next_observation]))
        inputs = list(both.chunk(2))
        if self.embed_k is not None:
            inputs.append(self.embed_k(batch.k.to(both.dtype)[:, None]))
        return {"loss": F.mse_loss(self.f(torch.cat(inputs, dim=1)).float(), batch.action)}


class LatentForwardDynamics(Learner):
    """LFD: || phi_EMA(o_t+1) - g(phi(o_t), e(a_t)) ||^2, phi_EMA an average of phi over time (equation 5)."""

    needs_next = True

    def __init__(self, encoder: Encoder, action_size: int, decay: float = EMA_DECAY, lr=LEARNING_RATE):
        super().__init__()
        self.encoder, self.decay = encoder, decay
        self.target_encoder = frozen_copy(encoder)
        self.embed_action = MLP(action_size, LATENT, tanh=True)
        self.g = MLP(encoder.features + LATENT, encoder.features, tanh=True)
        self.optimizers = {"main": adam([self], lr)}

    def losses(self, batch):
        with torch.no_grad():
            target = self.target_encoder(batch.next_observation)
        predicted = self.g(torch.cat([self.encoder(batch.observation), self.embed_action(batch.action)], dim=1))
        return {"loss": F.mse_loss(predicted.float(), target.float())}

    def update(self, batch):
        losses = super().update(batch)
        move_towards(self.target_encoder, self.encoder, self.decay)
        return losses


class Autoencoder(Learner):
    """AE: || psi(phi(o)) - o ||^2."""

    def __init__(
        self,
        encoder: Encoder,
        channels: int,
        size: int = 64,
        architecture: Architecture = PAPER,
        lr=LEARNING_RATE,
    ):
        super().__init__()
        self.encoder, self.decoder = encoder, ObservationDecoder(channels, size, encoder.features, architecture)
        self.optimizers = {"main": adam([self], lr)}

    def losses(self, batch):
        return {"loss": F.mse_loss(self.decoder(self.encoder(batch.observation)).float(), batch.observation.float())}


class StatePrediction(Learner):
    """State: || s - h(phi(o)) ||^2, h linear (section 4.3; needs states, at training time alone)."""

    def __init__(self, encoder: Encoder, state_size: int, lr=LEARNING_RATE):
        super().__init__()
        self.encoder, self.h = encoder, initialize(nn.Linear(encoder.features, state_size))
        self.optimizers = {"main": adam([self], lr)}

    def losses(self, batch):
        return {"loss": F.mse_loss(self.h(self.encoder(batch.observation)).float(), batch.state)}


# -- policies (section 4.1) -----------------------------------------------------------------------


class BehaviorCloning(Policy):
    """BC: || pi(phi(o)) - a ||^2 (equation 3), end to end, or with phi frozen after pre-training."""

    needs_pictures = False

    def __init__(self, encoder: nn.Module, action_size: int, frozen: bool = False, lr=LEARNING_RATE):
        super().__init__()
        self.encoder = encoder.requires_grad_(not frozen)
        self.frozen = frozen
        self.policy = MLP(encoder.features, action_size, tanh=True)
        self.optimizers = {"main": adam([self], lr)}

    def _encode(self, observation: torch.Tensor) -> torch.Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            return self.encoder(observation)

    def act(self, observation):
        return self.policy(self._encode(observation))

    def losses(self, batch):
        latent = self._encode(batch.observation) if batch.latent is None else batch.latent
        return {"loss": F.mse_loss(self.policy(latent).float(), batch.action)}


class _ActorCritic(nn.Module):
    """The networks of TD3-BC: a shared body, two trunks, an actor and two critics."""

    def __init__(self, body: nn.Module, features: int, action_size: int, trunks: int | None, bounded: bool):
        super().__init__()
        self.body = body
        self.actor_trunk = Trunk(features, trunks) if trunks else nn.Identity()
        self.critic_trunk = Trunk(features, trunks) if trunks else nn.Identity()
        self.latent = latent = trunks or features
        self.actor = MLP(latent, action_size, tanh=True)
        self.critic1, self.critic2 = (MLP(latent + action_size, 1, tanh=bounded) for _ in range(2))

    def act(self, body: torch.Tensor) -> torch.Tensor:
        return self.actor(self.actor_trunk(body)).float()

    def values(self, body: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Q1 and Q2, each (batch,)."""
        latent = self.critic_trunk(body)
        return self.value(self.critic1, latent, action), self.value(self.critic2, latent, action)

    @staticmethod
    def value(critic: nn.Module, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(batch,): a critic's, in float32 throughout. Half precision knows whole numbers alone where a return lies."""
        with torch.autocast(latent.device.type, enabled=False):
            return critic(torch.cat([latent.float(), action.float()], dim=1))[:, 0]


class ActorEncoder(nn.Module):
    """Body and actor's trunk of an actor-critic, as one encoder."""

    def __init__(self, net: _ActorCritic):
        super().__init__()
        self.body, self.trunk, self.features = net.body, net.actor_trunk, net.latent

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.trunk(self.body(observation))


class TD3BC(Policy):
    """TD3-BC (Fujimoto & Gu 2021; appendix "Agent details").

    Critics: y = r + discount gamma min(Q1', Q2')(o', clip(pi'(o') + clip(noise))); || Q - y ||^2 moves the critic
    heads alone. Actor, every second step: - lambda Q1(o, pi(o)) + || pi(o) - a ||^2 with lambda = alpha / mean |Q1|
    moves the actor, both trunks and the body. So alpha = 0 is BC. The critics end with tanh, as the paper's
    hyperparameter table says: values lie in (-1, 1), saturate on these rewards, and what is left is nearly BC.

    Args:
      body: `Convolutions` or `nn.Identity` (states), trained with trunks of their own; or a frozen encoder.
      features: what the body gives.
      frozen: the body is a pre-trained encoder that stays as it is; heads read its latent, without trunks.
      bounded: critics end with tanh; False leaves their values unbounded, as in TD3-BC's own paper.
      latent: width of the trunks.
    """

    needs_next = True
    needs_pictures = False
    compiled = ("critic_loss", "actor_loss")
    only_learns = ("target.", "net.critic", "updates")

    def __init__(
        self,
        body: nn.Module,
        features: int,
        action_size: int,
        frozen: bool = False,
        alpha: float = 2.5,
        gamma: float = 0.99,
        noise: float = 0.2,
        noise_clip: float = 0.5,
        actor_every: int = 2,
        decay: float = EMA_DECAY,
        lr=LEARNING_RATE,
        bounded: bool = True,
        latent: int = LATENT,
    ):
        super().__init__()
        trunks = None if frozen else latent
        self.net = _ActorCritic(body.requires_grad_(not frozen), features, action_size, trunks, bounded)
        self.target = frozen_copy(self.net)
        self.frozen = frozen
        if frozen:
            self.target.body = self.net.body  # it never moves, so one will do
        self.alpha, self.gamma, self.noise, self.noise_clip = alpha, gamma, noise, noise_clip
        self.actor_every, self.decay = actor_every, decay
        net = self.net
        self.optimizers = {
            "critic": adam([net.critic1, net.critic2], lr),
            "actor": adam([net.body, net.actor_trunk, net.critic_trunk, net.actor], lr),
        }
        self.register_buffer("updates", torch.zeros((), dtype=torch.long))

    def _body(self, observation):
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            return self.net.body(observation)

    def _seen(self, batch: Batch) -> torch.Tensor:
        return self._body(batch.observation) if batch.latent is None else batch.latent

    @property
    def encoder(self) -> nn.Module:
        """phi as the actor sees it: body and actor's trunk."""
        return ActorEncoder(self.net)

    def act(self, observation):
        return self.net.act(self._body(observation))

    @torch.no_grad()
    def target_value(self, batch: Batch, noise: torch.Tensor | None = None) -> torch.Tensor:
        """y: (batch,)."""
        body = self.target.body(batch.next_observation) if batch.next_latent is None else batch.next_latent
        if noise is None:
            noise = torch.randn_like(batch.action) * self.noise
        action = (self.target.act(body) + noise.clamp(-self.noise_clip, self.noise_clip)).clamp(-1, 1)
        return batch.reward + self.gamma * batch.discount * torch.minimum(*self.target.values(body, action))

    def critic_loss(self, batch: Batch) -> torch.Tensor:
        with torch.no_grad():
            latent = self.net.critic_trunk(self._seen(batch))
        y = self.target_value(batch)
        critics = (self.net.critic1, self.net.critic2)
        return sum(F.mse_loss(self.net.value(critic, latent, batch.action), y) for critic in critics)

    def actor_loss(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor's loss, and the cloning error in it."""
        body = self._seen(batch)
        action = self.net.act(body)
        value = self.net.values(body, action)[0]
        scale = self.alpha / value.abs().mean().detach().clamp(min=1e-6)
        cloning = F.mse_loss(action, batch.action)
        return -scale * value.mean() + cloning, cloning

    def losses(self, batch):
        actor, cloning = self.actor_loss(batch)
        return {"loss": cloning, "actor": actor, "critic": self.critic_loss(batch)}

    def update(self, batch):
        with self.precision():
            critic = self.critic_loss(batch)
        self._descend("critic", critic)
        out = {"critic": critic.detach()}
        self.updates += 1
        if self.updates % self.actor_every == 0:
            with self.precision():
                actor, cloning = self.actor_loss(batch)
            self._descend("actor", actor)  # gradients that land on the critics are dropped at their next step
            move_towards(self.target, self.net, self.decay)
            out |= {"loss": cloning.detach(), "actor": actor.detach()}
        return out


# -- inspection: what a frozen encoder still knows ------------------------------------------------


def _frozen_latent(encoder: nn.Module, batch: Batch) -> torch.Tensor:
    if batch.latent is not None:
        return batch.latent
    with torch.no_grad():
        return encoder(batch.observation)


class ObservationProbe(Learner):
    """|| psi(phi(o)) - o ||^2 over psi, phi frozen."""

    def __init__(
        self,
        encoder: nn.Module,
        channels: int,
        size: int = 64,
        architecture: Architecture = PAPER,
        lr=LEARNING_RATE,
    ):
        super().__init__()
        self.encoder = encoder.requires_grad_(False)
        self.decoder = ObservationDecoder(channels, size, encoder.features, architecture)
        self.optimizers = {"main": adam([self.decoder], lr)}

    def reconstruct(self, batch: Batch) -> torch.Tensor:
        """(batch, channels, size, size): the observations as the decoder sees them."""
        return self.decoder(_frozen_latent(self.encoder, batch))

    def losses(self, batch):
        return {"loss": F.mse_loss(self.reconstruct(batch).float(), batch.observation.float())}


class StateProbe(Learner):
    """|| s - h(phi(o)) ||^2 over an MLP h, phi frozen."""

    needs_pictures = False

    def __init__(self, encoder: nn.Module, state_size: int, lr=LEARNING_RATE):
        super().__init__()
        self.encoder, self.h = encoder.requires_grad_(False), state_decoder(state_size, encoder.features)
        self.optimizers = {"main": adam([self.h], lr)}

    def losses(self, batch):
        predicted = self.h(_frozen_latent(self.encoder, batch)).float()
        return {"loss": F.mse_loss(predicted, batch.state)}

    def field_errors(self, batch: Batch) -> torch.Tensor:
        """(batch, state): absolute errors of the normalized state."""
        return (self.h(_frozen_latent(self.encoder, batch)).float() - batch.state).abs()
