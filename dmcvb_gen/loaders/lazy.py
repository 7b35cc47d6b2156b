"""xarray's lazy arrays, read within `storage_errors`: damaged bytes and lost connections are one line with a cure."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray
from xarray.backends import BackendArray
from xarray.core import indexing

from dmcvb_gen.storage.remote import storage_errors


class Guarded(BackendArray):
    """The values of a lazy variable.

    Args:
      place: the array's folder or URL, for errors.
    """

    def __init__(self, variable: xarray.Variable, place: str):
        self._variable, self._place = variable, place
        self.shape, self.dtype = variable.shape, variable.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple) -> np.ndarray:
        with storage_errors(self._place, decoding=True):
            return self._variable[key].values


def guarded(data: xarray.Dataset, place: str) -> xarray.Dataset:
    """A lazy data set, opened at `place`, whose variables are read within `storage_errors`."""
    lazy = {}
    for name, variable in data.variables.items():
        source = indexing.LazilyIndexedArray(Guarded(variable, f"{place}/{name}"))
        held = indexing.MemoryCachedArray(source)
        lazy[name] = xarray.Variable(variable.dims, held, variable.attrs, variable.encoding)
    return xarray.Dataset(lazy, attrs=data.attrs)
