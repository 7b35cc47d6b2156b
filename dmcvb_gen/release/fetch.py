"""Download a published release, or the shards that hold some episodes; another call resumes or adds.

Shards come one after the other, each with its commit record last, so what is here at any moment is a release: a part of
one, which says so in its lineage, until everything is here. What was painted here stays painted. With a painter, a
shard is painted while the next ones come.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import queue
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.append import is_grown_from
from dmcvb_gen.dataset.index import (
    CARD_FILES,
    CARD_FOLDER,
    INDEX,
    Index,
    is_card,
    keeps,
    parse_index,
    read_index,
    write_release,
)
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    local_manifest,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.dataset.shards import ShardKey, chosen_shards
from dmcvb_gen.dataset.sharing import equal_files, link_equal_files, link_known
from dmcvb_gen.dataset.writer import LOCK, finish_release, mark_created, read_commits, write_lock
from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.storage import Storage, open_storage
from dmcvb_gen.storage.base import in_parallel, unfinished
from dmcvb_gen.storage.remote import local_path, storage_errors
from dmcvb_gen.text import format_bytes, quoted


@dataclass(frozen=True)
class Moved:
    """Result of a publish or fetch: files and bytes of the release's part, and how many files were moved now."""

    files: int
    bytes: int
    moved: int


def fetch(
    url: str,
    out: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    tick: ProgressCallback = ignore,
) -> Moved:
    """Download a published release, or the shards of it that hold some episodes; another call resumes or adds.

    Args:
      out: its folder here.
      only, episodes: subset patterns and (first, last + 1); all by default.
      options: options of fsspec.
      tick: called with the bytes of each file.

    Raises:
      StoreError: no release is there, or it is `out` itself; a file has other bytes than its digest says; `out` holds
        something else; there is no room; access is refused.
    """
    folder, source = local_path(out), Source.find(url, options)
    with Download.at(folder, source, only, episodes, workers, tick) as download:
        moved = download.bring()
        download.finish()
    return moved


def fetch_and_paint(
    url: str,
    out: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    painter: Any,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    tick: ProgressCallback = ignore,
) -> tuple[Moved, Any]:
    """`fetch`, and render the images that are not stored; a shard is rendered while the next ones come.

    Args:
      painter: a `generate.paint.RenderConfig`.

    Returns:
      What was moved, and a `generate.paint.RenderResult`.

    Raises:
      DmcvbError: as `fetch` and `generate.paint.paint_release` do; what has come and was painted stays.
    """
    from dmcvb_gen.generate.paint import RenderSession  # who only fetches has no simulator

    folder, source = local_path(out), Source.find(url, options)
    with Download.at(folder, source, only, episodes, workers, tick, with_pictures=True) as download:
        names, painted = {name for name, _ in download.shards}, download.painted
        session = RenderSession.open(open_release(folder), names, painter, download.unpainted, painted)
        session.expect(download.unpainted_commits)
        arrived: queue.SimpleQueue = queue.SimpleQueue()
        thread = threading.Thread(target=_bring, args=(download, arrived), name="fetch")
        thread.start()
        try:
            found = list(session.paint(arrived))
        finally:
            download.stop.set()
            thread.join()
        manifest = download.finish()
    return download.moved, session.report(manifest, found)


def _bring(download: Download, arrived: queue.SimpleQueue) -> None:
    """Tell of each shard that has come without pictures, then of the end, or of what went wrong."""
    try:
        download.bring(arrived.put)
        arrived.put(None)
    except BaseException as error:
        arrived.put(error)


