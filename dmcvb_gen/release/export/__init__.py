"""Export: a release's subsets in the layouts that other people's code reads, a folder a subset."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from dmcvb_gen.errors import DmcvbError, StoreError, UnknownNameError
from dmcvb_gen.readers.release import open_for_reading
from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.rollout.recipe import select


@dataclass(frozen=True)
class Format:
    """One export format.

    Attributes:
      module: where its `write(source, folder)` lives.
      keeps, drops: what of a subset is in it and what is not, in words.
      extra: the extra of dmcvb-gen that it needs, None if none.
    """

    module: str
    reader: str
    keeps: str
    drops: str
    extra: str | None = None


FORMATS = {
    "hdf5": Format(
        "vd4rl:write_hdf5",
        "V-D4RL's DrQ+BC loader (`observation`, `action`, `reward`, `discount`, `step_type`)",
        "pixels (channels first), states, actions, rewards, discounts",
        "physics, labels, seeds",
        "hdf5",
    ),
    "npz": Format(
        "vd4rl:write_npz",
        "V-D4RL's DreamerV2 loader (`image`, `action`, `reward`, `discount`, `is_first`, `is_last`, `is_terminal`)",
        "pixels, states, actions, rewards, discounts",
        "physics, labels, seeds",
    ),
    "replay-buffer": Format(
        "replay_buffer:write",
        "diffusion policy's `ReplayBuffer` (Zarr 2: `data/img`, `data/state`, `data/action`, `meta/episode_ends`)",
        "pixels, states, actions, rewards",
        "the last observation of each episode, discounts, physics, labels",
    ),
    "minari": Format(
        "minari_format:write",
        "minari (`MinariDataset`, HDF5 storage, lossless pictures)",
        "pixels, states, actions, rewards, ends, seeds, the Gymnasium environment",
        "physics, labels",
        "minari",
    ),
    "lerobot": Format(
        "lerobot:write",
        "LeRobot v3 (Parquet with PNG pictures)",
        "pixels, states, actions, rewards, ends",
        "the last observation of each episode, physics, labels",
        "lerobot",
    ),
    "rlds": Format(
        "rlds:write",
        "TensorFlow Datasets (`tfds.builder_from_directory`): RLDS steps, PNG, state fields also under DMC-VB's names",
        "pixels, states, actions, rewards, discounts, ends",
        "physics, labels",
    ),
}
"""Name -> format."""


def export(
    path: str,
    to: str,
    out: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    storage_options: dict | None = None,
    tick: Callable[[int], None] = lambda episodes: None,
) -> list[Path]:
    """Write subsets in another format.

    Args:
      path: a release, here or at a URL.
      to: a name out of `FORMATS`.
      out: folder of the exports; each subset gets `<out>/<task>/<level>/<setting>`.
      only: subset patterns; episodes: (first, last + 1); all by default.
      tick: told 1 for each episode.

    Returns:
      The folders.

    Raises:
      UnknownNameError: no such format or subset. DmcvbError: its package is not installed. StoreError: there is
      something at `out` already, or it cannot be written.
    """
    if to not in FORMATS:
        raise UnknownNameError("format", to, FORMATS)
    module, function = FORMATS[to].module.split(":")
    try:
        write = getattr(importlib.import_module(f"{__name__}.{module}"), function)
    except ImportError as error:
        cure = f'pip install "dmcvb-gen[{FORMATS[to].extra}]"'
        raise DmcvbError(f"export to {to} needs a package that is not installed ({error.name}): {cure}") from None
    release = open_for_reading(path, storage_options)
    if not release.subsets:
        raise StoreError(f"{path} has no committed episodes yet")
    folders = []
    for name in select(list(release.subsets), list(only)):
        subset, folder = release[name], Path(out) / name
        chosen = [int(e) for e in subset.episodes if episodes is None or episodes[0] <= e < episodes[1]]
        if not chosen:
            raise StoreError(f"{name} has none of the episodes {episodes[0]}:{episodes[1]} here")
        if folder.exists():
            raise StoreError(f"{folder} is there already; choose another --out")
        partial = folder.with_name(folder.name + ".partial")
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            write(Source(release.manifest, subset, chosen, tick), partial)
            partial.rename(folder)  # whole or not at all
        except OSError as error:
            raise StoreError(f"cannot write to {folder}: {error.strerror or error}; make room or give --out") from None
        folders.append(folder)
    return folders


def format_table() -> str:
    """The formats as a Markdown table: which program reads them, what they keep and what they leave out."""
    lines = ["| `--to` | read by | keeps | leaves out | extra |", "|---|---|---|---|---|"]
    for name, kind in FORMATS.items():
        extra = f"`dmcvb-gen[{kind.extra}]`" if kind.extra else ""
        lines.append(f"| `{name}` | {kind.reader} | {kind.keeps} | {kind.drops} | {extra} |")
    return "\n".join(lines)
