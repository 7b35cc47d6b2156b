r"""Describe the Zarr arrays that hold the episodes of a subset.

One Zarr v3 group a subset, arrays episode-major, one shard file an array and job::

    <release>/manifest.json
    <release>/<task>/<level>/<setting>.zarr/
        pixels                    (episode, step, height, width, channel) uint8
        pixels_top ...            the same, of tasks with several views: pixels_<view>, pixels_hidden_goal_<view>
        state action reward ...   (episode, step, ...)
        length return ...         (episode,)
        exogenous/...             (episode, step, ...) labels of the distractors

Everything but the labels lies at the root, so `xarray.open_zarr` shows it. In Python the picture of a view is called
"pixels/top" (`stored_name` says where it lies; releases of version 1 have such a group). Dimensions are named so that
none has the name of an array: action_dim, state_dim, physics_dim (in version 1: action, state, physics).

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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import zarr
from zarr.codecs import Crc32cCodec, TransposeCodec, ZstdCodec

from dmcvb_gen.dataset.manifest import SCHEMA_VERSION, SubsetRecord
from dmcvb_gen.dataset.pictures import picture_arrays, stored_pictures
from dmcvb_gen.distractor_state import LABEL_DIMENSIONS, LABEL_DTYPES, OPTIONAL_LABELS

PIXEL_CHUNK_STEPS = 32
"""Steps an inner chunk of the pictures: the unit of reading (chosen with scripts/bench_store.py)."""


@dataclass(frozen=True)
class ArraySpec:
    """One array of a subset.

    Attributes:
      name: path inside the group, e.g. "pixels" or "exogenous/camera_position".
      dtype: numpy name.
      shape: shape of one step, or of one episode's entry if `steps` is false.
      dims: names of the axes of `shape`.
      steps: True if the array has a step axis.
      picture: True if it holds pictures (another chunking and codec).
      attributes: stored with the array.
    """

    name: str
    dtype: str
    shape: tuple[int, ...] = ()
    dims: tuple[str, ...] = ()
    steps: bool = True
    picture: bool = False
    attributes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EpisodeShape:
    """Shape of a task's episodes: all that the layout needs to know of the task.

    Attributes:
      views: names of the pictures of a frame, in their order; ("pixels",) for one.
      goal: True if there are pictures with the goal hidden beside them.
      state_fields: name -> (first, last + 1) in the state.
      action_size, state_size, physics_size: entries of one step.
      materials: materials whose colors are labels.
      max_steps: transitions at which the time limit ends an episode.
      attributes: what is stored with the arrays of these names, beside the fields of states.
    """

    views: tuple[str, ...]
    goal: bool
    state_fields: Mapping[str, tuple[int, int]]
    action_size: int
    state_size: int
    physics_size: int
    materials: int
    max_steps: int
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, task: Any) -> EpisodeShape:
        """The shape of a `dmcvb_gen.tasks` task (which this package does not import)."""
        return cls(
            views=tuple(task.views),
            goal=bool(task.goal_geoms),
            state_fields={name: (part.start, part.stop) for name, part in task.state_slices.items()},
            action_size=task.action_size,
            state_size=task.state_size,
            physics_size=task.physics_size,
            materials=len(task.material_colors),
            max_steps=task.max_steps,
            attributes=task.array_attributes,
        )

    @property
    def rows(self) -> int:
        """Rows of the step axis: one for each observation."""
        return self.max_steps + 1


def stored_name(name: str, schema_version: int = SCHEMA_VERSION) -> str:
    """Path of an array inside its Zarr group: "pixels/top" lies at "pixels_top", labels in their group."""
    return name if schema_version < 2 or name.startswith("exogenous/") else name.replace("/", "_")


def picture_spec(name: str, size: int) -> ArraySpec:
    """The spec of one picture array of `size` x `size` RGB."""
    return ArraySpec(name, "uint8", (size, size, 3), ("height", "width", "channel"), picture=True)


def subset_specs(shape: EpisodeShape, record: SubsetRecord) -> tuple[ArraySpec, ...]:
    """All arrays of the subset of a record, with the pictures that it stores."""
    varying = [part for part in OPTIONAL_LABELS.values() if record.distractor.varies(part)]
    return array_specs(shape, record.size, stored_pictures(record, shape.goal), varying)


def array_specs(
    shape: EpisodeShape, size: int, pictures: Sequence[str] | None = None, varying: Collection[str] = ()
) -> tuple[ArraySpec, ...]:
    """All arrays of a subset with episodes of `shape` and pictures of `size`.

    Args:
      pictures: names of its picture arrays; those of all views by default, with the goal and without it.
      varying: parts of the distractor that vary and have labels of their own, see `OPTIONAL_LABELS`.
    """
    both = picture_arrays(shape.views) + (picture_arrays(shape.views, hide_goal=True) if shape.goal else ())
    names = both if pictures is None else pictures
    fields, given = {name: list(part) for name, part in shape.state_fields.items()}, shape.attributes
    specs = [picture_spec(name, size) for name in names]
    specs += [
        ArraySpec("state", "float32", (shape.state_size,), ("state_dim",), attributes={"fields": fields}),
        ArraySpec("action", "float32", (shape.action_size,), ("action_dim",), attributes=given.get("action", {})),
        ArraySpec("reward", "float32"),
        ArraySpec("discount", "float32"),
        ArraySpec("physics", "float64", (shape.physics_size,), ("physics_dim",), attributes=given.get("physics", {})),
        *_label_specs(shape, varying),
        ArraySpec("length", "int32", steps=False),
        ArraySpec("terminated", "bool", steps=False),
        ArraySpec("return", "float64", steps=False),
        ArraySpec("seed", "uint64", steps=False),
        ArraySpec("behaviour", "int16", steps=False),
        ArraySpec("goal_pair", "int16", steps=False),
    ]
    return tuple(specs)


def _label_specs(shape: EpisodeShape, varying: Collection[str]) -> list[ArraySpec]:
    """The distractors' labels, in the order of `DistractorState`."""
    sizes = {"view": len(shape.views), "material": shape.materials, "xyz": 3, "wxyz": 4, "rgb": 3}
    return [
        ArraySpec(f"exogenous/{name}", dtype, tuple(sizes[d] for d in LABEL_DIMENSIONS[name]), LABEL_DIMENSIONS[name])
        for name, dtype in LABEL_DTYPES.items()
        if OPTIONAL_LABELS.get(name, "") in ("", *varying)
    ]


