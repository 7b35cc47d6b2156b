"""A subset as one lazy xarray data set; damaged bytes and lost connections are one line with a cure."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray
from xarray.backends import BackendArray
from xarray.core import indexing

from dmcvb_gen.dataset.reader import StoredArray, Subset


class _Lazy(BackendArray):
    """The values of a lazy variable."""

    def __init__(self, array: StoredArray):
        self._array, self.shape, self.dtype = array, array.shape, array.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._array.outer)


def lazy_dataset(subset: Subset, episodes: np.ndarray) -> xarray.Dataset:
    """See `SubsetReader.xarray`."""
    variables = {}
    for name in subset.arrays:
        array = subset.array(name)
        held = indexing.MemoryCachedArray(indexing.LazilyIndexedArray(_Lazy(array)))
        named = xarray.Variable(array.dimensions, held, array.attributes, array.chunking)
        variables[name.replace("/", "_")] = named
    record, manifest = subset.record, subset.release.manifest
    attributes = {
        "release": f"{manifest.name} {manifest.version}",
        "task": record.task,
        "level": record.level,
        "setting": record.setting,
        "views": list(record.views),
        "action_repeat": record.action_repeat,
        "seconds_per_step": record.seconds_per_step,
    }
    data = xarray.Dataset(variables, attrs=attributes).isel(episode=episodes)
    return data.assign_coords(episode=episodes, step=np.arange(data.sizes["step"]))
