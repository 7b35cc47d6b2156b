"""The store: releases of Zarr subsets, written shard by shard, never changed, readable with plain zarr."""

import warnings

# Known and meant: both are read by zarr-python and xarray, which is what the layout promises.
warnings.filterwarnings("ignore", message="Numcodecs codecs are not in the Zarr version 3 specification")
warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