@dataclass(frozen=True)
class Source:
    """A published release: where it lies, and what it says of itself."""

    storage: Storage
    manifest_text: bytes
    index_text: bytes
    manifest: Manifest
    index: Index

    @classmethod
    def find(cls, url: str, options: dict[str, Any] | None) -> Source:
        """Read manifest and index at a URL.

        Raises:
          StoreError: no release is there, or its manifest and index do not belong together.
        """
        storage = open_storage(url, options)
        place, text = storage.place, storage.read(MANIFEST)
        if text is None:
            raise StoreError(f"{place} holds no release (no {MANIFEST}); check the URL, or it is still being published")
        manifest = parse_manifest(text, f"{place}/{MANIFEST}")
        listing = storage.read(INDEX)
        if listing is None and not manifest.complete:
            raise StoreError(f"{place} is not finished; finish it first: dmcvb-gen rollout --out {place} --finish")
        if listing is None:
            raise StoreError(
                f"{place} has no {INDEX}; it was not put there by `dmcvb-gen publish`, copy the folder whole"
            )
        index = parse_index(listing, f"{place}/{INDEX}")
        if index.manifest_sha256 != files.sha256_bytes(text):
            raise StoreError(f"{place}: {MANIFEST} does not have the digest that {INDEX} says; publish it again")
        return cls(storage, text, listing, manifest, index)

    @property
    def place(self) -> str:
        """Its folder or URL, for messages."""
        return self.storage.place

    @property
    def public_name(self) -> str:
        """Return the public name of a release's source: the URL; for a local folder only its last part."""
        return f"{self.manifest.name} {self.manifest.version}" if self.storage.folder else self.place

    @functools.cached_property
    def _by_path(self) -> dict[str, FileRecord]:
        return {file.path: file for file in self.index.files}

    def listed(self, path: str) -> FileRecord:
        """Return the index's entry of a file."""
        if path not in self._by_path:
            cure = "publish the release again"
            if not self.manifest.complete and self.storage.size(path) is not None:  # it came after the index
                cure = f"list it first: dmcvb-gen rollout --out {self.place} --finish"
            elif not self.manifest.complete:
                cure = "finish the rollout there, or fetch what is there with --only and --episodes"
            raise StoreError(f"{self.place}/{INDEX} does not list {path}; {cure}")
        return self._by_path[path]

    def metadata(self, records: Iterable[SubsetRecord]) -> list[FileRecord]:
        """Zarr metadata and policies of subsets, and the card: what comes whole with any part of the release.

        Zarr finds the arrays in one consolidated file and beside them, so all metadata of a subset comes.
        """
        records = list({record.name: record for record in records}.values())
        folders = tuple(f"{subset_path(record.name)}/" for record in records)
        policies = {policy.path for record in records for policy in record.policies}
        videos = tuple(f"{(record.backgrounds or {}).get('source')}/" for record in records)
        return [
            file
            for file in self.index.files
            if (file.path.startswith(folders) and file.path.endswith("/zarr.json"))
            or file.path in policies
            or file.path.startswith(videos)
            or is_card(file.path)
        ]


