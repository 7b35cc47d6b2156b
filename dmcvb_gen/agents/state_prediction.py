"""State: an encoder whose latents give the state, which it needs at training time alone (paper, section 4.3)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import Learner, adam, register_agent
from dmcvb_gen.agents.networks import PAPER, Architecture, Encoder, initialize


@register_agent("state")
class StatePrediction(Learner):
    """State: || s - h(phi(o)) ||^2, h linear."""

    recordable = True

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder, self.h = encoder, initialize(nn.Linear(encoder.features, sizes.state))
        self.optimizers = {"main": adam([self])}

    def losses(self, batch):
        return {"loss": F.mse_loss(self.h(self.encoder(batch.observation)).float(), batch.state)}
