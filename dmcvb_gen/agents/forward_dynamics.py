"""LFD: an encoder that predicts its own average's latent of the next observation (paper, section 4.2)."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import EMA_DECAY, Learner, adam, frozen_copy, move_towards, register_agent
from dmcvb_gen.agents.networks import LATENT, MLP, PAPER, Architecture, Encoder


@register_agent("lfd")
class LatentForwardDynamics(Learner):
    """LFD: || phi_EMA(o_t+1) - g(phi(o_t), e(a_t)) ||^2, phi_EMA an average of phi over time (equation 5)."""

    needs_next = True
    recordable = True

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder, self.decay = encoder, EMA_DECAY
        self.target_encoder = frozen_copy(encoder)
        self.embed_action = MLP(sizes.action, LATENT, tanh=True)
        self.g = MLP(encoder.features + LATENT, encoder.features, tanh=True)
        self.optimizers = {"main": adam([self])}

    def losses(self, batch):
        with torch.no_grad():
            target = self.target_encoder(batch.next_observation)
        predicted = self.g(torch.cat([self.encoder(batch.observation), self.embed_action(batch.action)], dim=1))
        return {"loss": F.mse_loss(predicted.float(), target.float())}

    def update(self, batch):
        losses = super().update(batch)
        move_towards(self.target_encoder, self.encoder, self.decay)
        return losses
