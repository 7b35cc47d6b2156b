r"""Describe the layers and arrays of a subset.

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

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from dmcvb_gen.dataset.manifest import ArraySpec, Layer
from dmcvb_gen.distractor_state import LABEL_DIMENSIONS, LABEL_DTYPES, OPTIONAL_LABELS

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


def array_metadata(layer: Layer, spec: ArraySpec, episodes: int) -> dict[str, Any]:
    """What an array's zarr.json says, from its spec alone; `chunks.open_array` builds our readers' arrays from it.

    All codecs are Zarr's own or numcodecs', so plain zarr-python reads them.

    Args:
      episodes: length of the first axis.
    """
    dtype, filters, level = np.dtype(spec.dtype), [], 3
    if spec.codec == "channel-delta-zstd":
        filters = [_named("transpose", order=[0, 4, 1, 2, 3]), _named("numcodecs.delta", dtype="|u1")]
        level = 1
    to_bytes = _named("bytes", **({"endian": "little"} if dtype.itemsize > 1 else {}))
    codecs = [*filters, to_bytes, _named("zstd", level=level, checksum=False), _named("crc32c")]
    shape, chunk, dims = [episodes], [layer.episodes_per_shard], ["episode"]
    if spec.steps:
        steps = min(spec.chunk_steps or layer.rows, layer.rows)
        shape, chunk, dims = [*shape, layer.rows], [*chunk, -(-layer.rows // steps) * steps], [*dims, "step"]
        index = {"index_codecs": [_named("bytes", endian="little"), _named("crc32c")], "index_location": "end"}
        codecs = [_named("sharding_indexed", chunk_shape=[1, steps, *spec.shape], codecs=codecs, **index)]
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [*shape, *spec.shape],
        "data_type": dtype.name,
        "chunk_grid": _named("regular", chunk_shape=[*chunk, *spec.shape]),
        "chunk_key_encoding": _named("default", separator="/"),
        "fill_value": dtype.type(0).item(),
        "codecs": codecs,
        "attributes": {"array": spec.name, **spec.attributes},
        "dimension_names": [*dims, *spec.dims],
        "storage_transformers": [],
    }


def _named(name: str, **configuration: Any) -> dict[str, Any]:
    return {"name": name} | ({"configuration": configuration} if configuration else {})
