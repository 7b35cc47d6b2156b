"""The store: releases of Zarr subsets, written shard by shard, readable with plain zarr."""

import warnings

# Known and meant: both are read by zarr-python and xarray, which is what the layout promises.
warnings.filterwarnings("ignore", message="Numcodecs codecs are not in the Zarr version 3 specification")
warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")

from dmcvb_gen.dataset.manifest import CommitRecord, Manifest, SubsetRecord  # noqa: E402
from dmcvb_gen.dataset.reader import Release, Subset, open_release  # noqa: E402

__all__ = ["CommitRecord", "Manifest", "Release", "Subset", "SubsetRecord", "open_release"]
