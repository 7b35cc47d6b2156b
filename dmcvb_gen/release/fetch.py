"""Download a release, or the shards of it that hold some episodes; another call resumes or adds.

Inputs and recipes come first, then each shard with its record last, the lists, the manifest. A record that is here says
that the files of its shard are, so nothing is read twice. A part of a release is a copy: copy.json says of what.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmcvb_gen.dataset.gate import Release, Shard
from dmcvb_gen.dataset.manifest import FileRecord
from dmcvb_gen.dataset.writer import finish_copy, wrong_bytes
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import free_bytes
from dmcvb_gen.loaders.release import ReleaseReader, open_for_reading
from dmcvb_gen.options import Count, Local, Names, Span, checked, progress_bar
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.release.tree import attachments, described_files, list_files, manifest_text, release_at
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
      paint: Then render the images, as `paint` does.
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
    only, episodes = as_names(given["only"]), given["episode_range"]
    with progress_bar(given["progress"], "B") as bar:
        out, source = local_path(given["out"]), Release.open(given["url"], given["storage_options"])
        moved = _fetch(source, given["url"], out, only, episodes, given["workers"], bar)
    if not given["paint"]:
        return moved, None
    from dmcvb_gen.making import paint  # here, as it needs a simulator

    chosen = dict(only=only, episode_range=episodes, progress=given["progress"])
    return moved, paint(given["out"], **chosen, notify=notify)


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
    target, names = open_store(folder), source.select(only)
    there = release_at(target, source)
    shards = [shard for shard in source.shards(names, episodes) if shard.here]
    if not shards:
        raise StoreError(f"{source.place} has none of these episodes; it has others, see `dmcvb-gen info`")
    layers = {name: None for record in source.manifest.subsets if record.name in names for name in record.layers}
    download = _Download(source, target, folder, workers, tick)
    first, last = described_files(source, names), list_files(source, layers)
    files = [*first, *(file for shard in shards for file in (*shard.files, shard.record_file)), *last]
    download.check_room(files)
    expect(tick, sum(file.bytes for file in files))
    text = manifest_text(source)
    download.bring(first)
    download.bring_shards(shards)
    download.bring(last)
    grown = there is not None and there.digest != source.digest
    for path, data in attachments(source.store).items():
        if grown or target.size(path) is None:
            target.replace(path, data)
    finish_copy(target, text, shown(url), shards)
    return Moved(len(files), sum(file.bytes for file in files), download.moved)


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
            free = free_bytes(self._folder)
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
                self._tick(sum(file.bytes for file in (*shard.files, shard.record_file)))
        for first in range(0, len(absent), self._workers):
            few = absent[first : first + self._workers]
            self.bring([file for shard in few for file in shard.files])
            self.bring([shard.record_file for shard in few])

    def bring(self, files: Sequence[FileRecord]) -> None:
        """Bring files that are not here as they are recorded, some at a time."""
        with ThreadPoolExecutor(max(1, self._workers)) as pool:
            self.moved += sum(pool.map(self._bring_one, files))

    def _bring_one(self, file: FileRecord) -> bool:
        wrong = wrong_bytes(self._target, file)
        if wrong:
            if wrong != "is missing":
                self._target.delete(file.path)
            self._source.download(file.path, self._folder / file.path, file.bytes, file.sha256)
        self._tick(file.bytes)
        return wrong is not None
