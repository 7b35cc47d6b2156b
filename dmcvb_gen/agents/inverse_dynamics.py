"""ID: an encoder that tells which action led from one observation to a later one (paper, section 4.2)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import Learner, adam, register_agent
from dmcvb_gen.agents.networks import LATENT, MLP, PAPER, Architecture, Encoder, initialize
from dmcvb_gen.errors import DmcvbError


@register_agent("id")
class InverseDynamics(Learner):
    """ID: || a_t - f(phi(o_t), phi(o_t+k), k) ||^2 (equation 4).

    Args:
      k: observations lie up to this many steps apart.
      sample: k is drawn from 1..k and its 64-d linear embedding given to f; else it is the same always.
    """

    needs_next = True
    recordable = True
    options = {"k": 1, "sample": False}

    def __init__(
        self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER, k: int = 1, sample: bool = False
    ):
        super().__init__()
        self.encoder, self.k_max, self.sample_k = encoder, k, sample
        self.embed_k = initialize(nn.Linear(1, LATENT)) if sample else None
        self.f = MLP(2 * encoder.features + sample * LATENT, sizes.action, tanh=True)
        self.optimizers = {"main": adam([self])}

    @classmethod
    def check_options(cls, k: int = 1, sample: bool = False) -> None:
        if sample and k == 1:
            raise DmcvbError("sample draws k from 1 to a largest one; give it, k=2 or more")

    def losses(self, batch):
        both = self.encoder(torch.cat([batch.observation, batch.next_observation]))
        inputs = list(both.chunk(2))
        if self.embed_k is not None:
            inputs.append(self.embed_k(batch.k.to(both.dtype)[:, None]))
        return {"loss": F.mse_loss(self.f(torch.cat(inputs, dim=1)).float(), batch.action)}
