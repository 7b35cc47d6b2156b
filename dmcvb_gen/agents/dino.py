"""DINO: a frozen encoder of frame stacks from the weights of a vision transformer that the user brings.

Nothing is downloaded. timm makes the network and reads its file; the sizes (ViT-S or -B, patches of 8 or 16) are those
of the weights' shapes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from torch import nn

from dmcvb_gen.agents.learners import register_agent
from dmcvb_gen.errors import DmcvbError, first_line
from dmcvb_gen.extras import install_hint
from dmcvb_gen.files import sha256_file

INPUT = 224
"""Pixels a side that DINO was trained on; smaller pictures are padded (paper, section 4.2)."""
HEAD = 64
"""Width of an attention head in every DINO ViT."""
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@register_agent("dino")
class DinoEncoder(nn.Module):
    """(batch, 3 x pictures, size, size) in [-0.5, 0.5] -> (batch, width x pictures).

    Every picture of the stack is padded with grey to 224 x 224 and encoded by itself, to its normalized class token.
    """

    options: Mapping[str, int | bool] = {}
    pretrains = True
    missing = (
        "the agent 'dino' needs the weights of a DINO vision transformer, which dmcvb-gen never downloads: give "
        "--dino-weights PATH, a safetensors file (for example timm's vit_small_patch16_224.dino, model.safetensors)"
    )

    def __init__(self, vit: nn.Module, channels: int):
        super().__init__()
        self.vit, self.features = vit, vit.cls_token.shape[-1] * (channels // 3)
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(STD)[:, None, None], persistent=False)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        pictures = observation.reshape(-1, 3, *observation.shape[2:])
        short = INPUT - pictures.shape[-1]
        pictures = F.pad(pictures, (short // 2, short - short // 2) * 2)  # 0 is middle grey
        return self.vit((pictures + 0.5 - self.mean) / self.std).reshape(len(observation), -1)

    @classmethod
    def digest(cls, weights: str | Path | None) -> str:
        """SHA-256 of the file of weights.

        Raises:
          DmcvbError: no file is given, or it cannot be read.
        """
        if weights is None:
            raise DmcvbError(cls.missing)
        try:
            return sha256_file(weights)
        except OSError as error:
            raise DmcvbError(f"cannot read weights {weights} ({error}); give a safetensors file") from None

    @classmethod
    def load(cls, weights: str | Path, channels: int, size: int = 64) -> DinoEncoder:
        """The encoder of observations with so many channels, of pictures with so many pixels a side.

        Raises:
          DmcvbError: the file does not hold such weights.
        """
        if size > INPUT:
            raise DmcvbError(f"DINO sees {INPUT} pixels a side at most, these images have {size}; repaint them smaller")
        if Path(weights).suffix != ".safetensors":  # timm unpickles files of other names
            raise DmcvbError(f"{weights} is no .safetensors file; give --dino-weights one")
        try:
            vit = _timm().create_model("vit_small_patch16_224", checkpoint_path=str(weights), **_sizes(weights))
        except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
            what = f"{weights} does not hold the weights of a DINO vision transformer ({first_line(error)})"
            raise DmcvbError(f"{what}; give --dino-weights another safetensors file") from None
        vit.reset_classifier(0)
        return cls(vit.float().eval().requires_grad_(False), channels)


def _sizes(weights: str | Path) -> dict[str, float]:
    """timm's arguments for a network of the shapes in a file."""
    with safe_open(str(weights), "pt") as file:
        shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118 (not a dict)
    width, _, patch, _ = shapes["patch_embed.proj.weight"]
    depth = 1 + max(int(name.split(".")[1]) for name in shapes if name.startswith("blocks."))
    ratio, classes = shapes["blocks.0.mlp.fc1.weight"][0] / width, shapes.get("head.weight", [0])[0]
    sizes = dict(patch_size=patch, embed_dim=width, depth=depth, num_heads=width // HEAD)
    return sizes | dict(mlp_ratio=ratio, num_classes=classes)


def _timm():
    try:
        import timm
    except ImportError:
        raise DmcvbError(f"the agent 'dino': {install_hint('timm')}") from None
    except RuntimeError as error:  # torchvision's kernels are of another build than torch
        raise DmcvbError(f"timm cannot start ({error}); install the torchvision that belongs to your torch") from None
    return timm