class Download:
    """Shards of a published release on their way to a folder.

    Attributes:
      out: the folder, which is locked.
      shards: shards that are asked for.
      commits: (bytes, record) of each shard, as published.
      moved: shards that were asked for and moved, once they are here.
      stop: set to have no more files asked for.
    """

    def __init__(
        self, out: Path, source: Source, shards: dict[ShardKey, SubsetRecord], workers: int, tick: ProgressCallback
    ):
        self.out, self.source, self.shards, self._workers, self._tick = out, source, shards, workers, tick
        self.stop, self.moved = threading.Event(), Moved(0, 0, 0)
        listed = [source.listed(commit_path(*key)) for key in shards]
        self.local = taken_up(out, source)
        self.commits = _fetch_commits(source, listed, shards, workers)
        self._metadata = source.metadata(shards.values())
        self._kept: dict[ShardKey, CommitRecord] = {}
        self._equal = {
            file.path: [other.path for other in equal if other is not file]
            for equal in equal_files(source.manifest, _by_subset(self.commits))
            for file in equal
        }

    @classmethod
    @contextlib.contextmanager
    def at(
        cls,
        out: Path,
        source: Source,
        only: Sequence[str],
        episodes: tuple[int, int] | None,
        workers: int,
        tick: ProgressCallback,
        with_pictures: bool = False,
    ) -> Iterator[Download]:
        """A download whose folder is locked and has the metadata and a manifest that says that it is a part.

        Args:
          with_pictures: room will be needed for pictures, too.

        Raises:
          StoreError: see `fetch`.
        """
        _refuse_itself(out, source)
        shards = chosen_shards(source.manifest, only, episodes)
        download = cls(out, source, shards, workers, tick)
        with storage_errors(out, "write to"):
            out.mkdir(parents=True, exist_ok=True)
            with write_lock(out):
                download.local = taken_up(out, source)  # again: another process may have painted here meanwhile
                download._keep_painted()
                download._check_room(with_pictures)
                coming = [file for _, commit in download.commits.values() for file in commit.files]
                expect(tick, sum(file.bytes for file in [*coming, *download._metadata]))
                download._download([(None, file) for file in download._metadata], lambda key: None)
                _write_part(out, source, download._base(), only, episodes)
                yield download

    @property
    def unpainted(self) -> set[str]:
        """Subsets of which shards come without pictures."""
        return {commit.subset for commit in self.unpainted_commits}

    @property
    def unpainted_commits(self) -> list[CommitRecord]:
        """Return the commit records of the shards that come without pictures."""
        return [commit for key, (_, commit) in self.commits.items() if not commit.painted and key not in self._kept]

    @property
    def painted(self) -> set[str]:
        """Subsets of which shards have pictures, here or there."""
        return {key[0] for key, (_, commit) in self.commits.items() if commit.painted or key in self._kept}

    def _keep_painted(self) -> None:
        """Find the subsets that were painted here; their metadata and the records of painted shards stay."""
        records = {record.name: record for record in self.source.manifest.subsets}
        local = self.local.subsets if self.local else ()
        here = {r.name: r for r in local if r.pixels and _bare(r) != _bare(records[r.name])}
        folders = tuple(f"{subset_path(name)}/" for name in here)
        self._metadata = [
            file for file in self._metadata if not (file.path.startswith(folders) and file.path.endswith("/zarr.json"))
        ]
        for name, record in here.items():
            for shard, commit in read_commits(self.out, record).items():
                published = self.commits.get((name, shard))
                if published and commit.painted and set(published[1].files) <= set(commit.files):
                    self._kept[name, shard] = commit

    def _base(self) -> Manifest:
        """The manifest that is here; subsets without pictures, of which some come with them now, are the source's."""
        if self.local is None:
            return self.source.manifest
        coming = {record.name: record for record in self.shards.values()}
        subsets = [coming.get(r.name, r) if not r.pixels else r for r in self.local.subsets]
        return self.local.model_copy(update={"subsets": tuple(subsets)})

    def _check_room(self, with_pictures: bool) -> None:
        wanted = [file for _, commit in self.commits.values() for file in commit.files] + self._metadata
        if with_pictures:
            wanted += [f for key, (_, c) in self.commits.items() if key not in self._kept for f in c.pictures]
        needed = self._new_bytes(wanted)
        free = shutil.disk_usage(self.out).free
        if needed > free:
            raise StoreError(
                f"{format_bytes(needed)} are needed and {format_bytes(free)} are free at {self.out}; make "
                "room, choose another --out, or fetch less with --only and --episodes"
            )

    def _new_bytes(self, wanted: Iterable[FileRecord]) -> int:
        """Bytes that files will take here. Equal files become links to one file, so one of them counts."""
        counted: set[str] = set()
        needed = 0
        for file in wanted:
            names = {file.path, *self._equal.get(file.path, ())}
            if not (names & counted or any((self.out / name).exists() for name in names)):
                needed += file.bytes
            counted.add(file.path)
        return needed

    def bring(self, arrived: Callable[[ShardKey], None] = lambda key: None) -> Moved:
        """Bring the shards, in their order; each is there once its commit record is, and that is after its files.

        Args:
          arrived: called with each shard that is here and has no pictures.

        Raises:
          StoreError: see `fetch`.
        """
        self._download([(key, file) for key in self.shards for file in self.commits[key][1].files], arrived)
        self.source.storage.tidy(self.out)
        return self.moved

    def _download(self, items: Sequence[tuple[ShardKey | None, FileRecord]], arrived) -> None:
        left = collections.Counter(key for key, _ in items)

        def work(item: tuple[ShardKey | None, FileRecord]) -> tuple[ShardKey | None, bool, int]:
            key, file = item
            if self.stop.is_set():
                raise StoreError("Interrupted. Transferred files are kept, rerun the same command")
            if link_known(self.out, file, self._equal.get(file.path, ())):
                unfinished(self.out / file.path).unlink(missing_ok=True)
                return key, True, file.bytes
            return key, self.source.storage.download(file, self.out), file.bytes

        def done(result: tuple[ShardKey | None, bool, int]) -> None:
            key, moved, size = result
            self.moved = Moved(self.moved.files + 1, self.moved.bytes + size, self.moved.moved + moved)
            self._tick(size)
            left[key] -= 1
            if key is None or left[key] or key in self._kept:
                return
            text, commit = self.commits[key]
            files.write_bytes(self.out / commit_path(*key), text)
            if not commit.painted:
                arrived(key)

        in_parallel(work, items, self._workers, done)

    def finish(self) -> Manifest:
        """The release's own manifest and index if everything is here, as it was published; else digests."""
        out, source = self.out, self.source
        manifest = local_manifest(out)
        commits = {record.name: read_commits(out, record) for record in source.manifest.subsets}
        whole = all(len(commits[record.name]) == shard_count(record) for record in source.manifest.subsets)
        as_there = all(c.painted == r.pixels for r in source.manifest.subsets for c in commits[r.name].values())
        if whole and as_there and [*map(_bare, manifest.subsets)] == [*map(_bare, source.manifest.subsets)]:
            link_equal_files(out, source.manifest, commits)
            files.write_bytes(out / INDEX, source.index_text)
            files.write_bytes(out / MANIFEST, source.manifest_text)
            return source.manifest
        if whole:
            lineage = tuple(entry for entry in manifest.lineage if entry["kind"] != "fetch")
            return finish_release(out, manifest.model_copy(update={"lineage": lineage}))
        return write_release(out, manifest, commits)


