"""Turn an array's shard into the bytes of its file, and back, with Zarr."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ShardingCodec, ZstdCodec
from zarr.core.array import AsyncArray
from zarr.core.array_spec import ArrayConfig
from zarr.core.buffer import default_buffer_prototype
from zarr.core.codec_pipeline import BatchedCodecPipeline
from zarr.core.metadata.v3 import ArrayV3Metadata
from zarr.registry import get_codec_class
from zarr.storage import MemoryStore, StorePath

from dmcvb_gen.dataset.manifest import ArraySpec, Layer
from dmcvb_gen.dataset.schema import array_metadata
from dmcvb_gen.errors import StoreError

_CONFIG = ArrayConfig(order="C", write_empty_chunks=True)
"""Zarr leaves the choice of empty chunks to `BoundedZstd`: its own takes longer than the compression."""


class BoundedZstd(ZstdCodec):
    """zstd for arrays that are zero by default: it encodes a chunk of zeros as no chunk.

    It decodes no more than a chunk, whatever a frame's header claims; rows that a frame lacks are zero.
    """

    async def _encode_single(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
        return await super()._encode_single(chunk_bytes, chunk_spec) if chunk_bytes.as_numpy_array().any() else None

    async def _decode_single(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
        return await asyncio.to_thread(self._decode_sync, chunk_bytes, chunk_spec)  # which zarr before 3.1.6 does not

    def _decode_sync(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
        out = np.zeros(math.prod(chunk_spec.shape) * chunk_spec.dtype.item_size, np.uint8)
        self._zstd_codec.decode(chunk_bytes.as_numpy_array(), out)
        return chunk_spec.prototype.buffer.from_array_like(out)


class _Sharding(ShardingCodec):
    """Sharding that hands its codecs many chunks at once; one by one, most of the time goes into asyncio."""

    @property
    def codec_pipeline(self) -> Any:
        return BatchedCodecPipeline.from_codecs(self.codecs, batch_size=64)


_OURS: dict[str, Any] = {"zstd": BoundedZstd, "sharding_indexed": _Sharding}


def _codec(said: dict[str, Any]) -> Any:
    """Zarr's codec of that name and configuration; ours where there is one."""
    values = dict(said.get("configuration", {}))
    if "codecs" in values:
        values["codecs"] = [_codec(inner) for inner in values["codecs"]]
    kind = _OURS.get(said["name"]) or get_codec_class(said["name"])
    return kind.from_dict(said | {"configuration": values})


def open_array(layer: Layer, spec: ArraySpec, episodes: int, store: Any) -> zarr.Array:
    """An array over a Zarr store of its chunks, built from its spec; nothing is read."""
    said = array_metadata(layer, spec, episodes)
    metadata = ArrayV3Metadata.from_dict(said | {"codecs": [_codec(each) for each in said["codecs"]]})
    return zarr.Array(AsyncArray(metadata=metadata, store_path=StorePath(store), config=_CONFIG))


def encode(layer: Layer, spec: ArraySpec, values: np.ndarray) -> bytes | None:
    """The bytes of an array's file of one shard.

    Args:
      values: (episode of the shard, row, ...) or (episode of the shard, ...); a full shard.

    Returns:
      None if all values are fill values: there is no file then.

    Raises:
      StoreError: the values have another shape or dtype than the spec.
    """
    rows = (layer.rows,) if spec.steps else ()
    shape = (layer.episodes_per_shard, *rows, *spec.shape)
    if values.shape != shape or values.dtype != np.dtype(spec.dtype):
        raise StoreError(
            f"{spec.name} of {layer.name} is {values.dtype} {values.shape}, and its layer stores {spec.dtype} {shape}"
        )
    chunks: dict[str, Any] = {}
    array = open_array(layer, spec, layer.episodes_per_shard, MemoryStore(chunks))
    array[...] = values
    return next(iter(chunks.values())).to_bytes() if chunks else None


def decode(layer: Layer, spec: ArraySpec, data: bytes | None) -> np.ndarray:
    """The values of an array's file of one shard, see `encode`.

    Raises:
      StoreError: the bytes are damaged.
    """
    chunks: dict[str, Any] = {}
    if data is not None:
        key = layer.file_path(spec, 0).removeprefix(f"{layer.group}/{spec.stored_name}/")
        chunks[key] = default_buffer_prototype().buffer.from_bytes(data)
    array = open_array(layer, spec, layer.episodes_per_shard, MemoryStore(chunks))
    try:
        return np.asarray(array[...])
    except Exception as error:  # codecs raise anything
        reason = type(error).__name__
        raise StoreError(f"{spec.name} of {layer.name} cannot be decoded ({reason}); fetch it again") from None
