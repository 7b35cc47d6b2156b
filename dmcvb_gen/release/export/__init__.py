"""Export a release's subsets in the formats that other programs read, one folder for each subset."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.manifest import canonical_json
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import folder_in_the_making, parse_json, remove_partial, sha256_bytes, write_json
from dmcvb_gen.loaders.release import ReleaseReader, SubsetReader, open_for_reading
from dmcvb_gen.parallel import ProgressCallback, Workers, expect, ignore, open_pool
from dmcvb_gen.release.export.episodes import Source
from dmcvb_gen.release.export.registry import all_formats, get_format
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import is_url, local_path

STAMP = ".dmcvb-gen.json"
"""File in each export that says what it was made from, so that the same command can resume."""


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
        """Return True if an earlier call wrote this very export; raise StoreError if something else is there."""
        if not self.folder.exists():
            return False
        with contextlib.suppress(OSError, ValueError):
            if not any(self.folder.iterdir()):
                return False
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
    """Write subsets in another format. Each is complete or absent, and the same call resumes an interrupted one.

    Args:
      path: a release, here or at a URL.
      to: name of a format, see `all_formats`.
      out: folder of the exports; each subset gets `<out>/<task>/<level>/<setting>` (minari has its own tree).
      only: subset patterns; episodes: (first, last + 1), as far as a subset has so many; all by default.
      merge: lerobot: all subsets as the tasks of one data set, `out` itself.
      video: lerobot: pictures as mp4 (smaller, with losses) and not as PNG.
      workers: processes (or a Ray cluster that sees the same folders), a subset each.
      tick: called with 1 for each episode.

    Returns:
      The folders.

    Raises:
      UnknownNameError: no such format or subset.
      DmcvbError: a package is not installed, or an option is not for this format.
      StoreError: a subset is damaged or not whole (or lacks some of `episodes`), something else lies at `out`, or it
        cannot be written.
    """
    kind, out = get_format(to), Path(local_path(out)).absolute()
    options = {name: True for name, given in (("video", video),) if given}
    for name in (*options, *["merge"] * merge):
        if name not in kind.options:
            raise DmcvbError(f"--{name} is not for {to}; it is for {', '.join(_formats_with(name))}")
    kind.check_installed()  # here, and not first in a worker
    release = open_for_reading(path, storage_options)
    if not is_url(str(path)) and Path(path).resolve() in (out.resolve(), *out.resolve().parents):
        raise StoreError(f"--out {out} lies in the release itself; give another folder")
    unions = [name for name in only if release.parts_of(name)]
    others = [name for name in only if name not in unions]
    names = [*(release.select(others) if others or not unions else ()), *unions]
    chosen = tuple((name, _episodes(release[name], episodes)) for name in names)
    folders = [out] if merge else [out / kind.folder_name(release, name) for name in names]
    works = [
        _Work(str(path), storage_options, to, options, part, folder, _stamp(release, to, options, part))
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


def _stamp(release: ReleaseReader, to: str, options: dict, subsets: Sequence[tuple[str, tuple[int, ...]]]) -> dict:
    """What an export was made from: release, format, options, and the records of the shards that it reads."""
    content = []
    for name, episodes in subsets:
        shards = release[name].shards((episodes[0], episodes[-1] + 1))
        digest = sha256_bytes(b"".join(canonical_json(shard.record) for shard in shards))
        content.append([name, digest, list(episodes)])
    return dict(release=release.manifest.name, format=to, options=options, subsets=content)


def _formats_with(option: str) -> list[str]:
    return [name for name, kind in all_formats().items() if option in kind.options]


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
            f"{name} has {len(wanted) - len(missing)} of {len(wanted)} episodes here, episode {missing[0]} is not; "
            "finish the rollout or fetch the rest, or name what is here with --only and --range"
        )
    return tuple(wanted)


def _write(work: _Work, tick: ProgressCallback = ignore) -> None:
    """Write one folder, whole or not at all."""
    release = open_for_reading(work.path, work.storage_options)
    sources = [Source(release, release[name], list(episodes), tick) for name, episodes in work.subsets]
    kind, parent = get_format(work.to), work.folder.parent
    with storage_errors(work.folder, "write to"):
        parent.mkdir(parents=True, exist_ok=True)
        remove_partial(parent)
        with folder_in_the_making(parent, work.folder.name) as made:
            inside = made / work.folder.name
            inside.mkdir()
            kind.write(sources if "merge" in kind.options else sources[0], inside, **work.options)
            write_json(inside / STAMP, work.stamp)
            if not work.done:  # somebody else may have been faster
                inside.rename(work.folder)
