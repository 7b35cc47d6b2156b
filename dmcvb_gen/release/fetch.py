"""Download a release, or the shards of it that hold some episodes; another call resumes or adds.

Inputs and recipes come first, then each shard with its record last, the lists, the manifest. A record that is here says
that the files of its shard are, so nothing is read twice. A part of a release is a copy: copy.json says of what.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmcvb_gen.dataset.gate import Release, Shard
from dmcvb_gen.dataset.manifest import COPY, MANIFEST, RECIPES, FileRecord, Manifest
from dmcvb_gen.dataset.writer import finish_copy, wrong_bytes
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.loaders.release import ReleaseReader, open_for_reading
from dmcvb_gen.options import Count, GoalPictures, Local, Names, Span, checked, progress_bar
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.release.tree import (
    attachments,
    described_files,
    grows_from,
    list_files,
    manifest_text,
    shard_files,
)
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import local_path, shown
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.text import as_names, format_bytes, quoted

if TYPE_CHECKING:
    from dmcvb_gen.generate.paint import RenderResult


@dataclass(frozen=True)
class Moved:
    """Result of a publish or fetch: files and bytes of the release's part, and how many files were moved now."""

    files: int
    bytes: int
    moved: int


@checked
def fetch(
    url: str,
    out: Local,
    only: Names = (),
    episode_range: Span | None = None,
    *,
    paint: bool = False,
    size: Count | None = None,
    views: Names | None = None,
    goal: GoalPictures | None = None,
    storage_options: dict[str, Any] | None = None,
    workers: Count = 8,
    progress: bool = True,
) -> ReleaseReader:
    """Download a published release, or a part of it, and open it.

    Args:
      url (URL): Where it was published, or "<URL>@sha256:<digest>".
      out (FOLDER): Local folder for the release.
      only (PATTERN): Fetch only these subsets.
      episode_range (RANGE): Use only the shards with episodes A to B - 1.
      paint: Then render the images.
      size: Width and height in pixels. [default: the manifest's]
      views (A,B): Mazes: render only these views, e.g. egocentric. [default: all]
      goal: Mazes: render only images with, or without, the goal. [default: both]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      workers: Parallel transfers.

    Raises:
      StoreError: no release is there, or it is `out` itself; a file is not what its digest says; `out` holds something
        else; there is no room; access is refused.
    """
    download(locals())
    return open_for_reading(str(out))


def download(given: Mapping[str, Any], notify: Callable[[str], None] = ignore) -> tuple[Moved, "RenderResult | None"]:
    """Do what the arguments of `fetch` ask for: what was moved and, with `paint`, what was rendered."""
    look = {name: given[name] for name in ("size", "views", "goal")}
    if not given["paint"] and any(look.values()):
        raise DmcvbError("--size, --views and --goal have no effect without --paint: add it (in Python, paint=True)")
    only, episodes = as_names(given["only"]), given["episode_range"]
    with progress_bar(given["progress"], "B") as bar:
        source = Release.open(given["url"], given["storage_options"])
        moved = _fetch(source, given["url"], local_path(given["out"]), only, episodes, given["workers"], bar)
    if not given["paint"]:
        return moved, None
    from dmcvb_gen.making import paint  # here, as it needs a simulator

    chosen = dict(only=only, episode_range=episodes, progress=given["progress"])
    return moved, paint(given["out"], **chosen, **look, notify=notify)


def _fetch(
    source: Release,
    url: str,
    folder: Path,
    only: Sequence[str],
    episodes: tuple[int, int] | None,
    workers: int,
    tick: ProgressCallback,
) -> Moved:
    if source.in_the_making:
        raise StoreError(f"{source.place} is not finished; finish it first: dmcvb-gen rollout --out {source.place}")
    if source.store.folder and source.store.folder.resolve() == folder.resolve():
        raise StoreError(
            f"{folder} is the release itself; choose another --out, or render its images: "
            f"dmcvb-gen paint {quoted(folder)}"
        )
    target = open_store(folder)
    names = source.select(only)
    grown = _check_target(target, source)
    shards = [shard for shard in source.shards(names, episodes) if shard.here]
    if not shards:
        raise StoreError(f"{source.place} has none of these episodes; it has others, see `dmcvb-gen info`")
    layers = {name: None for record in source.manifest.subsets if record.name in names for name in record.layers}
    download = _Download(source, target, folder, workers, tick)
    first, last = described_files(source, names), list_files(source, layers)
    files = [*first, *(file for shard in shards for file in shard_files(shard)), *last]
    download.check_room(files)
    expect(tick, sum(file.bytes for file in files))
    text = manifest_text(source)
    download.bring(first)
    download.bring_shards(shards)
    download.bring(last)
    for path, data in attachments(source.store).items():
        if grown or target.size(path) is None:
            target.replace(path, data)
    _finish(source, target, text, shown(url), shards)
    return Moved(len(files), sum(file.bytes for file in files), download.moved)