def _fetch_commits(
    source: Source, listed: list[FileRecord], shards: dict[ShardKey, SubsetRecord], workers: int
) -> dict[ShardKey, tuple[bytes, CommitRecord]]:
    """The commit records of shards, as bytes and checked: digests, and that their files lie in the subset's folder."""

    def one(item):
        key, file = item
        text = source.storage.read(file.path, file.sha256)
        if text is None:
            raise StoreError(f"{file.path} of {source.place} is missing; publish the release again")
        return text, checked_commit(text, f"{source.place}/{file.path}", shards[key], key[1])

    found = in_parallel(one, list(zip(shards, listed, strict=True)), workers)
    return dict(zip(shards, found, strict=True))


def _by_subset(commits: dict[ShardKey, tuple[bytes, CommitRecord]]) -> dict[str, dict[int, CommitRecord]]:
    found: dict[str, dict[int, CommitRecord]] = {}
    for (name, shard), (_, commit) in commits.items():
        found.setdefault(name, {})[shard] = commit
    return found


def _bare(record: SubsetRecord) -> SubsetRecord:
    return record.model_copy(update={"digest": None})


def _refuse_itself(out: Path, source: Source) -> None:
    """Raise StoreError if a release would be fetched to its own folder, which would make a part of it."""
    folder = source.storage.folder
    if folder and folder.resolve() == out.resolve():
        raise StoreError(
            f"{out} is the release itself; choose another --out, or render its images: dmcvb-gen paint {quoted(out)}"
        )


