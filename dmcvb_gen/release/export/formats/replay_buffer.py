"""Diffusion policy's replay buffer (github.com/real-stanford/diffusion_policy): Zarr 2, time first, episode ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import zarr
from numcodecs import Blosc

from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.release.export.registry import register_exporter

CHUNK = 161
"""Steps a chunk."""


@register_exporter("replay-buffer")
def write(source: Source, folder: Path) -> None:
    """Write `replay_buffer.zarr`: `data/img` (step, height, width, 3) uint8 (`data/img_<view>` for several views),
    `data/state`, `data/action`, `data/reward` float32, stored modalities (`data/depth`), and `meta/episode_ends` int64.
    The attributes name the entries of state and action, and the joints."""
    root = zarr.open_group(str(folder / "replay_buffer.zarr"), mode="w", zarr_format=2)
    root.attrs.update({"description": source.description, "joints": source.joints})
    data, meta = root.create_group("data"), root.create_group("meta")
    arrays: dict[str, zarr.Array] = {}
    lengths: list[int] = []
    for episode in source:
        length = episode.length
        single = len(episode.pixels) == 1
        values = {"img" if single else f"img_{view}": frames[:length] for view, frames in episode.pixels.items()}
        values |= {"state": episode.state[:length], "action": episode.action, "reward": episode.reward}
        values |= {name: value[:length] for name, value in episode.named_modalities().items()}
        for name, value in values.items():
            if name not in arrays:
                arrays[name] = data.create_array(
                    name,
                    shape=(0, *value.shape[1:]),
                    chunks=(CHUNK, *value.shape[1:]),
                    dtype=value.dtype,
                    compressors=Blosc(cname="zstd", clevel=5, shuffle=Blosc.BITSHUFFLE),
                    attributes={"names": source.names[name]} if name in source.names else {},
                )
            arrays[name].append(value)
        lengths.append(length)
    meta.create_array("episode_ends", data=np.cumsum(lengths, dtype=np.int64))
