"""BC: a policy that copies the actions of the data (paper, section 4.1)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import Policy, adam, register_agent
from dmcvb_gen.agents.networks import MLP, PAPER, Architecture


@register_agent("bc")
class BehaviorCloning(Policy):
    """BC: || pi(phi(o)) - a ||^2 (equation 3), end to end, or with phi frozen after pre-training."""

    needs_pictures = False
    pretrains = True
    recordable = True

    def __init__(self, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER, frozen: bool = False):
        super().__init__()
        self.encoder, self.frozen = encoder.requires_grad_(not frozen), frozen
        self.policy = MLP(encoder.features, sizes.action, tanh=True)
        self.optimizers = {"main": adam([self])}

    def _encode(self, observation: torch.Tensor) -> torch.Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            return self.encoder(observation)

    def act(self, observation):
        return self.policy(self._encode(observation))

    def losses(self, batch):
        latent = self._encode(batch.observation) if batch.latent is None else batch.latent
        return {"loss": F.mse_loss(self.policy(latent).float(), batch.action)}
