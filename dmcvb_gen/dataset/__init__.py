"""The store: releases of Zarr subsets, written shard by shard, never changed, readable with plain zarr."""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dmcvb_gen.dataset.gate import Release
    from dmcvb_gen.dataset.manifest import Manifest, SubsetRecord
    from dmcvb_gen.dataset.reader import Subset

# Known and meant: both are read by zarr-python and xarray, which is what the layout promises.
warnings.filterwarnings("ignore", message="Numcodecs codecs are not in the Zarr version 3 specification")
warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")

__all__ = ["Manifest", "Release", "Subset", "SubsetRecord"]
_MODULES = {"Release": "gate", "Subset": "reader"}


def __getattr__(name: str) -> Any:
    """Names of other modules, imported when they are used: manifests alone need no zarr."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES.get(name, 'manifest')}"), name)
