"""DINO's vision transformer: the user's own weights (safetensors) in, a frozen encoder of frame stacks out.

Nothing is downloaded. The architecture is read from the shapes of the weights (ViT-S or -B, patches of 8 or 16),
whose names are those of the DINO release (Caron et al. 2021) and of timm.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_file

INPUT = 224
"""Pixels a side that DINO was trained on; smaller pictures are padded (paper, section 4.2)."""
HEAD = 64
"""Width of an attention head in every DINO ViT."""
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MISSING = (
    "the agent 'dino' needs the weights of a DINO vision transformer, which dmcvb-gen never downloads: give "
    "--dino-weights PATH, a safetensors file (for example timm's vit_small_patch16_224.dino, model.safetensors)"
)


class _Block(nn.Module):
    def __init__(self, width: int, inner: int):
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.attn = nn.ModuleDict({"qkv": nn.Linear(width, 3 * width), "proj": nn.Linear(width, width)})
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(width, inner), "fc2": nn.Linear(inner, width)})

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        n, tokens, width = x.shape
        qkv = self.attn["qkv"](self.norm1(x)).reshape(n, tokens, 3, width // HEAD, HEAD).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(*qkv).transpose(1, 2).reshape(n, tokens, width)
        x = x + self.attn["proj"](mixed)
        return x + self.mlp["fc2"](F.gelu(self.mlp["fc1"](self.norm2(x))))


class VisionTransformer(nn.Module):
    """(batch, 3, 224, 224), normalized as ImageNet -> (batch, width): the normalized class token."""

    def __init__(self, width: int, depth: int, patch: int, inner: int):
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + (INPUT // patch) ** 2, width))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, patch, patch)})
        self.blocks = nn.ModuleList(_Block(width, inner) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=1e-6)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        patches = self.patch_embed["proj"](picture).flatten(2).transpose(1, 2)
        x = torch.cat([self.cls_token.expand(len(patches), -1, -1), patches], dim=1) + self.pos_embed
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 0]


class DinoEncoder(nn.Module):
    """(batch, 3 x pictures, size, size) in [-0.5, 0.5] -> (batch, width x pictures).

    Every picture of the stack is padded with grey to 224 x 224 and encoded by itself.
    """

    def __init__(self, vit: VisionTransformer, channels: int):
        super().__init__()
        self.vit, self.features = vit, vit.cls_token.shape[-1] * (channels // 3)
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(STD)[:, None, None], persistent=False)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        pictures = observation.reshape(-1, 3, *observation.shape[2:])
        short = INPUT - pictures.shape[-1]
        pictures = F.pad(pictures, (short // 2, short - short // 2) * 2)  # 0 is middle grey
        return self.vit((pictures + 0.5 - self.mean) / self.std).reshape(len(observation), -1)


def dino_digest(path: str | Path | None) -> str:
    """SHA-256 of the file of weights.

    Raises:
      DmcvbError: no file is given, or it cannot be read.
    """
    if path is None:
        raise DmcvbError(MISSING)
    try:
        return sha256_file(path)
    except OSError as error:
        raise DmcvbError(f"cannot read DINO weights {path} ({error}); give a safetensors file") from None


def load_dino(path: str | Path | None, channels: int, size: int = 64) -> DinoEncoder:
    """A DINO encoder from a local file.

    Args:
      channels, size: of the observations, 3 channels a picture, pixels a side.

    Raises:
      DmcvbError: no file is given, or it does not hold the weights of a DINO ViT, or pictures are too large for it.
    """
    if path is None:
        raise DmcvbError(MISSING)
    if size > INPUT:
        raise DmcvbError(f"DINO sees {INPUT} pixels a side at most, these pictures have {size}; repaint them smaller")
    try:
        weights = load_file(str(path))
    except (OSError, SafetensorError) as error:
        raise DmcvbError(f"cannot read DINO weights {path} ({error}); give a safetensors file") from None
    try:
        width, _, patch, _ = weights["patch_embed.proj.weight"].shape
        depth = 1 + max(int(name.split(".")[1]) for name in weights if name.startswith("blocks."))
        vit = VisionTransformer(width, depth, patch, weights["blocks.0.mlp.fc1.weight"].shape[0])
        vit.load_state_dict({name: value for name, value in weights.items() if not name.startswith("head")})
    except (KeyError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise DmcvbError(f"{path} does not hold the weights of a DINO vision transformer ({reason})") from None
    return DinoEncoder(vit.float().eval().requires_grad_(False), channels)
