"""Networks of DMC-VB's agents: encoders, actors, critics and decoders.

Sizes are those of the paper's appendix "Architecture and hyperparameters". Frame stacks are
(batch, channel, 64, 64) float in [-0.5, 0.5], channels = 3 x frames x views (9 for locomotion, 27 for mazes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

LATENT = 64
"""Width of every encoder's output."""
HIDDEN = (256, 256)
"""Hidden layers of every MLP."""

ACTIVATIONS = {"gelu": nn.GELU, "relu": nn.ReLU}
"""Activations that may follow a convolution."""


@dataclass(frozen=True)
class Architecture:
    """The convolutions of an encoder; its decoder has the same ones in reverse.

    Attributes:
      channels: channels of each convolution's output. strides: stride of each convolution.
      activation: behind each convolution.
      patch: the first convolution cuts the picture into patches of its stride that do not overlap; it is 3x3 otherwise,
        as all others are.
      differences: the first convolution reads the newest frame and the differences of successive frames, instead of
        the frames.
      latent: width of the encoder's output.
    """

    channels: tuple[int, ...]
    strides: tuple[int, ...]
    activation: Literal["gelu", "relu"] = "gelu"
    patch: bool = False
    differences: bool = False
    latent: int = LATENT

    @property
    def kernels(self) -> tuple[tuple[int, int], ...]:
        """(size, padding) of each convolution."""
        first = (self.strides[0], 0) if self.patch else (3, 1)
        return (first, *[(3, 1)] * (len(self.strides) - 1))

    def sizes(self, size: int) -> tuple[int, ...]:
        """Pixels a side before the first convolution and after each: (64, 32, 16, 16, 16)."""
        found = [size]
        for stride, (kernel, padding) in zip(self.strides, self.kernels, strict=True):
            found.append((found[-1] + 2 * padding - kernel) // stride + 1)
        return tuple(found)


PAPER = Architecture((32, 64, 128, 256), (2, 2, 1, 1))
"""The paper's: 64 x 64 pictures become 16 x 16 x 256 = 65,536 features, and 0.2 GFLOP a stack of 9 channels."""

PATCHES = Architecture((64, 64, 64), (4, 2, 1), "relu", patch=True, differences=True, latent=256)
"""For short trainings on a CPU: 4x4 patches of the newest frame and of frame differences, 8 x 8 x 64 features."""


def initialize(module: nn.Module) -> nn.Module:
    """Orthogonal weights and zero biases in every linear and convolutional layer."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            nn.init.orthogonal_(layer.weight)
            nn.init.zeros_(layer.bias)
    return module


class Trunk(nn.Sequential):
    """(batch, features) -> (batch, latent) in (-1, 1): linear, LayerNorm, tanh."""

    def __init__(self, features: int, latent: int = LATENT):
        super().__init__(nn.Linear(features, latent), nn.LayerNorm(latent), nn.Tanh())
        initialize(self)


class _SameLayout(torch.autograd.Function):
    """Pass pictures through; lay out their gradient as they lie, with the channels last in memory.

    An activation's gradient costs five times as much where the two lie differently, as behind a flattening they do.
    """

    @staticmethod
    def forward(_, pictures: torch.Tensor) -> torch.Tensor:
        return pictures.view_as(pictures)

    @staticmethod
    def backward(_, gradient: torch.Tensor) -> torch.Tensor:
        return gradient.contiguous(memory_format=torch.channels_last)


class _Flatten(nn.Module):
    """(batch, channel, size, size) -> (batch, features), by channel."""

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return _SameLayout.apply(pictures).flatten(1)


class FrameDifferences(nn.Conv2d):
    """A convolution of the newest frame and of the differences of successive frames.

    The differences are a linear map of the frames, so it is applied to the weights, which are few, and not to the
    pictures.

    Args:
      channels: channels of the stack, oldest frame first. frames: frames of the stack.
    """

    def __init__(self, channels: int, out: int, kernel: int, stride: int, padding: int, frames: int):
        super().__init__(channels, out, kernel, stride, padding)
        self.frames = frames
        newest = torch.eye(frames).flip(0)  # (frame, frame), the newest one first
        of_frames = torch.cat([newest[:1], newest[:-1] - newest[1:]])  # (input, frame): the others are differences
        self.register_buffer("of_frames", of_frames, persistent=False)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        weight = self.weight.unflatten(1, (self.frames, -1))
        weight = torch.einsum("oichw,if->ofchw", weight, self.of_frames).flatten(1, 2)
        return nn.functional.conv2d(pictures, weight, self.bias, self.stride, self.padding)


class Convolutions(nn.Sequential):
    """(batch, channel, size, size) -> (batch, features): convolutions, an activation behind each, flattened.

    Weights lie in memory with the channels last, which makes the kernels a fifth faster on a CPU.

    Args:
      frames: frames of the stack that the channels hold; only an architecture with `differences` asks.
    """

    def __init__(self, channels: int, size: int = 64, architecture: Architecture = PAPER, frames: int = 3):
        layers: list[nn.Module] = []
        width = channels
        for out, stride, (kernel, padding) in zip(
            architecture.channels, architecture.strides, architecture.kernels, strict=True
        ):
            if architecture.differences and not layers:
                layers.append(FrameDifferences(width, out, kernel, stride, padding, frames))
            else:
                layers.append(nn.Conv2d(width, out, kernel, stride, padding))
            layers.append(ACTIVATIONS[architecture.activation]())
            width = out
        super().__init__(*layers, _Flatten())
        self.features = width * architecture.sizes(size)[-1] ** 2
        initialize(self).to(memory_format=torch.channels_last)


class Encoder(nn.Module):
    """phi: an observation to a latent; `body` is shared by TD3-BC's actor and critic, `trunk` is not.

    Args:
      body: `Convolutions` for pictures, `nn.Identity` for states.
      trunk: from the body's output to the latent.
      features: width of the latent.
    """

    def __init__(self, body: nn.Module, trunk: nn.Module, features: int = LATENT):
        super().__init__()
        self.body, self.trunk, self.features = body, trunk, features

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.trunk(self.body(observation))


def observation_encoder(channels: int, size: int = 64, architecture: Architecture = PAPER, frames: int = 3) -> Encoder:
    """phi for frame stacks."""
    body = Convolutions(channels, size, architecture, frames)
    return Encoder(body, Trunk(body.features, architecture.latent), architecture.latent)


def state_encoder(state_size: int) -> Encoder:
    """phi for states: the trunk alone, neither convolutions nor frame stack."""
    return Encoder(nn.Identity(), Trunk(state_size))


class MLP(nn.Sequential):
    """(batch, inputs) -> (batch, outputs): hidden layers 256, 256 with ReLU; tanh at the end if asked for."""

    def __init__(self, inputs: int, outputs: int, tanh: bool = False):
        first, second = HIDDEN
        hidden = nn.Linear(inputs, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU()
        super().__init__(*hidden, nn.Linear(second, outputs), *([nn.Tanh()] if tanh else []))
        initialize(self)


class ObservationDecoder(nn.Module):
    """psi: (batch, 64) -> (batch, channel, size, size), the encoder in reverse; no activation at the end."""

    def __init__(self, channels: int, size: int = 64, features: int = LATENT, architecture: Architecture = PAPER):
        super().__init__()
        sizes, width = architecture.sizes(size)[::-1], architecture.channels[-1]
        self.shape = (width, sizes[0], sizes[0])
        self.linear = nn.Linear(features, width * sizes[0] ** 2)
        layers: list[nn.Module] = []
        wanted = (*architecture.channels[-2::-1], channels)
        reverse = zip(wanted, architecture.strides[::-1], architecture.kernels[::-1], strict=True)
        for index, (out, stride, (kernel, padding)) in enumerate(reverse):
            # Without output padding n pixels become stride (n - 1) + kernel - 2 padding: what an odd size needs.
            missing = sizes[index + 1] - (stride * (sizes[index] - 1) + kernel - 2 * padding)
            layers += [
                nn.ConvTranspose2d(width, out, kernel, stride, padding, output_padding=missing),
                ACTIVATIONS[architecture.activation](),
            ]
            width = out
        self.deconvolutions = nn.Sequential(*layers[:-1])
        initialize(self).to(memory_format=torch.channels_last)  # as the pictures lie that it is compared with

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        return self.deconvolutions(self.linear(latent).unflatten(1, self.shape))
