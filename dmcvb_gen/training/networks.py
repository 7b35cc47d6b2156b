"""The actor as a torch module that learns, from a policy's header and back to its weights."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import nn

from dmcvb_gen.policies.header import LOG_STD_RANGE, WAY_SIZE, PolicyHeader
from dmcvb_gen.policies.open_maze import PLACE_SCALE

_ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "gelu": nn.GELU}


def hidden_layers(widths: Sequence[int], activation: type[nn.Module]) -> list[nn.Module]:
    """Linear layers from each width to the next one, an activation behind each."""
    return [layer for sizes in itertools.pairwise(widths) for layer in (nn.Linear(*sizes), activation())]


class Actor(nn.Module):
    """An MLP from normalized observations to the parameters of the action distribution.

    Weights: `body.<i>` hidden layers, `mean`, and `log_std` (a head of the body) or, for "gaussian", a free
    vector `log_std_vector`; buffers `observation_mean`, `observation_std` (observation,).
    """

    def __init__(self, header: PolicyHeader):
        super().__init__()
        self.header = header
        widths = (header.observation_size, *header.hidden)
        self.body = nn.Sequential(*hidden_layers(widths, _ACTIVATIONS[header.activation]))
        self.mean = nn.Linear(widths[-1], header.action_size)
        if header.distribution == "squashed_gaussian":
            self.log_std = nn.Linear(widths[-1], header.action_size)
        elif header.distribution == "gaussian":
            self.log_std_vector = nn.Parameter(torch.zeros(header.action_size))
        self.register_buffer("observation_mean", torch.zeros(header.observation_size))
        self.register_buffer("observation_std", torch.ones(header.observation_size))

    def normalize(self, observation: torch.Tensor) -> torch.Tensor:
        limit = self.header.clip_observation
        return ((observation - self.observation_mean) / self.observation_std).clamp(-limit, limit)

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(n, observation) -> mean and standard deviation before squashing, each (n, action)."""
        features = self.body(self.normalize(observation))
        mean = self.mean(features)
        if self.header.distribution == "squashed_gaussian":
            std = self.log_std(features).clamp(*LOG_STD_RANGE).exp()
        elif self.header.distribution == "gaussian":
            std = self.log_std_vector.exp().expand_as(mean)
        else:
            std = torch.full_like(mean, self.header.noise)
        return mean, std


class WaypointNetwork(nn.Sequential):
    """An MLP from places of ant and goal, (n, `WAY_SIZE`) meters, to where to head, (n, 2) meters seen from the ant."""

    def __init__(self, hidden: Sequence[int]):
        widths = (WAY_SIZE, *hidden)
        super().__init__(*hidden_layers(widths, nn.ReLU), nn.Linear(widths[-1], 2))

    def forward(self, places: torch.Tensor) -> torch.Tensor:
        return super().forward(places / float(PLACE_SCALE))

    def weights(self) -> dict[str, torch.Tensor]:
        """Its part of a policy file."""
        return {f"way.{name}": value for name, value in self.state_dict().items()}


def as_arrays(weights: Mapping[str, torch.Tensor]) -> dict[str, np.ndarray]:
    """A state dict as a policy file wants it: float32 arrays of their own."""
    return {name: value.detach().cpu().float().numpy().copy() for name, value in weights.items()}


def as_tensors(weights: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """A policy's weights as a state dict."""
    return {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