# -- codecs: how one inner chunk becomes bytes ----------------------------------------------------


def picture_codecs(layout: str) -> dict[str, Any]:
    """Codecs of a picture chunk (1, step, height, width, channel), by name of the layout.

    All are standard or numcodecs' own, so plain zarr-python reads them. See scripts/bench_store.py.
    """
    from zarr.codecs import BloscCodec, numcodecs

    time_last = TransposeCodec(order=(0, 2, 3, 4, 1))
    width_last = TransposeCodec(order=(0, 1, 4, 2, 3))
    channel_first = TransposeCodec(order=(0, 4, 1, 2, 3))
    delta = numcodecs.Delta(dtype="|u1")
    layouts: dict[str, dict[str, Any]] = {
        "zstd": dict(filters=(), compressors=(ZstdCodec(level=3),)),
        "blosc-bitshuffle": dict(
            filters=(), compressors=(BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle", typesize=1),)
        ),
        "time-zstd": dict(filters=(time_last,), compressors=(ZstdCodec(level=3),)),
        "time-delta-zstd": dict(filters=(time_last, delta), compressors=(ZstdCodec(level=3),)),
        "width-delta-zstd": dict(filters=(width_last, delta), compressors=(ZstdCodec(level=3),)),
        "channel-delta-zstd": dict(filters=(channel_first, delta), compressors=(ZstdCodec(level=1),)),
        "width-delta-blosc": dict(
            filters=(width_last, delta),
            compressors=(BloscCodec(cname="zstd", clevel=3, shuffle="noshuffle", typesize=1),),
        ),
        "zstd-9": dict(filters=(), compressors=(ZstdCodec(level=9),)),
        "width-delta-zstd-9": dict(filters=(width_last, delta), compressors=(ZstdCodec(level=9),)),
    }
    return layouts[layout]


def picture_layout_for(camera_moves: bool) -> str:
    """The codec layout of a subset's images, as measured with scripts/bench_store.py.

    Images of a moving camera are smaller as differences of neighboring pixels, one color channel at a time. If the
    camera stands still, zstd finds the repeated rows by itself, and is faster to read.
    """
    return "channel-delta-zstd" if camera_moves else "zstd"


def create_arrays(
    group: zarr.Group,
    specs: tuple[ArraySpec, ...],
    episodes: int,
    rows: int,
    episodes_per_shard: int,
    picture_layout: str = "zstd",
    chunk_steps: int | None = None,
    schema_version: int = SCHEMA_VERSION,
) -> None:
    """Create the (empty) arrays of a subset: metadata only, no data.

    Args:
      episodes: episodes the subset will have.
      rows: rows of the step axis, max_steps + 1.
      episodes_per_shard: episodes a shard file.
      schema_version: version of the release's schema; a shard of an older one is made again where it lay.
    """
    for spec in specs:
        if not spec.steps:
            shape, dims = (episodes, *spec.shape), ("episode", *spec.dims)
            chunks, shards = (episodes_per_shard, *spec.shape), None
        else:
            shape, dims = (episodes, rows, *spec.shape), ("episode", "step", *spec.dims)
            steps = (chunk_steps or PIXEL_CHUNK_STEPS) if spec.picture else rows
            steps = min(steps, rows)
            chunks = (1, steps, *spec.shape)
            shards = (episodes_per_shard, -(-rows // steps) * steps, *spec.shape)
        if spec.picture:
            codecs = dict(picture_codecs(picture_layout))
        else:
            codecs = dict(filters=(), compressors=(ZstdCodec(level=3),))
        codecs["compressors"] = (*codecs["compressors"], Crc32cCodec())
        group.create_array(
            name=stored_name(spec.name, schema_version),
            shape=shape,
            chunks=chunks,
            shards=shards,
            dtype=spec.dtype,
            fill_value=0,
            dimension_names=dims,
            attributes={"array": spec.name, **spec.attributes},
            **codecs,
        )
