"""Download a release, or the shards of it that hold some episodes; another call resumes or adds.

Inputs and recipes come first, then each shard with its record last, the lists, the manifest. Of a shard that is here,
sizes alone are compared, so nothing is read twice. A part of a release is a copy: copy.json says of what.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmcvb_gen.dataset.gate import Release, Shard, recorded_shards
from dmcvb_gen.dataset.manifest import COPY, MANIFEST, FileRecord, ListedLayer, canonical_json, list_path
from dmcvb_gen.dataset.writer import finish_copy, wrong_bytes
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import free_bytes
from dmcvb_gen.options import Count, Local, Names, Span, checked, progress_bar
from dmcvb_gen.parallel import ProgressCallback, expect
from dmcvb_gen.release.tree import attachments, check_apart, described_files, list_files, manifest_at
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import local_path, shown
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.text import as_names, format_bytes, quoted

if TYPE_CHECKING:
    from dmcvb_gen.generate.paint import RenderResult
    from dmcvb_gen.loaders.release import ReleaseReader


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
    repair: bool = False,
    storage_options: dict[str, Any] | None = None,
    workers: Count = 8,
    progress: bool = True,
) -> "ReleaseReader":
    """Download a published release, or a part of it, and open it.

    Args:
      url (URL): Where it was published, or "<URL>@sha256:<digest>".
      out (FOLDER): Local folder for the release.
      only (PATTERN): Fetch only these subsets.
      episode_range (RANGE): Use only the shards with episodes A to B - 1.
      paint: Then render the images, as `paint` does.
      repair: Compare the files that are here by their digests, and replace those that differ.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      workers: Parallel transfers.

    Raises:
      StoreError: no release is there, or it is `out` itself; a file is not what its digest says; `out` holds something
        else; there is no room; access is refused.
    """
    download(locals())
    from dmcvb_gen.loaders.release import ReleaseReader  # Zarr, which the command does without

    return ReleaseReader.open(str(out))


def download(given: Mapping[str, Any]) -> tuple[Moved, "RenderResult | None"]:
    """Do what the arguments of `fetch` ask for: what was moved and, with `paint`, what was rendered."""
    only, episodes, folder = as_names(given["only"]), given["episode_range"], local_path(given["out"])
    with progress_bar(given["progress"], "B") as bar:
        source = Release.open(given["url"], given["storage_options"], own_images=False)
        download = _Download(source, folder, given["repair"], given["workers"], bar)
        moved = _fetch(source, given["url"], download, only, episodes)
    if not given["paint"]:
        return moved, None
    from dmcvb_gen.making import paint  # here, as it needs a simulator

    chosen = dict(only=only, episode_range=episodes, progress=given["progress"])
    return moved, paint(given["out"], **chosen)


def _fetch(
    source: Release, url: str, download: "_Download", only: Sequence[str], episodes: tuple[int, int] | None
) -> Moved:
    target, names = download.target, source.select(only)
    if source.in_the_making:
        raise StoreError(
            f"{source.place} is not finished; finish it first: dmcvb-gen rollout --out {quoted(source.place)}"
        )
    check_apart(source, target, f"choose another --out, or render its images: dmcvb-gen paint {quoted(source.place)}")
    there, text, was_part = manifest_at(target, source), source.text, target.size(COPY) is not None
    shards = [shard for shard in source.shards(names, episodes) if shard.here]
    if not shards:
        raise StoreError(f"{source.place} has none of these episodes; it has others, see `dmcvb-gen info`")
    layers = {name for record in source.manifest.subsets if record.name in names for name in record.layers}
    kept = list(_kept(source, target))
    first, last = described_files(source, names), list_files(source, layers | {shard.layer.name for shard in kept})
    files = [*first, *(file for shard in shards for file in (*shard.files, shard.record_file)), *last]
    download.begin(files)
    download.bring(first)
    download.bring_shards(shards)
    download.bring(last)
    for path, data in attachments(source.store) if source.manifest_path == MANIFEST else ():  # they are of the newest
        newer = there not in (None, text) or (was_part and download.moved)  # a part's card is of that part
        if download.repair or newer or target.size(path) is None:
            target.replace(path, data)
    finish_copy(target, text, shown(url), [*shards, *kept])
    return Moved(len(files), sum(file.bytes for file in files), download.moved)


def _kept(source: Release, target: Store) -> Iterator[Shard]:
    """The shards of a release that a folder has already; after a growth they are read by the lists of the new one."""
    for layer in source.manifest.layers:
        if numbers := recorded_shards(target, layer.name):
            shards = source.layer_shards(layer.name)
            if not shards and isinstance(layer, ListedLayer) and target.size(list_path(layer.list)) is None:
                source.records(layer.name)  # says what the source lacks
            yield from (shard for shard in shards if shard.number in numbers)


class _Download:
    """Files of a release on their way to a folder.

    Attributes:
      target: the folder's files.
      repair: whether files that are here are compared by their digests.
      moved: how many files came.
    """

    def __init__(self, source: Release, folder: Path, repair: bool, workers: int, tick: ProgressCallback):
        self._source, self._folder, self._workers, self._tick = source.store, folder, workers, tick
        self.target, self.repair, self.moved = open_store(folder), repair, 0

    def begin(self, files: Sequence[FileRecord]) -> None:
        """Raises StoreError if the files that are not here do not fit."""
        expect(self._tick, sum(file.bytes for file in files))
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
            files = (*shard.files, shard.record_file)
            if self.repair or any(self.target.size(file.path) != file.bytes for file in files):
                absent.append(shard)
            else:
                self._tick(sum(file.bytes for file in files))
        for first in range(0, len(absent), self._workers):
            few = absent[first : first + self._workers]
            self.bring([file for shard in few for file in shard.files])
            for shard in few:  # their records come after their files, and the lists say what is in them
                if wrong_bytes(self.target, shard.record_file):
                    self.target.replace(shard.record_path, canonical_json(shard.record))
                    self.moved += 1
                self._tick(shard.record_file.bytes)

    def bring(self, files: Sequence[FileRecord]) -> None:
        """Bring files that are not here as they are recorded, some at a time."""
        with ThreadPoolExecutor(max(1, self._workers)) as pool:
            self.moved += sum(pool.map(self._bring_one, files))

    def _bring_one(self, file: FileRecord) -> bool:
        wrong = wrong_bytes(self.target, file)
        if wrong:
            if wrong != "is missing":
                self.target.delete(file.path)
            self._source.download(file.path, self._folder / file.path, file.bytes, file.sha256)
        self._tick(file.bytes)
        return wrong is not None
