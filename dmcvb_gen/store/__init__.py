"""The store: releases of Zarr subsets, written shard by shard, readable with plain zarr."""

from dmcvb_gen.store.manifest import CommitRecord, Manifest, SubsetRecord
from dmcvb_gen.store.reader import Release, Subset, open_release

__all__ = ["CommitRecord", "Manifest", "Release", "Subset", "SubsetRecord", "open_release"]
