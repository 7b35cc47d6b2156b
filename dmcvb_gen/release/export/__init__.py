"""Export a release's subsets in the formats that other programs read, one folder for each subset."""

import contextlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.manifest import canonical_json
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import folder_in_the_making, parse_json, remove_partial, sha256_bytes, write_json
from dmcvb_gen.loaders.release import ReleaseReader, SubsetReader
from dmcvb_gen.options import Local, Location, Names, Span, checked, progress_bar
from dmcvb_gen.parallel import ProgressCallback, Workers, expect, ignore, in_order
from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.release.export.registry import get_format
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import is_url, local_path, unpinned
from dmcvb_gen.text import as_names

STAMP = ".dmcvb-gen.json"
"""File in each export that says what it was made from, so that the same command can resume."""


@dataclass(frozen=True)
class _Work:
    """A subset to be exported; travels to a worker."""

    path: str
    storage_options: dict | None
    to: str
    subset: str
    episodes: tuple[int, ...]
    folder: Path
    stamp: dict[str, Any]

    @property
    def done(self) -> bool:
        """Return True if an earlier call wrote this very export; raise StoreError if something else is there."""
        if not self.folder.exists():
            return False
        with contextlib.suppress(OSError, ValueError):
            if not any(self.folder.iterdir()):
                return False
            if parse_json((self.folder / STAMP).read_bytes()) == self.stamp:
                return True
        raise StoreError(f"{self.folder} holds something else than this export of this release; choose another --out")


@checked
def export(
    release: Location,
    to: str,
    out: Local,
    only: Names = (),
    episode_range: Span | None = None,
    *,
    workers: Workers = 1,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> list[Path]:
    """Write subsets in another format, a folder for each; the folders.

    Each folder is complete or absent, and the same call resumes an interrupted one.

    Args:
      release (RELEASE|URL): Folder or URL of the release.
      to: Format, for example hdf5, minari, lerobot or rlds.
      out (FOLDER): Output folder, one folder per subset.
      only (PATTERN): Export only these subsets.
      episode_range (RANGE): Export only episodes A to B - 1.
      workers: Worker processes, one subset each.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.

    Raises:
      UnknownNameError: no such format or subset.
      DmcvbError: a package is not installed.
      StoreError: a subset is damaged or not whole (or lacks some of the range), something else lies at `out`, or it
        cannot be written.
    """
    kind, folder, path = get_format(to), Path(local_path(out)).absolute(), str(release)
    kind.check_installed()  # here, and not first in a worker
    source = ReleaseReader.open(path, storage_options)
    if not is_url(path) and Path(unpinned(path)).resolve() in (folder.resolve(), *folder.resolve().parents):
        raise StoreError(f"--out {folder} lies in the release itself; give another folder")
    asked = as_names(only)
    unions = [name for name in asked if source.parts_of(name)]
    others = [name for name in asked if name not in unions]
    names = [*(source.select(others) if others or not unions else ()), *unions]
    works = []
    for name in names:
        episodes = _episodes(source[name], episode_range)
        stamp = _stamp(source[name], to, episodes)
        works.append(_Work(path, storage_options, to, name, episodes, folder / kind.folder_name(name), stamp))
    todo = [work for work in works if not work.done]
    with progress_bar(progress, " episodes", scaled=False) as bar:
        expect(bar, sum(len(work.episodes) for work in todo))
        in_order(_write, todo, workers, bar)
    return [work.folder for work in works]


def _stamp(subset: SubsetReader, to: str, episodes: tuple[int, ...]) -> dict[str, Any]:
    """What an export was made from: release, format, and the records of the shards that it reads."""
    shards = subset.shards((episodes[0], episodes[-1] + 1))
    if to != "zarr":  # others have no images of other sizes, which may be added later
        shards = (shard for shard in shards if not all(re.match(r"at\d+/", spec.name) for spec in shard.layer.arrays))
    digest = sha256_bytes(b"".join(canonical_json(shard.record) for shard in shards))
    return dict(release=subset.release.manifest.name, format=to, subsets=[[subset.name, digest, list(episodes)]])


def _episodes(subset: SubsetReader, asked: tuple[int, int] | None) -> tuple[int, ...]:
    """The episodes of a subset that are exported; all that are asked for must be there."""
    name, count, here = subset.name, subset.record.episodes, set(subset.episodes.tolist())
    first, last = asked or (0, count)
    wanted = range(max(first, 0), min(last, count))
    if not wanted:
        raise StoreError(f"{name} has none of the episodes {first}:{last}; it has {count}")
    missing = [episode for episode in wanted if episode not in here]
    if missing:
        raise StoreError(
            f"{name} has {len(wanted) - len(missing)} of {len(wanted)} episodes and lacks episode {missing[0]}; finish "
            "the rollout, fetch the rest, or select existing ones with --only and --range"
        )
    return tuple(wanted)


def _write(work: _Work, tick: ProgressCallback = ignore) -> None:
    """Write one folder, whole or not at all."""
    release = ReleaseReader.open(work.path, work.storage_options)
    digest = sha256_bytes(canonical_json(work.stamp))
    source = Source(release, release[work.subset], list(work.episodes), tick, digest)
    kind, parent = get_format(work.to), work.folder.parent
    with storage_errors(work.folder, "write to"):
        parent.mkdir(parents=True, exist_ok=True)
        remove_partial(parent)
        with folder_in_the_making(parent, work.folder.name) as made:
            inside = made / work.folder.name
            inside.mkdir()
            kind.write(source, inside)
            write_json(inside / STAMP, work.stamp)
            if not work.done:  # another process may have been faster
                inside.rename(work.folder)