def _check_target(target: Store, source: Release) -> bool:
    """Return True if a folder holds an older release that the source has grown from.

    Raises:
      StoreError: it holds something else than the source or a part of it.
    """
    copy = Release.read_copy(target)
    if copy is not None and copy.manifest == source.digest:
        return False
    if target.size(MANIFEST) is not None:
        old = Release.open(target)
        if old.digest == source.digest:
            return False
        if grows_from(source, old):
            return True
        raise StoreError(
            f"{target.place} holds {_named(old)} and not the {_named(source)} of the URL; choose another --out"
        )
    there = target.list()
    recipes = {f"{RECIPES}{recipe.sha256}.json" for recipe in source.recipes}
    inputs = {file.path for file in source.manifest.inputs}  # they come first
    if there and not recipes & {*there} and {*there} - inputs:
        raise StoreError(f"{target.place} is not empty and holds no release; choose an empty destination for --out")
    if strange := {path for path in there if path.startswith(RECIPES)} - recipes:
        raise StoreError(f"{target.place} holds another release ({min(strange)}); choose another --out")
    return False


def _named(release: Release) -> str:
    return f"{release.manifest.name} {release.manifest.version} ({str(release.digest)[:12]})"


def _finish(source: Release, target: Store, text: bytes, url: str, shards: Sequence[Shard]) -> None:
    """Write the manifest; copy.json says what is promised, unless everything is here."""
    promised: dict[str, list[int]] = {}
    for shard in shards:
        promised.setdefault(shard.layer.name, []).append(shard.number)
    release = finish_copy(target, text, url, promised)
    if isinstance(release.manifest, Manifest) and all(
        len(release.here(layer.name)) == layer.shards for layer in release.manifest.layers
    ):
        target.delete(COPY)


class _Download:
    """Files of a release on their way to a folder.

    Attributes:
      moved: how many files came.
    """

    def __init__(self, source: Release, target: Store, folder: Path, workers: int, tick: ProgressCallback):
        self._source, self._target, self._workers, self._tick = source.store, target, workers, tick
        self._folder, self.moved = folder, 0

    def check_room(self, files: Sequence[FileRecord]) -> None:
        """Raises StoreError if the files that are not here do not fit."""
        with storage_errors(self._folder, "write to"):
            self._folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(self._folder).free
        needed = sum(file.bytes for file in files if not (self._folder / file.path).exists())
        if needed > free:
            raise StoreError(
                f"{format_bytes(needed)} are needed and {format_bytes(free)} are free at {self._folder}; make room, "
                "choose another --out, or fetch less with --only and --range"
            )

    def bring_shards(self, shards: Sequence[Shard]) -> None:
        """Bring the files of shards, then their records. A record that is here says that the files are."""
        absent = []
        for shard in shards:
            if self._target.size(shard.record_path) is None:
                absent.append(shard)
            else:
                self._tick(sum(file.bytes for file in shard_files(shard)))
        for first in range(0, len(absent), self._workers):
            few = absent[first : first + self._workers]
            self.bring([file for shard in few for file in shard.files])
            self.bring([shard_files(shard)[-1] for shard in few])

    def bring(self, files: Sequence[FileRecord]) -> None:
        """Bring files that are not here as they are recorded, some at a time."""
        with ThreadPoolExecutor(max(1, self._workers)) as pool:
            waiting = [pool.submit(self._bring_one, file) for file in files]
            try:
                self.moved += sum(future.result() for future in waiting)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def _bring_one(self, file: FileRecord) -> bool:
        wrong = wrong_bytes(self._target, file)
        if wrong:
            if wrong != "is missing":
                self._target.delete(file.path)
            self._source.download(file.path, self._folder / file.path, file.bytes, file.sha256)
        self._tick(file.bytes)
        return wrong is not None
