r"""Describe the layers and arrays of a subset, and how an array's shard becomes bytes.

One Zarr v3 group a set of trajectories, arrays episode-major, one file an array and shard::

    <release>/<task>/<level>.zarr/                 the settings of a task and level share their trajectories
        trajectories/  state action reward ...     (episode, step, ...)
                       length return ...           (episode,)
        dynamic/       exogenous/...               (episode, step, ...) labels of the distractors
                       pixels                      (episode, step, height, width, channel) uint8
                       pixels_top ...              the same, of tasks with several views
                       at84/pixels                 the same images at another size
    <release>/<task>/<level>/<setting>.zarr/       a setting with trajectories of its own (mazes, --independent)

In Python the image of a view is called "pixels/top"; `ArraySpec.stored_name` says where it lies. No dimension has the
name of an array: action_dim, state_dim, physics_dim.

An episode of `length` L transitions fills rows 0..L; row t holds observation t, the action taken there
and the reward that it earned; row L holds the last observation and no action (zeros)::

    step        0     1          L-1    L     L+1 ...
    pixels      o_0   o_1   ...  o_L-1  o_L   (nothing stored)
    state       s_0   s_1   ...  s_L-1  s_L
    action      a_0   a_1   ...  a_L-1  0
    reward      r_0   r_1   ...  r_L-1  0      r_t: earned by a_t
    discount    1     1     ...  d      0      d = 0 if the task ended the episode, 1 at the time limit

Rows past L are never written: a missing chunk costs no storage.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BytesCodec, Crc32cCodec, ShardingCodec, TransposeCodec, ZstdCodec
from zarr.core.array import AsyncArray
from zarr.core.array_spec import ArrayConfig
from zarr.core.buffer import default_buffer_prototype
from zarr.core.codec_pipeline import BatchedCodecPipeline
from zarr.core.metadata.v3 import ArrayV3Metadata
from zarr.dtype import parse_dtype
from zarr.storage import MemoryStore, StorePath

from dmcvb_gen.dataset.manifest import ArraySpec, Codec, Layer
from dmcvb_gen.distractor_state import LABEL_DIMENSIONS, LABEL_DTYPES, OPTIONAL_LABELS
from dmcvb_gen.errors import StoreError

PIXEL_CHUNK_STEPS = 32
"""Steps of a chunk of images: the unit of reading."""


def trajectory_arrays(task: Any) -> tuple[ArraySpec, ...]:
    """The arrays of a set of trajectories of a `dmcvb_gen.tasks` task (which this package does not import)."""
    fields = {name: [part.start, part.stop] for name, part in task.state_slices.items()}
    low, high = ([*map(float, bounds)] for bounds in (task.action_low, task.action_high))

    def vector(name: str, dtype: Any, size: int, attributes: dict[str, Any]) -> ArraySpec:
        return ArraySpec(name=name, dtype=dtype, shape=(size,), dims=(f"{name}_dim",), attributes=attributes)

    return (
        vector("state", "float32", task.state_size, {"fields": fields}),
        vector("action", "float32", len(low), {"low": low, "high": high}),
        ArraySpec(name="reward", dtype="float32"),
        ArraySpec(name="discount", dtype="float32"),
        vector("physics", "float64", task.physics_size, dict(task.array_attributes.get("physics", {}))),
        ArraySpec(name="length", dtype="int32", steps=False),
        ArraySpec(name="terminated", dtype="bool", steps=False),
        ArraySpec(name="return", dtype="float64", steps=False),
        ArraySpec(name="seed", dtype="uint64", steps=False),
        ArraySpec(name="behaviour", dtype="int16", steps=False),
        ArraySpec(name="goal_pair", dtype="int16", steps=False),
    )


def label_arrays(task: Any, varying: Collection[str] = ()) -> tuple[ArraySpec, ...]:
    """The arrays of a setting's labels, in the order of `DistractorState`.

    Args:
      varying: parts of the distractor that vary and have labels of their own, see `OPTIONAL_LABELS`.
    """
    sizes = {"view": len(task.views), "material": len(task.material_colors), "xyz": 3, "wxyz": 4, "rgb": 3}
    return tuple(
        ArraySpec(
            name=f"exogenous/{name}",
            dtype=dtype,  # type: ignore[arg-type]  # checked by the model
            shape=tuple(sizes[axis] for axis in LABEL_DIMENSIONS[name]),
            dims=LABEL_DIMENSIONS[name],
        )
        for name, dtype in LABEL_DTYPES.items()
        if OPTIONAL_LABELS.get(name, "") in ("", *varying)
    )


def image_array(
    name: str,
    size: int,
    camera_moves: bool,
    rows: int,
    *,
    own_size: int | None = None,
    dtype: str = "uint8",
    shape: Sequence[int] = (3,),
    dims: Sequence[str] = ("channel",),
) -> ArraySpec:
    """The array of one view's images, or of a modality of it.

    Images of a moving camera are smaller as differences of neighboring pixels, one color channel at a time. If the
    camera stands still, zstd finds the repeated rows by itself, and is faster to read.

    Args:
      name: "pixels", "pixels/top", "depth/top", ...
      size: pixels a side.
      rows: rows of the step axis.
      own_size: size of the subset's own images; those of another size are called "at84/pixels", and their axes so.
      dtype, shape, dims: of one pixel; a modality has others than RGB.
    """
    other = own_size is not None and size != own_size
    axes = (f"height_{size}", f"width_{size}") if other else ("height", "width")
    return ArraySpec(
        name=f"at{size}/{name}" if other else name,
        dtype=dtype,  # type: ignore[arg-type]
        shape=(size, size, *shape),
        dims=(*axes, *dims),
        chunk_steps=min(PIXEL_CHUNK_STEPS, rows),
        codec="channel-delta-zstd" if camera_moves and dtype == "uint8" and tuple(shape) == (3,) else "zstd",
    )


# -- arrays as Zarr has them ----------------------------------------------------------------------


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


def _filters(codec: Codec) -> tuple[Any, ...]:
    """Array codecs before bytes: all are Zarr's own or numcodecs', so plain zarr-python reads them."""
    if codec == "zstd":
        return ()
    from zarr.codecs import numcodecs

    return (TransposeCodec(order=(0, 4, 1, 2, 3)), numcodecs.Delta(dtype="|u1"))


def array_metadata(layer: Layer, spec: ArraySpec, episodes: int) -> ArrayV3Metadata:
    """Zarr's metadata of an array, from its spec alone; our readers build arrays from it, others get zarr.json.

    Args:
      episodes: length of the first axis.
    """
    per_shard, rows = layer.episodes_per_shard, layer.rows
    pixel_level = 1 if spec.codec == "channel-delta-zstd" else 3
    array_to_bytes = [*_filters(spec.codec), BytesCodec(), BoundedZstd(level=pixel_level), Crc32cCodec()]
    if not spec.steps:
        shape, chunks, codecs = (episodes, *spec.shape), (per_shard, *spec.shape), array_to_bytes
        dims: tuple[str, ...] = ("episode", *spec.dims)
    else:
        steps = min(spec.chunk_steps or rows, rows)
        shape, dims = (episodes, rows, *spec.shape), ("episode", "step", *spec.dims)
        chunks = (per_shard, -(-rows // steps) * steps, *spec.shape)
        codecs = [_Sharding(chunk_shape=(1, steps, *spec.shape), codecs=array_to_bytes)]
    return ArrayV3Metadata(
        shape=shape,
        data_type=parse_dtype(np.dtype(spec.dtype), zarr_format=3),
        chunk_grid={"name": "regular", "configuration": {"chunk_shape": list(chunks)}},
        chunk_key_encoding={"name": "default", "configuration": {"separator": "/"}},
        fill_value=0,
        codecs=codecs,
        attributes={"array": spec.name, **spec.attributes},
        dimension_names=dims,
    )


def open_array(layer: Layer, spec: ArraySpec, episodes: int, store: Any) -> zarr.Array:
    """An array over a Zarr store of its chunks, built from its spec; nothing is read."""
    metadata = array_metadata(layer, spec, episodes)
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
