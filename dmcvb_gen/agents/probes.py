"""Inspection: decoders that tell what a frozen encoder still knows of observations and states (paper, section 5.1)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import Batch, Learner, adam
from dmcvb_gen.agents.networks import PAPER, Architecture, ObservationDecoder, state_decoder


def _frozen_latent(encoder: nn.Module, batch: Batch) -> torch.Tensor:
    if batch.latent is not None:
        return batch.latent
    with torch.no_grad():
        return encoder(batch.observation)


class ObservationProbe(Learner):
    """|| psi(phi(o)) - o ||^2 over psi, phi frozen."""

    def __init__(self, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__()
        self.encoder = encoder.requires_grad_(False)
        self.decoder = ObservationDecoder(sizes.channels, sizes.picture, encoder.features, architecture)
        self.optimizers = {"main": adam([self.decoder])}

    def reconstruct(self, batch: Batch) -> torch.Tensor:
        """(batch, channels, size, size): the observations as the decoder sees them."""
        return self.decoder(_frozen_latent(self.encoder, batch))

    def losses(self, batch):
        return {"loss": F.mse_loss(self.reconstruct(batch).float(), batch.observation.float())}


class StateProbe(Learner):
    """|| s - h(phi(o)) ||^2 over an MLP h, phi frozen."""

    needs_pictures = False

    def __init__(self, encoder: nn.Module, sizes: Sizes):
        super().__init__()
        self.encoder, self.h = encoder.requires_grad_(False), state_decoder(sizes.state, encoder.features)
        self.optimizers = {"main": adam([self.h])}

    def predict(self, batch: Batch) -> torch.Tensor:
        """(batch, state): the normalized states as the decoder sees them."""
        return self.h(_frozen_latent(self.encoder, batch)).float()

    def losses(self, batch):
        return {"loss": F.mse_loss(self.predict(batch), batch.state)}
