"""Readers: releases for training (xarray, torch, numpy) and environments for evaluation (Gymnasium).

Everything is imported when first asked for: `import dmcvb_gen` passes here, and must stay quick.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "ReleaseReader": "release",
    "SubsetReader": "release",
    "UnionReader": "union",
    "PairedReader": "paired",
    "evaluate_invariance": "invariance",
    "open_for_reading": "release",
    "StepSource": "sampler",
    "EpisodeDataset": "torch_data",
    "StepDataset": "torch_data",
    "StreamDataset": "torch_data",
    "DistractedEnv": "envs",
    "DistractedVectorEnv": "envs",
    "matching_environment": "matching",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
