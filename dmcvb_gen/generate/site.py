"""Where a release is being made, a folder or a bucket: small files in and out, finished shards delivered.

A shard is made on a stage, a folder of the worker's own, and delivered whole: its files, then its commit record. So
two workers that make the same shard (a retry beside a slow one) never write into each other's files, and end in the
same bytes, whichever is last::

    FolderSite   stage: <root>/.shards.<worker>.partial/      delivered by renaming
    BucketSite   stage: <scratch>/.shards.<worker>.partial/   delivered by checked uploads, while the next is made
"""

from __future__ import annotations

import abc
import atexit
import contextlib
import datetime
import json
import os
import shutil
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.dataset.index import metadata_paths
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.dataset.transfer import create_object, in_parallel, list_files, put_object, read_object, retry, upload
from dmcvb_gen.dataset.writer import LOCK_SECONDS
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.inputs import BUILTIN, Inputs, release_inputs
from dmcvb_gen.parallel import ignore
from dmcvb_gen.parallel.base import TIDY
from dmcvb_gen.storage.remote import file_system, is_url, local_path, public, storage_errors

CONNECTIONS = 8
"""Files of a shard that are sent at once."""
LOCK = ".manifest.lock"
"""Object that the writer of a bucket's manifest holds."""
LOCK_PAUSE = 0.5
"""Seconds between two looks at another writer's lock."""
SCRATCH_SHARE = 0.5
"""Share of the scratch disk's free room that shards may take, where no bound is given."""


@dataclass(frozen=True)
class Listed:
    """A file's bytes, and when it was put there (seconds since 1970; None where the store does not say)."""

    bytes: int
    time: float | None


def _time_of(facts: Mapping[str, Any]) -> float | None:
    """When a file was written, by whatever name a file system of fsspec says it."""
    for name in ("LastModified", "mtime", "updated", "last_modified", "created"):
        value = facts.get(name)
        if isinstance(value, str):
            with contextlib.suppress(ValueError):
                value = datetime.datetime.fromisoformat(value)
        if isinstance(value, datetime.datetime):
            return value.timestamp()
        if isinstance(value, int | float):
            return float(value)
    return None


class Site(abc.ABC):
    """A release in the making; travels to workers by pickle."""

    place: str
    """Folder or URL, fit for messages."""
    workshop: Path
    """Folder of the workers' stages, on this machine."""
    slow: bool
    """Whether delivering takes so long that the next shard is better made meanwhile."""

    @abc.abstractmethod
    def read(self, path: str) -> bytes | None:
        """A small file's bytes, None where it is not there."""

    @abc.abstractmethod
    def listing(self) -> dict[str, Listed]:
        """Every file, by path inside the release."""

    @abc.abstractmethod
    def metadata(self, record: SubsetRecord, folder: Path) -> None:
        """Put the Zarr metadata of a subset into a folder, as the release has it."""

    @abc.abstractmethod
    def inputs(self, record: SubsetRecord, folder: Path) -> Inputs:
        """The release's own copies of what a subset is made from, brought into `folder` if they are not local."""

    @abc.abstractmethod
    def deliver(self, folder: Path, commit: CommitRecord) -> Callable[[], None]:
        """Put a staged shard into the release, its commit record last; the call that is given waits until it is there.

        Raises:
          StoreError: it cannot be written, or another machine has committed this shard with other bytes.
        """

    def manifest(self) -> Manifest | None:
        """The release's manifest, None where there is none yet."""
        text = self.read(MANIFEST)
        return None if text is None else parse_manifest(text, f"{self.place}/{MANIFEST}")

    def commits(self, records: Iterable[SubsetRecord]) -> dict[str, dict[int, CommitRecord]]:
        """subset -> shard -> record of the shards that are committed and whose files are all there at their size."""
        listed = self.listing()
        paths = {
            commit_path(record.name, shard): (record, shard)
            for record in records
            for shard in range(shard_count(record))
            if commit_path(record.name, shard) in listed
        }
        texts = in_parallel(self.read, list(paths), CONNECTIONS, ignore)
        found: dict[str, dict[int, CommitRecord]] = {}
        for (path, (record, shard)), text in zip(paths.items(), texts, strict=True):
            if text is None:
                continue
            commit = checked_commit(text, f"{self.place}/{path}", record, shard)
            if all(file.path in listed and listed[file.path].bytes == file.bytes for file in commit.files):
                found.setdefault(record.name, {})[shard] = commit
        return found

    def _check_same(self, commit: CommitRecord) -> None:
        """Raises StoreError where another machine's commit of the same shard stands for other bytes."""
        text = self.read(commit_path(commit.subset, commit.shard))
        try:
            other = CommitRecord.model_validate_json(text or b"")
        except ValueError:
            return  # a record that is not there or cannot be read stands for nothing
        if not other.same_data(commit) and self._has({file.path: file.bytes for file in other.files}):
            raise StoreError(
                f"shard {commit.shard} of {commit.subset} was committed meanwhile with other bytes, made by "
                f"{other.environment.get('cpu', 'another machine')}; make a release with one version of all "
                "packages (`dmcvb-gen regenerate --check` says what differs)"
            )

    @abc.abstractmethod
    def _has(self, sizes: Mapping[str, int]) -> bool:
        """Whether files are there at their sizes."""


