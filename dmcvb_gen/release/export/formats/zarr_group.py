"""One self-contained Zarr v3 group a subset: trajectories, labels and images side by side, for zarr and xarray."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.release.export.registry import register_exporter


@register_exporter("zarr")
def write(source: Source, folder: Path) -> None:
    """Write `data.zarr` with every array of the subset, (episode, step, ...) or (episode,); "/" in names becomes "_".

    Rows are those of the release, see `dmcvb_gen.dataset.schema`; rows past an episode's length are zero. `episode` has
    the indices of the episodes. The codecs are Zarr's own, so nothing warns.
    """
    subset, count = source.subset, len(source.episodes)
    record, together = subset.record, subset.trajectories.episodes_per_shard
    facts: dict[str, Any] = {"description": source.description, "joints": source.joints, "views": list(record.views)}
    facts |= {name: getattr(record, name) for name in ("task", "level", "setting", "seconds_per_step")}
    group = zarr.create_group(str(folder / "data.zarr"), attributes=facts)
    group.create_array("episode", data=np.array(source.episodes), dimension_names=("episode",))
    arrays = {}
    for name in subset.arrays:
        stored, spec = subset.array(name), subset.spec(name)
        chunking: dict[str, Any] = {"chunks": (together, *spec.shape)}
        if spec.steps:
            rows = stored.shape[1]
            steps = min(spec.chunk_steps or rows, rows)
            chunking = {"chunks": (1, steps, *spec.shape)}
            chunking |= {"shards": (together, -(-rows // steps) * steps, *spec.shape)}
        arrays[name] = group.create_array(
            name.replace("/", "_"),
            shape=(count, *stored.shape[1:]),
            dtype=stored.dtype,
            **chunking,
            dimension_names=stored.dimensions,
            attributes=spec.attributes | ({"names": source.names[name]} if name in source.names else {}),
            fill_value=0,
        )
    for first in range(0, count, together):
        episodes = source.episodes[first : first + together]
        for name, array in arrays.items():
            array[first : first + len(episodes)] = subset.read(name, episodes)
        source.tick(len(episodes))
    with warnings.catch_warnings(action="ignore"):  # that consolidated metadata, which xarray looks for, may change
        zarr.consolidate_metadata(group.store)
