"""AE: an encoder whose latents give the observation back (paper, section 4.2)."""

from __future__ import annotations

import torch.nn.functional as F

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import Learner, adam, register_agent
from dmcvb_gen.agents.networks import PAPER, Architecture, Encoder, ObservationDecoder


@register_agent("ae")
class Autoencoder(Learner):
    """AE: || psi(phi(o)) - o ||^2."""

    recordable = True

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder = encoder
        self.decoder = ObservationDecoder(sizes.channels, sizes.picture, encoder.features, architecture)
        self.optimizers = {"main": adam([self])}

    def losses(self, batch):
        return {"loss": F.mse_loss(self.decoder(self.encoder(batch.observation)).float(), batch.observation.float())}
