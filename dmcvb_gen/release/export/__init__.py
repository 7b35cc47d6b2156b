"""Export: a release's subsets in the layouts that other people's code reads, a folder a subset."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.manifest import Manifest
from dmcvb_gen.errors import DmcvbError, StoreError, UnknownNameError
from dmcvb_gen.files import folder_in_the_making, parse_json, remove_partial, write_json
from dmcvb_gen.loaders.release import ReleaseReader, open_for_reading
from dmcvb_gen.names import select
from dmcvb_gen.parallel import ProgressCallback, Workers, expect, ignore, open_pool
from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.storage.remote import local_path, storage_errors


@dataclass(frozen=True)
class Format:
    """One export format.

    Attributes:
      module: where its `write(source, folder)` lives.
      reader: the program that it is for. mark: pattern of a file that only this format has.
      keeps, drops: what of a subset is in it and what is not, in words.
      packages: what it needs beyond dmcvb-gen's own dependencies.
      options: those of `export` that are for it.
    """

    module: str
    reader: str
    keeps: str
    drops: str
    mark: str
    packages: tuple[str, ...] = ()
    options: tuple[str, ...] = ()


FORMATS = {
    "hdf5": Format(
        "vd4rl:write_hdf5",
        "V-D4RL's DrQ+BC loader (`observation`, `action`, `reward`, `discount`, `step_type`)",
        "pixels (channels first), states, actions, rewards, discounts",
        "physics, labels, seeds",
        "data_*.hdf5",
        ("h5py",),
    ),
    "npz": Format(
        "vd4rl:write_npz",
        "V-D4RL's DreamerV2 loader (`image`, `action`, `reward`, `discount`, `is_first`, `is_last`, `is_terminal`)",
        "pixels, states, actions, rewards, discounts",
        "physics, labels, seeds",
        "[0-9]*-[0-9]*.npz",
    ),
    "replay-buffer": Format(
        "replay_buffer:write",
        "diffusion policy's `ReplayBuffer` (Zarr 2: `data/img`, `data/state`, `data/action`, `meta/episode_ends`)",
        "pixels, states, actions, rewards",
        "the last observation of each episode, discounts, physics, labels",
        "replay_buffer.zarr/.zgroup",
    ),
    "minari": Format(
        "minari_format:write",
        "minari (`MINARI_DATASETS_PATH=<out>`; HDF5 storage, lossless pictures)",
        "pixels, states, actions, rewards, ends, seeds, the Gymnasium environment",
        "physics, labels",
        "data/main_data.hdf5",
        ("minari", "h5py"),
    ),
    "lerobot": Format(
        "lerobot:write",
        "LeRobot v3 (Parquet with PNG pictures, or mp4), `datasets.load_dataset`",
        "pixels, states, actions, rewards, ends",
        "the last observation of each episode, physics, labels",
        "meta/info.json",
        ("pyarrow",),
        ("merge", "video"),
    ),
    "rlds": Format(
        "rlds:write",
        "TensorFlow Datasets (`tfds.builder_from_directory`): RLDS steps, PNG, state fields also under DMC-VB's names",
        "pixels, states, actions, rewards, discounts, ends",
        "physics, labels",
        "dataset_info.json",
    ),
}
"""Name -> format."""


STAMP = ".dmcvb-gen.json"
"""File in each export: what it was made from, so that the same command goes on where it was stopped."""


@dataclass(frozen=True)
class _Work:
    """A subset to be exported; travels to a worker."""

    path: str
    storage_options: dict | None
    to: str
    options: dict[str, Any]
    subsets: tuple[tuple[str, tuple[int, ...]], ...]
    folder: Path
    stamp: dict[str, Any]

    @property
    def done(self) -> bool:
        """Whether an earlier call wrote this very export. Raises StoreError where something else is."""
        if not self.folder.exists():
            return False
        with contextlib.suppress(OSError, ValueError):
            if parse_json((self.folder / STAMP).read_bytes()) == self.stamp:
                return True
        raise StoreError(
            f"{self.folder} is there already, and not of this release and these options; choose another --out"
        )


def export(
    path: str,
    to: str,
    out: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    merge: bool = False,
    video: bool = False,
    workers: Workers = 1,
    storage_options: dict | None = None,
    tick: ProgressCallback = ignore,
) -> list[Path]:
    """Write subsets in another format; each is there whole, or not at all. Run again, it goes on where it stopped.

    Args:
      path: a release, here or at a URL.
      to: a name out of `FORMATS`.
      out: folder of the exports; each subset gets `<out>/<task>/<level>/<setting>` (minari: see its `folder_name`).
      only: subset patterns; episodes: (first, last + 1); all by default.
      merge: lerobot: all subsets as the tasks of one data set, `out` itself.
      video: lerobot: pictures as mp4 (smaller, with losses) and not as PNG.
      workers: processes (or a Ray cluster that sees the same folders), a subset each.
      tick: told 1 for each episode.

    Returns:
      The folders.

    Raises:
      UnknownNameError: no such format or subset. DmcvbError: its package is not installed, or an option is not for
      this format. StoreError: a subset is not whole (or lacks some of `episodes`), it is damaged, there is something
      else at `out` already, or it cannot be written.
    """
    if to not in FORMATS:
        raise UnknownNameError("format", to, FORMATS)
    out = local_path(out)
    options = {name: True for name, given in (("video", video),) if given}
    for name in (*options, *["merge"] * merge):
        if name not in FORMATS[to].options:
            raise DmcvbError(f"--{name} is not for {to}; it is for {', '.join(_formats_with(name))}")
    _writer(to)  # its package is missed now, and not in a worker
    release = open_for_reading(path, storage_options)
    names = select([record.name for record in release.manifest.subsets], list(only))
    chosen = tuple((name, _episodes(release, name, episodes)) for name in names)
    folders = [Path(out).absolute()] if merge else [Path(out).absolute() / _folder_name(to)(release, n) for n in names]
    works = [
        _Work(str(path), storage_options, to, options, part, folder, _stamp(release.manifest, to, options, part))
        for part, folder in zip([chosen] if merge else [(one,) for one in chosen], folders, strict=True)
    ]
    todo = [work for work in works if not work.done]
    expect(tick, sum(len(episodes) for work in todo for _, episodes in work.subsets))
    with open_pool(workers, tick=tick, most=len(todo)) as pool:
        for work in todo:
            pool.submit(work.folder, _write, work)
        for _ in pool.results():
            pass
    return folders


def _stamp(manifest: Manifest, to: str, options: dict, subsets: Sequence[tuple[str, tuple[int, ...]]]) -> dict:
    """What an export was made from: release (the root digest, where it is finished), format, options and episodes."""
    digests = {record.name: record.digest for record in manifest.subsets}
    content = [[name, digests[name], list(episodes)] for name, episodes in subsets]
    return dict(release=manifest.name, digest=manifest.digest, format=to, options=options, subsets=content)


def _formats_with(option: str) -> list[str]:
    return [name for name, kind in FORMATS.items() if option in kind.options]


def _module(to: str):
    return importlib.import_module(f"{__name__}.{FORMATS[to].module.split(':')[0]}")


def _writer(to: str) -> Callable:
    try:
        for package in FORMATS[to].packages:
            importlib.import_module(package)
        return getattr(_module(to), FORMATS[to].module.split(":")[1])
    except ImportError as error:
        cure = f"pip install {' '.join(FORMATS[to].packages)}"
        raise DmcvbError(f"export to {to} needs a package that is not installed ({error.name}): {cure}") from None


def _folder_name(to: str) -> Callable[[ReleaseReader, str], str]:
    return getattr(_module(to), "folder_name", lambda release, name: name)


def _episodes(release: ReleaseReader, name: str, asked: tuple[int, int] | None) -> tuple[int, ...]:
    """The episodes of a subset that are exported; all that are asked for must be there."""
    record = next(record for record in release.manifest.subsets if record.name == name)
    here = set(release.subsets[name].episodes.tolist()) if name in release.subsets else set()
    first, last = asked or (0, record.episodes)
    wanted = range(max(first, 0), min(last, record.episodes))
    if not wanted:
        raise StoreError(f"{name} has none of the episodes {first}:{last}; it has {record.episodes}")
    missing = [episode for episode in wanted if episode not in here]
    if missing:
        raise StoreError(
            f"{name} has {len(wanted) - len(missing)} of {len(wanted)} episodes here, episode {missing[0]} is not; "
            "finish the rollout or fetch the rest, or name what is here with --only and --episodes"
        )
    return tuple(wanted)


def _write(work: _Work, tick: ProgressCallback = ignore) -> None:
    """Write one folder, whole or not at all."""
    release = open_for_reading(work.path, work.storage_options)
    sources = [Source(release, release[name], list(episodes), tick) for name, episodes in work.subsets]
    write, parent = _writer(work.to), work.folder.parent
    with storage_errors(work.folder, "write to"):
        parent.mkdir(parents=True, exist_ok=True)
        remove_partial(parent, below=False)
        with folder_in_the_making(parent, work.folder.name) as made:
            inside = made / work.folder.name
            inside.mkdir()
            write(sources if "merge" in FORMATS[work.to].options else sources[0], inside, **work.options)
            write_json(inside / STAMP, work.stamp)
            if not work.done:  # somebody else may have been faster
                inside.rename(work.folder)


def format_table() -> str:
    """The formats as a Markdown table: which program reads them, what they keep and what they leave out."""
    lines = ["| `--to` | read by | keeps | leaves out | needs |", "|---|---|---|---|---|"]
    for name, kind in FORMATS.items():
        needs = f"`pip install {' '.join(kind.packages)}`" if kind.packages else ""
        lines.append(f"| `{name}` | {kind.reader} | {kind.keeps} | {kind.drops} | {needs} |")
    return "\n".join(lines)