def site_of(
    place: str | Path,
    options: Mapping[str, Any] | None = None,
    scratch: str | Path | None = None,
    scratch_bytes: int | None = None,
    workers: int = 1,
) -> Site:
    """The site of a folder or URL.

    Args:
      options: of fsspec, for a URL.
      scratch, scratch_bytes: where shards are made before they are sent, and how much room they may take, over all
        `workers`; half of what is free by default.
    """
    if not is_url(str(place)):
        return FolderSite(local_path(place))
    if str(place).startswith("memory:"):
        raise StoreError(f"{place} is lost when this process ends; give a folder or a URL such as s3://bucket/name")
    folder = Path(scratch or tempfile.gettempdir()) / "dmcvb-gen"
    with storage_errors(folder, "write to"):
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free * SCRATCH_SHARE
    share = int((scratch_bytes or free) / workers)
    return BucketSite(str(place), tuple(sorted((options or {}).items())), folder, share)


@dataclass(frozen=True)
class FolderSite(Site):
    """A release in a folder, on this machine or shared by several."""

    root: Path
    place = property(lambda self: str(self.root))
    workshop = property(lambda self: self.root)
    slow = False

    def read(self, path):
        with storage_errors(self.root / path):
            try:
                return (self.root / path).read_bytes()
            except (FileNotFoundError, NotADirectoryError):
                return None  # where a file is in the way, the first one who writes says so

    def listing(self):
        with storage_errors(self.root):
            found = {}
            for folder, folders, names in os.walk(self.root):  # passes over what others remove meanwhile
                folders[:] = [name for name in folders if not name.startswith(".")]
                for name in names:
                    path = Path(folder) / name
                    with contextlib.suppress(FileNotFoundError):
                        if not name.startswith("."):  # of files in the making
                            stat = path.stat()
                            found[path.relative_to(self.root).as_posix()] = Listed(stat.st_size, stat.st_mtime)
            return found

    def metadata(self, record, folder):
        for path in metadata_paths(self.root, record):
            files.copy_file(self.root / path, folder / path)

    def inputs(self, record, folder):
        return release_inputs(self.root, [record])[record.name]

    def deliver(self, folder, commit):
        self._check_same(commit)
        with storage_errors(self.root, "write to"):
            for file in commit.files:
                target = self.root / file.path
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(folder / file.path, target)
            files.write_json(self.root / commit_path(commit.subset, commit.shard), commit)
        return lambda: None

    def _has(self, sizes):
        return all((self.root / p).is_file() and (self.root / p).stat().st_size == n for p, n in sizes.items())


