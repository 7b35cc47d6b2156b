"""A subset as one lazy xarray data set; damaged bytes and lost connections are one line with a cure."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray
from xarray.backends import BackendArray
from xarray.core import indexing

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.reader import StoredArray


class _Lazy(BackendArray):
    """The values of a lazy variable."""

    def __init__(self, array: StoredArray):
        self._array, self.shape, self.dtype = array, array.shape, array.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple) -> np.ndarray:
        return self._array.outer(key)


def lazy_dataset(subset: Subset, episodes: np.ndarray) -> xarray.Dataset:
    """See `SubsetReader.xarray`."""
    variables = {}
    for name in subset.arrays:
        array = subset.array(name)
        # In releases of version 1 a dimension had its array's name, which xarray takes for a coordinate.
        dimensions = [f"{name}_dim" if name in subset.arrays else name for name in array.dimensions]
        held = indexing.MemoryCachedArray(indexing.LazilyIndexedArray(_Lazy(array)))
        variables[name.replace("/", "_")] = xarray.Variable(dimensions, held, array.attributes, array.chunking)
    data = xarray.Dataset(variables, attrs=subset.attrs).isel(episode=episodes)
    return data.assign_coords(episode=episodes, step=np.arange(data.sizes["step"]))
