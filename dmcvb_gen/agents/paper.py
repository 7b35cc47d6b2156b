"""The paper's agents beside its sections 4.1 to 4.3 and 5.1: a `Batch` enters `losses`, named losses leave.

o is an observation (batch, channel, size, size), a (batch, action), s (batch, state); phi(o) is (batch, latent).
Every squared error is a mean over batch and dimensions. TD3-BC has a file of its own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import EMA_DECAY, Batch, Learner, Policy, frozen_copy, move_towards, register_agent
from dmcvb_gen.agents.networks import LATENT, MLP, PAPER, Architecture, Encoder, ObservationDecoder, initialize


@register_agent("bc")
class BehaviorCloning(Policy):
    """BC: || pi(phi(o)) - a ||^2 (equation 3), end to end, or with phi frozen after pre-training."""

    draws = {"pictures": False}
    pretrains = True

    def __init__(self, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER, frozen: bool = False):
        super().__init__()
        self.encoder = encoder.requires_grad_(not frozen)
        self.policy = MLP(encoder.features, sizes.action, tanh=True)

    def act(self, observation):
        return self.policy(self.encoder(observation))

    def losses(self, batch):
        phi_o = batch.seen_by(self.encoder)  # (batch, latent)
        return {"loss": F.mse_loss(self.policy(phi_o).float(), batch.action)}


@register_agent("id")
class InverseDynamics(Learner):
    """ID: || a_t - f(phi(o_t), phi(o_t+k), k) ||^2 (equation 4).

    Args:
      k: observations lie up to this many steps apart.
      sample: k is drawn from 1..k and its 64-d linear embedding given to f; else it is the same always.
    """

    options = {"k": 1, "sample": False}

    def __init__(
        self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER, k: int = 1, sample: bool = False
    ):
        super().__init__()
        self.encoder, self.draws = encoder, {"next_observation": True, "k": k, "sample_k": sample}
        self.embed_k = initialize(nn.Linear(1, LATENT)) if sample else None
        self.f = MLP(2 * encoder.features + sample * LATENT, sizes.action, tanh=True)

    def losses(self, batch):
        both = self.encoder(torch.cat([batch.observation, batch.next_observation]))  # (2 batch, latent)
        inputs = list(both.chunk(2))  # phi(o_t), phi(o_t+k)
        if self.embed_k is not None:
            inputs.append(self.embed_k(batch.k.to(both.dtype)[:, None]))  # (batch, 64)
        return {"loss": F.mse_loss(self.f(torch.cat(inputs, dim=1)).float(), batch.action)}


@register_agent("lfd")
class LatentForwardDynamics(Learner):
    """LFD: || phi_EMA(o_t+1) - g(phi(o_t), e(a_t)) ||^2, phi_EMA an average of phi over time (equation 5)."""

    draws = {"next_observation": True}

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder, self.decay = encoder, EMA_DECAY
        self.target_encoder = frozen_copy(encoder)
        self.embed_action = MLP(sizes.action, LATENT, tanh=True)
        self.g = MLP(encoder.features + LATENT, encoder.features, tanh=True)

    def losses(self, batch):
        with torch.no_grad():
            phi_ema = self.target_encoder(batch.next_observation)  # (batch, latent)
        predicted = self.g(torch.cat([self.encoder(batch.observation), self.embed_action(batch.action)], dim=1))
        return {"loss": F.mse_loss(predicted.float(), phi_ema.float())}

    def update(self, batch):
        losses = super().update(batch)
        move_towards(self.target_encoder, self.encoder, self.decay)
        return losses


@register_agent("ae")
class Autoencoder(Learner):
    """AE: || psi(phi(o)) - o ||^2."""

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder = encoder
        self.psi = ObservationDecoder(sizes.channels, sizes.picture, encoder.features, architecture)

    def predict(self, batch: Batch) -> torch.Tensor:
        """(batch, channels, size, size): the observations as the decoder sees them."""
        return self.psi(batch.seen_by(self.encoder))

    def losses(self, batch):
        return {"loss": F.mse_loss(self.predict(batch).float(), batch.observation.float())}


@register_agent("state")
class StatePrediction(Learner):
    """State: || s - h(phi(o)) ||^2, h linear; it needs states at training time alone (section 4.3)."""

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder, self.h = encoder, initialize(nn.Linear(encoder.features, sizes.state))

    def losses(self, batch):
        return {"loss": F.mse_loss(self.h(self.encoder(batch.observation)).float(), batch.state)}


# -- what a frozen encoder still knows (section 5.1), beside an autoencoder on it -----------------------------


class StateProbe(Learner):
    """|| s - h(phi(o)) ||^2 over an MLP h, phi frozen."""

    draws = {"pictures": False}

    def __init__(self, encoder: nn.Module, sizes: Sizes):
        super().__init__()
        self.encoder, self.h = encoder.requires_grad_(False), MLP(encoder.features, sizes.state)

    def losses(self, batch):
        return {"loss": F.mse_loss(self.h(batch.seen_by(self.encoder)).float(), batch.state)}