def taken_up(out: Path, source: Source) -> Manifest | None:
    """The manifest of the part that is in a folder already.

    None if the folder is empty or new, or holds an older version that the release has grown from: what is there then
    counts as files that have come already.

    Raises:
      StoreError: `out` holds anything but a part of this release, painted or not, or of an older version of it.
    """
    with storage_errors(out):
        begun, strange = (out / MANIFEST).is_file(), _is_strange(out, source.manifest)
    if begun:
        old = local_manifest(out)
        if _is_older_version(out, old, source):
            return None
        if not _same_release(old, source):
            if is_grown_from(source.manifest, _as_published(old, source)):
                raise StoreError(
                    f"{out} holds {old.name} {old.version} with images that were rendered here, which do not grow; "
                    f"choose another --out for {source.manifest.version}"
                )
            raise StoreError(
                f"{out} holds {old.name} {old.version} and not the {source.manifest.name} {source.manifest.version} of "
                "the URL; choose another --out"
            )
        return old
    if strange:
        raise StoreError(f"{out} is not empty and holds no release; choose an empty or new folder for --out")
    return None


def _as_published(old: Manifest, source: Source) -> Manifest:
    """A manifest with the images (or none) that the published release has."""
    there = {record.name: record for record in source.manifest.subsets}
    fields = ("pixels", "size", "views", "renderer", "backgrounds")
    subsets = tuple(
        record.model_copy(update={field: getattr(there[record.name], field) for field in fields})
        if record.name in there
        else record
        for record in old.subsets
    )
    return old.model_copy(update={"subsets": subsets})


def _is_older_version(out: Path, old: Manifest, source: Source) -> bool:
    """Return True if a folder holds a version, or a part of one, that the published release has grown from."""
    if old.recipe != source.manifest.recipe or not is_grown_from(source.manifest, old):
        return False
    index = read_index(out)
    return index is None or keeps(source.index, index.files)


def _same_release(old: Manifest, source: Source) -> bool:
    """Return True if a manifest is the published one, or belongs to a part of it or to a painted copy."""
    new = source.manifest
    if {record.name for record in old.subsets} != {record.name for record in new.subsets}:
        return False
    if any(entry.get("manifest_sha256") == source.index.manifest_sha256 for entry in old.lineage):
        return True
    now = [_bare(record).model_copy(update={"pixels": True}) for record in new.subsets]
    before = [_bare(record).model_copy(update={"pixels": True}) for record in old.subsets]
    return (old.name, old.version, old.recipe, before) == (new.name, new.version, new.recipe, now)


def _is_strange(out: Path, manifest: Manifest) -> bool:
    """Return True if a folder holds files that no interrupted fetch leaves."""
    begun = {record.name.split("/")[0] for record in manifest.subsets} | {"commits"}
    beside = {"policies", "backgrounds", CARD_FOLDER, *CARD_FILES}
    if not out.is_dir():
        return out.exists()
    there = {path.name for path in out.iterdir() if path.suffix != files.PARTIAL} - {LOCK}
    return bool(there - begun - beside) or (bool(there) and not there & begun)


def _write_part(out: Path, source: Source, base: Manifest, only, episodes) -> None:
    """A manifest that says that this is a part, and which: what is here while files come, and until all are."""
    entry = {
        "kind": "fetch",
        "from": source.public_name,
        "manifest_sha256": source.index.manifest_sha256,
        "digest": source.manifest.digest,
        "only": list(only),
        "episodes": list(episodes) if episodes else None,
    }
    before = tuple(e | {"from": source.public_name} if e.get("from") == source.place else e for e in base.lineage)
    lineage = before if entry in before else (*before, entry)
    (out / INDEX).unlink(missing_ok=True)
    facts = {"lineage": lineage, "complete": False, "digest": None}
    files.write_json(out / MANIFEST, base.model_copy(update=facts))
    for record in base.subsets:
        if (out / subset_path(record.name)).is_dir():
            mark_created(out, record)
