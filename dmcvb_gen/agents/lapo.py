"""LAPO: latent actions from images alone (Schmidt & Jiang 2024, "Learning to act without actions", section 4).

An inverse model says in a few codes what happened between two observations, and a forward model must make the next
image of the first one and of these codes (section 4.1). A latent policy predicts them from the first observation alone
(section 4.2); it is what is kept. "lapo+bc" decodes its latent actions into true ones (section 4.3) by all labeled
trajectories that it is given.

What differs from the paper, whose code is for Procgen: the networks are those of DMC-VB's agents; there is one codebook
in place of two; the forward model adds its image to the newest frame, in place of a U-Net's connections; all of it is
trained in one training, in place of one after the other.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import Batch, Learner, register_agent
from dmcvb_gen.agents.networks import MLP, PAPER, Architecture, Encoder, ObservationDecoder, observation_encoder

CODES, CODE_WIDTH = 64, 16
"""Codes of the codebook, and numbers of each; a latent action is a row of codes."""
COMMITMENT, KEEP = 0.05, 0.999
"""Weight of the loss that draws latent actions to their codes; decay of the codes' averages."""


class LatentActions(Learner):
    """Base: phi beside an inverse model f, which sees two observations through an encoder of its own."""

    draws = {"next_observation": True}

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture):
        super().__init__()
        self.encoder, width = encoder, encoder.features
        self.see = observation_encoder(sizes.channels, sizes.picture, architecture, sizes.stack)
        self.f = MLP(2 * width, width, tanh=True)

    def latent_action(self, batch: Batch) -> torch.Tensor:
        """z: (batch, latent) in (-1, 1), of one step."""
        both = self.see(torch.cat([batch.observation, batch.next_observation]))
        return self.f(torch.cat(both.chunk(2), dim=1)).float()


@register_agent("lapo")
class LatentActionPolicy(LatentActions):
    """|| o_t+1 - g(o_t, q(z)) ||^2 + || phi(o_t) - z ||^2, z = f(o_t, o_t+1), q the nearest codes; phi is kept.

    No gradient of the second term reaches f.
    """

    shifts = False

    def __init__(self, encoder: Encoder, sizes: Sizes, architecture: Architecture = PAPER):
        super().__init__(encoder, sizes, architecture)
        channels = sizes.channels // sizes.stack
        self.newest = slice(-channels, None)  # channels of the newest frame
        self.g = ObservationDecoder(channels, sizes.picture, 2 * encoder.features, architecture)
        codes = (2 * torch.rand(CODES, CODE_WIDTH) - 1) * 5 / CODES
        self.register_buffer("codes", codes)
        self.register_buffer("sums", codes.clone())  # of the latent actions nearest to each code, averaged over time
        self.register_buffer("counts", torch.ones(CODES))

    def quantize(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(batch, latent) as the nearest codes, whose gradient is z's, and the squared distance to them."""
        parts = z.unflatten(1, (-1, CODE_WIDTH))  # (batch, group, 16)
        nearest = torch.cdist(parts.detach(), self.codes).argmin(dim=2)  # (batch, group)
        codes = self.codes[nearest]
        if torch.is_grad_enabled():
            self._move_codes(parts.detach().flatten(0, 1), nearest.flatten())
        return (parts + (codes - parts).detach()).flatten(1), F.mse_loss(parts, codes)

    @torch.no_grad()
    def _move_codes(self, parts: torch.Tensor, nearest: torch.Tensor) -> None:
        """Each code becomes the average over time of the latent actions that it was nearest to."""
        chosen = F.one_hot(nearest, CODES).float()  # (part, code)
        self.counts.lerp_(chosen.sum(dim=0), 1 - KEEP)
        self.sums.lerp_(chosen.T @ parts, 1 - KEEP)
        self.codes.copy_(self.sums / self.counts[:, None].clamp(min=1e-5))

    def losses(self, batch):
        seen, after = self.see(torch.cat([batch.observation, batch.next_observation])).chunk(2)
        z = self.f(torch.cat([seen, after], dim=1)).float()
        with torch.autocast(z.device.type, enabled=False):
            codes, distance = self.quantize(z)
        frame = batch.observation[:, self.newest] + self.g(torch.cat([seen, codes], dim=1))
        model = F.mse_loss(frame.float(), batch.next_observation[:, self.newest].float())
        policy = F.mse_loss(self.encoder(batch.observation).float(), z.detach())
        return {"loss": model + COMMITMENT * distance + policy, "model": model, "policy": policy}
