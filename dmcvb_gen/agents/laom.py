"""LAOM: latent actions where distractors move, too (Nikulin et al. 2025, "Latent action learning requires supervision
in the presence of distractors", section 4; arXiv 2502.00379).

LAPO with four changes: the inverse model sees an observation several steps later; its latent action is not replaced by
codes; the forward model predicts what a slow average of the encoder sees, and no image; observations are augmented.
"laom+bc" decodes the latent actions by all labeled trajectories that it is given. In "laom-labels+bc", the paper's
supervised variant, the latent actions themselves learn from those labels, too.

What differs from the paper: the networks are those of DMC-VB's agents, so a latent action has 64 numbers (256 in
`quick`) instead of 8,192; the augmentation is DMC-VB's random shift, as far as the budget shifts, the same for all
observations of a transition; all of it is trained in one training, in place of one after the other.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.lapo import LatentActions
from dmcvb_gen.agents.learners import frozen_copy, move_towards, register_agent
from dmcvb_gen.agents.networks import MLP, PAPER, Architecture, Encoder, initialize


@register_agent("laom")
class LatentActionObservationModel(LatentActions):
    """|| e_EMA(o_t+1) - g(e(o_t), f(e(o_t), e(o_t+k))) ||^2 + || phi(o_t) - z ||^2, z = f(e(o_t), e(o_t+1)).

    phi is kept. k is drawn from 1..10. No gradient of the second term reaches f and e; of the first one, e learns by f.
    """

    draws = {"next_observation": True, "later": True, "k": 10, "sample_k": True}
    decay = 0.999

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__(encoder, sizes, architecture)
        self.target = frozen_copy(self.see)
        self.g = MLP(2 * encoder.features, encoder.features, tanh=True)

    def losses(self, batch):
        seen, later = self.see(torch.cat([batch.observation, batch.later_observation])).chunk(2)
        predicted = self.g(torch.cat([seen.detach(), self.f(torch.cat([seen, later], dim=1))], dim=1))
        with torch.no_grad():
            wanted, z = self.target(batch.next_observation), self.latent_action(batch)
        model = F.mse_loss(predicted.float(), wanted.float())
        policy = F.mse_loss(self.encoder(batch.observation).float(), z)
        return {"loss": model + policy, "model": model, "policy": policy}

    def update(self, batch):
        losses = super().update(batch)
        move_towards(self.target, self.see, self.decay)
        return losses


@register_agent("laom-labels")
class SupervisedLatentActionObservationModel(LatentActionObservationModel):
    """LAOM + 0.001 || a - h(z) ||^2 on labeled transitions, z = f(e(o_t), e(o_t+k)), h linear."""

    needs_labels = True
    weight = 0.001

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__(encoder, sizes, architecture)
        self.h = initialize(nn.Linear(encoder.features, sizes.action))

    def losses(self, batch):
        losses = super().losses(batch)
        if batch.labeled is None:  # of held-out episodes
            return losses
        z = self.latent_action(replace(batch.labeled, next_observation=batch.labeled.later_observation))
        labels = F.mse_loss(self.h(z).float(), batch.labeled.action)
        return losses | {"loss": losses["loss"] + self.weight * labels, "labels": labels}