@dataclass(frozen=True)
class BucketSite(Site):
    """A release at a URL of fsspec.

    Attributes:
      options: of fsspec, as pairs.
      scratch: folder of the stages on this machine.
      scratch_bytes: what this worker's shards may take there: the one that is made and those that are being sent.
    """

    url: str
    options: tuple[tuple[str, Any], ...] = field(repr=False)
    scratch: Path
    scratch_bytes: int
    place = property(lambda self: public(self.url).rstrip("/"))
    workshop = property(lambda self: self.scratch)
    slow = True

    def _open(self):
        return file_system(self.url, dict(self.options))

    def read(self, path):
        filesystem, base = self._open()
        return read_object(filesystem, self.place, f"{base}/{path}")

    def create(self, path: str, data: bytes) -> bool:
        """Write a small file that must not be there yet; False where it is."""
        filesystem, base = self._open()
        return create_object(filesystem, self.place, f"{base}/{path}", data)

    def write(self, path: str, data: bytes) -> None:
        """Write a small file, in place of what is there."""
        filesystem, base = self._open()
        retry(self.place, path, lambda: put_object(filesystem, f"{base}/{path}", data))

    def remove(self, path: str) -> None:
        """Remove a small file, if it is there."""
        filesystem, base = self._open()

        def attempt() -> None:
            with contextlib.suppress(FileNotFoundError):
                filesystem.rm_file(f"{base}/{path}")

        retry(self.place, path, attempt)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other writers from the manifest while the block runs, which must be short.

        The lock is an object that is created only if it is absent. One that stays the same for `LOCK_SECONDS` was left
        by a killed process, and is taken over.
        """
        token, seen, since = uuid.uuid4().hex.encode(), None, time.monotonic()
        while not self.create(LOCK, token):
            there = self.read(LOCK)
            if there != seen:
                seen, since = there, time.monotonic()
            elif there is not None and time.monotonic() - since > LOCK_SECONDS:
                self.remove(LOCK)
            else:
                time.sleep(LOCK_PAUSE)
        try:
            yield
        finally:
            if self.read(LOCK) == token:
                self.remove(LOCK)

    def listing(self):
        filesystem, base = self._open()
        found = list_files(filesystem, self.place, base)
        return {path: Listed(facts["size"], _time_of(facts)) for path, facts in found.items() if path != LOCK}

    def metadata(self, record, folder):
        path = f"{subset_path(record.name)}/zarr.json"
        text = self.read(path)
        if text is None:
            raise StoreError(f"{self.place}/{path} is missing; run the rollout with --init again")
        group = json.loads(text)
        files.write_bytes(folder / path, text)
        for name, node in group["consolidated_metadata"]["metadata"].items():
            bare = {key: value for key, value in node.items() if key != "consolidated_metadata"}  # it would grow stale
            files.write_json(folder / subset_path(record.name) / name / "zarr.json", bare)

    def inputs(self, record, folder):
        wanted = [policy.path for policy in record.policies]
        if record.backgrounds and record.backgrounds["source"] != BUILTIN:
            prefix = f"{record.backgrounds['source']}/"
            wanted += [path for path in self.listing() if path.startswith(prefix)]
        for path in wanted:
            if path and not (folder / path).exists():
                data = self.read(path)
                if data is not None:
                    files.write_bytes(folder / path, data)
        return release_inputs(folder, [record])[record.name]

    def deliver(self, folder, commit):
        size = sum(file.bytes for file in commit.files)
        if size > self.scratch_bytes:
            raise StoreError(
                f"shard {commit.shard} of {commit.subset} has {size / 1e6:.0f} MB and a worker's share of the scratch "
                f"room is {self.scratch_bytes / 1e6:.0f} MB; give a larger --scratch-size, or fewer --workers or "
                "--episodes-per-shard"
            )
        return _upload_queue(self.scratch_bytes).send(size, lambda: self._deliver(folder, commit))

    def _deliver(self, folder: Path, commit: CommitRecord) -> None:
        filesystem, base = self._open()
        self._check_same(commit)

        def send(file: FileRecord) -> None:
            upload(filesystem, self.place, folder / file.path, f"{base}/{file.path}", file, fresh=True)
            (folder / file.path).unlink()

        in_parallel(send, commit.files, CONNECTIONS, ignore)
        self.write(commit_path(commit.subset, commit.shard), files.json_bytes(commit))

    def _has(self, sizes):
        filesystem, base = self._open()
        filesystem.invalidate_cache()
        try:
            return all(filesystem.info(f"{base}/{path}")["size"] == size for path, size in sizes.items())
        except FileNotFoundError:
            return False


# -- stages ---------------------------------------------------------------------------------------


class StagingFolder:
    """This process's folder to make a site's shards in; what killed processes of this machine left beside it goes."""

    def __init__(self, site: Site):
        self._site, self._exit = site, contextlib.ExitStack()
        self._inputs: dict[str, Inputs] = {}
        parent = site.workshop
        with storage_errors(parent, "write to"):
            parent.mkdir(parents=True, exist_ok=True)
            files.remove_partial(parent, below=False)
            self.folder = self._exit.enter_context(files.folder_in_the_making(parent, "shards"))
        atexit.register(self.close)

    def prepare(self, record: SubsetRecord) -> Path:
        """The folder, with the metadata of a subset."""
        if not (self.folder / subset_path(record.name)).exists():
            try:
                self._site.metadata(record, self.folder)
            except OSError as error:
                raise StoreError(
                    f"cannot write {record.name} to {self.folder.parent}: {error.strerror or error}; "
                    "what was committed is safe, make room and run the same command again"
                ) from None
        return self.folder

    def inputs(self, record: SubsetRecord) -> Inputs:
        """What a subset is made from, found in the release."""
        if record.name not in self._inputs:
            self._inputs[record.name] = self._site.inputs(record, self.folder)
        return self._inputs[record.name]

    def close(self) -> None:
        """Remove the folder."""
        self._exit.close()


_stages: dict[Site, StagingFolder] = {}


def rollouts_at_work(site: Site) -> list[str]:
    """Other running processes that make shards of a release in a folder: "process 12", see `files.others_at_work`."""
    return files.others_at_work(site.workshop) if isinstance(site, FolderSite) else []


def staging_folder_of(site: Site) -> StagingFolder:
    """This process's stage for a site."""
    if site not in _stages:
        _stages[site] = StagingFolder(site)
    return _stages[site]


