"""Privileged BC: estimate the state from the observation, and act by the estimate. Not in the paper.

The policy learns from the true states of the data, which only training needs, and never sees a latent. So nothing but
the state can decide its actions. In trainings of a few minutes it returned more than BC under static distractors; with
the profile `quick` it returns no more there, and far less on humanoid (docs/results.md).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.bc import BehaviorCloning
from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import adam, register_agent
from dmcvb_gen.agents.networks import MLP, PAPER, Architecture

NOISE = 0.1
"""Standard deviation of what is added to the normalized states that the policy learns from."""


@register_agent("privileged-bc")
class PrivilegedBC(BehaviorCloning):
    """Minimizes huber(h(phi(o)) - s) + || pi(s + noise) - a ||^2; acts by pi(h(phi(o)))."""

    pretrains = False
    recordable = True

    def __init__(self, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER, frozen: bool = False):
        super().__init__(encoder, sizes, architecture, frozen)
        self.estimator = MLP(encoder.features, sizes.state)
        self.policy = MLP(sizes.state, sizes.action, tanh=True)
        self.optimizers = {"main": adam([self])}

    def act(self, observation):
        return self.policy(self.estimator(self._encode(observation)))

    def losses(self, batch):
        latent = self._encode(batch.observation) if batch.latent is None else batch.latent
        estimate = F.huber_loss(self.estimator(latent).float(), batch.state)
        learning = torch.is_grad_enabled()  # held-out losses have no noise
        seen = batch.state + NOISE * torch.randn_like(batch.state) if learning else batch.state
        cloning = F.mse_loss(self.policy(seen).float(), batch.action)
        return {"loss": estimate + cloning, "estimate": estimate, "cloning": cloning}
