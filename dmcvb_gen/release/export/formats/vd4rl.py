"""V-D4RL's two layouts (github.com/conglu1997/v-d4rl): HDF5 for DrQ+BC and CQL, one npz an episode for DreamerV2.

Both align as dm_env does: row t holds observation t and the action, reward and discount that came with it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.release.export.registry import register_exporter

FIRST, MID, LAST = 0, 1, 2
"""dm_env's step types."""
EPISODES_PER_FILE = 50


def _step_types(rows: int) -> np.ndarray:
    types = np.full(rows, MID, np.int64)
    types[0], types[-1] = FIRST, LAST
    return types


@register_exporter("hdf5", modules=("h5py",))
def write_hdf5(source: Source, folder: Path) -> None:
    """Write `data_000.hdf5`, ...: `observation` (row, 3 * view, height, width) uint8, `action`, `reward`, `discount`,
    `state` float32 and `step_type`, episodes one after the other; stored `depth`, `segmentation`, `flow` as well. The
    attributes name the entries of state and action, and the joints."""
    import h5py

    for number, episode in enumerate(source):
        values = {
            "observation": episode.stacked().transpose(0, 3, 1, 2),
            **episode.arrived(),
            "state": episode.state,
            "step_type": _step_types(episode.length + 1),
            **episode.named_modalities(),
        }
        with h5py.File(folder / f"data_{number // EPISODES_PER_FILE:03d}.hdf5", "a") as file:
            file.attrs.update({"description": source.description, "joints": source.joints})
            for name, value in values.items():
                _append(file, name, value)
            for name, entries in source.names.items():
                file[name].attrs["names"] = entries


def _append(file, name: str, value: np.ndarray) -> None:
    if name not in file:
        chunks = (min(len(value), 32), *value.shape[1:])
        shape = (None, *value.shape[1:])
        file.create_dataset(name, data=value, maxshape=shape, chunks=chunks, compression="gzip", compression_opts=1)
        return
    before = len(file[name])
    file[name].resize(before + len(value), axis=0)
    file[name][before:] = value


@register_exporter("npz")
def write_npz(source: Source, folder: Path) -> None:
    """Write `<episode>-<rows>.npz`: `image` (row, height, width, 3 * view) uint8, `action`, `reward`, `discount`,
    `state` float32, `is_first`, `is_last`, `is_terminal` bool; `depth`, `segmentation`, `flow` if they are stored."""
    for episode in source:
        types = _step_types(episode.length + 1)
        arrays: dict[str, Any] = {"is_first": types == FIRST, "is_last": types == LAST}
        arrays |= {"is_terminal": arrays["is_last"] & episode.terminated}
        arrays |= {"image": episode.stacked(), "state": episode.state}
        arrays |= episode.arrived() | episode.named_modalities()
        np.savez_compressed(folder / f"{episode.index:06d}-{len(types)}.npz", **arrays)