def leave(site: Site) -> None:
    """Remove this process's stage for a site."""
    stage = _stages.pop(site, None)
    if stage is not None:
        stage.close()


def remove_staging_folders() -> None:
    """Remove this process's stages."""
    for site in list(_stages):
        leave(site)


TIDY.append(remove_staging_folders)


class UploadQueue:
    """Sends shards one after the other, while others are made; what waits takes a bounded room.

    Args:
      bound: bytes that may wait; `send` blocks until there is room.
    """

    def __init__(self, bound: int):
        self._bound, self._waiting, self._changed = bound, 0, threading.Condition()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="sender")

    def send(self, size: int, work: Callable[[], None]) -> Callable[[], None]:
        """Have `work` done; the call that is given waits until it is, and raises what it raised.

        Returns once there is room for as much again, so that the caller may make the next shard.
        """
        with self._changed:
            self._waiting += size
        future: Future = self._pool.submit(work)
        future.add_done_callback(lambda _: self._sent(size))
        with self._changed:
            self._changed.wait_for(lambda: self._waiting == 0 or self._waiting + size <= self._bound)
        return future.result

    def _sent(self, size: int) -> None:
        with self._changed:
            self._waiting -= size
            self._changed.notify_all()


_upload_queues: dict[int, UploadQueue] = {}


def _upload_queue(bound: int) -> UploadQueue:
    if bound not in _upload_queues:
        _upload_queues[bound] = UploadQueue(bound)
    return _upload_queues[bound]
