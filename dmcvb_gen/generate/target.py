"""The target of a rollout: a storage, and the local folder in which shards are made.

A shard is made in a staging folder of the worker's own and committed whole: its files, then its commit record. So two
workers that make the same shard (a retry beside a slow one) never write into each other's files, and end in the same
bytes, whichever is last::

    a folder   staged in <root>/.shards.<worker>.partial/      committed by renaming
    a URL      staged in <scratch>/.shards.<worker>.partial/   committed by checked uploads, while the next is made
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen import files
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
from dmcvb_gen.dataset.writer import LOCK_SECONDS
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.inputs import BUILTIN, Inputs, release_inputs
from dmcvb_gen.parallel.base import TIDY
from dmcvb_gen.storage import Storage, open_storage
from dmcvb_gen.storage.base import in_parallel
from dmcvb_gen.storage.remote import check_no_options, is_url, local_path, storage_errors

CONNECTIONS = 8
"""Files of a shard that are sent at once."""
LOCK = ".manifest.lock"
"""Object that the writer of a manifest at a URL holds."""
LOCK_PAUSE = 0.5
"""Seconds between two looks at another writer's lock."""
SCRATCH_SHARE = 0.5
"""Share of the scratch disk's free room that shards may take, if no bound is given."""


@dataclass(frozen=True)
class Target:
    """A release in the making; travels to workers by pickle.

    Attributes:
      storage: storage of the release's files.
      scratch: folder on this machine for the staging folders: the release's own, if it is here.
      scratch_bytes: bytes that this worker's shards may take there: the one that is made and those that are being sent.
    """

    storage: Storage
    scratch: Path
    scratch_bytes: int = 0

    @classmethod
    def at(
        cls,
        place: str | Path,
        options: Mapping[str, Any] | None = None,
        scratch: str | Path | None = None,
        scratch_bytes: int | None = None,
        workers: int = 1,
    ) -> Target:
        """The target of a folder or URL.

        Args:
          options: options of fsspec, for a URL.
          scratch, scratch_bytes: where shards of a URL are made before they are sent, and how much room they may take,
            over all `workers`; half of what is free by default.
        """
        if not is_url(place):
            check_no_options(place, options)
            return cls(open_storage(local_path(place)), local_path(place))
        if str(place).startswith("memory:"):
            raise StoreError(f"{place} is lost when this process ends; give a folder or a URL such as s3://bucket/name")
        folder = Path(scratch or tempfile.gettempdir()) / "dmcvb-gen"
        with storage_errors(folder, "write to"):
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free * SCRATCH_SHARE
        return cls(open_storage(str(place), options), folder, int((scratch_bytes or free) / workers))

    @property
    def place(self) -> str:
        """Folder or URL, for messages."""
        return self.storage.place

    @property
    def folder(self) -> Path | None:
        """The release's folder; None if it is at a URL."""
        return self.scratch if self.scratch == self.storage.folder else None

    @property
    def uploads(self) -> bool:
        """True if committing is so slow that the next shard should be made meanwhile."""
        return self.folder is None

    def manifest(self) -> Manifest | None:
        """The release's manifest, None if there is none yet."""
        text = self.storage.read(MANIFEST)
        return None if text is None else parse_manifest(text, f"{self.place}/{MANIFEST}")

    def commits(self, records: Iterable[SubsetRecord]) -> dict[str, dict[int, CommitRecord]]:
        """subset -> shard -> record of the shards that are committed and whose files are all there at their size."""
        listed = self.storage.list()
        paths = {
            commit_path(record.name, shard): (record, shard)
            for record in records
            for shard in range(shard_count(record))
            if commit_path(record.name, shard) in listed
        }
        texts = in_parallel(self.storage.read, list(paths), CONNECTIONS)
        found: dict[str, dict[int, CommitRecord]] = {}
        for (path, (record, shard)), text in zip(paths.items(), texts, strict=True):
            if text is None:
                continue
            commit = checked_commit(text, f"{self.place}/{path}", record, shard)
            if all(file.path in listed and listed[file.path].bytes == file.bytes for file in commit.files):
                found.setdefault(record.name, {})[shard] = commit
        return found

    @contextlib.contextmanager
    def lock(self) -> Iterator[Lock]:
        """Keep other writers from the manifest and the arrays' metadata at a URL while the block runs."""
        lock = Lock(self.storage)
        lock.take()
        try:
            yield lock
        finally:
            lock.leave()

    def bring_metadata(self, record: SubsetRecord, folder: Path) -> None:
        """Put the Zarr metadata of a subset into a folder, as the release has it."""
        path = f"{subset_path(record.name)}/zarr.json"
        text = self.storage.read(path)
        if text is None:
            raise StoreError(f"{self.place}/{path} is missing; run the same rollout again (on a cluster: --init)")
        files.write_bytes(folder / path, text)
        for name, node in _consolidated(text, f"{self.place}/{path}").items():
            files.write_json(folder / subset_path(record.name) / name / "zarr.json", node)

    def inputs(self, record: SubsetRecord, folder: Path) -> Inputs:
        """The release's own copies of what a subset is made from, brought into `folder` if they are not here."""
        if self.folder:
            return release_inputs(self.folder, [record])[record.name]
        wanted = [policy.path for policy in record.policies]
        if record.backgrounds and record.backgrounds["source"] != BUILTIN:
            prefix = f"{record.backgrounds['source']}/"
            wanted += [path for path in self.storage.list() if path.startswith(prefix)]
        for path in wanted:
            if path and not (folder / path).exists():
                data = self.storage.read(path)
                if data is not None:
                    files.write_bytes(folder / path, data)
        return release_inputs(folder, [record])[record.name]

    def commit_shard(self, folder: Path, commit: CommitRecord) -> Callable[[], None]:
        """Move a staged shard into the release, its commit record last; the call that is given waits until it is there.

        Raises:
          StoreError: it cannot be written, or another machine has committed this shard with other bytes.
        """
        if not self.uploads:
            self._commit_shard(folder, commit)
            return lambda: None
        size = sum(file.bytes for file in commit.files)
        if size > self.scratch_bytes:
            raise StoreError(
                f"shard {commit.shard} of {commit.subset} has {size / 1e6:.0f} MB and a worker's share of the scratch "
                f"room is {self.scratch_bytes / 1e6:.0f} MB; give a larger --scratch-size, or fewer --workers or "
                "--episodes-per-shard"
            )
        return _upload_queue(self.scratch_bytes).send(size, lambda: self._commit_shard(folder, commit))

    def _commit_shard(self, folder: Path, commit: CommitRecord) -> None:
        self._check_same(commit)
        if self.folder:
            with storage_errors(self.folder, "write to"):
                for file in commit.files:
                    (self.folder / file.path).parent.mkdir(parents=True, exist_ok=True)
                    os.replace(folder / file.path, self.folder / file.path)
        else:

            def send(file: FileRecord) -> None:
                self.storage.upload(folder, file, fresh=True)
                (folder / file.path).unlink()

            in_parallel(send, commit.files, CONNECTIONS)
        self.storage.write(commit_path(commit.subset, commit.shard), files.json_bytes(commit))

    def _check_same(self, commit: CommitRecord) -> None:
        """Raises StoreError if another machine's commit of the same shard stands for other bytes."""
        text = self.storage.read(commit_path(commit.subset, commit.shard))
        try:
            other = CommitRecord.model_validate_json(text or b"")
        except ValueError:
            return  # a record that is not there or cannot be read stands for nothing
        if not other.same_data(commit) and all(self.storage.size(file.path) == file.bytes for file in other.files):
            raise StoreError(
                f"shard {commit.shard} of {commit.subset} was committed meanwhile with other bytes, made by "
                f"{other.environment.get('cpu', 'another machine')}; make a release with one version of all "
                "packages (`dmcvb-gen regenerate --check` says what differs)"
            )


def _consolidated(text: bytes, where: str) -> dict[str, dict[str, Any]]:
    """The metadata of all arrays and groups that a group's zarr.json holds, by their path in the group.

    Raises:
      StoreError: it is damaged.
    """
    try:
        nodes = {name: dict(node) for name, node in files.parse_json(text)["consolidated_metadata"]["metadata"].items()}
    except (ValueError, LookupError, TypeError, AttributeError):
        raise StoreError(f"{where} is damaged; put it there from a copy, or choose another --out") from None
    for node in nodes.values():
        node.pop("consolidated_metadata", None)  # of a group within the group, which would grow stale
    return nodes


class Lock:
    """A file at a URL that one writer has: it is created only if it is absent.

    One that stays the same for `LOCK_SECONDS` was left by a killed process, and is taken over. Several may do so at
    once: each writes its token over the old one, so that the file is never absent, and the last one has the lock.
    """

    def __init__(self, storage: Storage):
        self._storage, self._token, self._renewed = storage, _new_token(), 0.0

    def take(self) -> None:
        """Wait until no other writer has it."""
        seen, since = None, time.monotonic()
        while not self._storage.create(LOCK, self._token):
            there = self._storage.read(LOCK)
            if there != seen:
                seen, since = there, time.monotonic()
            elif there is not None and time.monotonic() - since > LOCK_SECONDS:
                self._storage.write(LOCK, self._token)
                time.sleep(LOCK_PAUSE)
                if self._is_mine():
                    break
            else:
                time.sleep(LOCK_PAUSE)
        self._renewed = time.monotonic()

    def keep(self, *_: object) -> None:
        """Say now and then that this writer is still at work, see `check`; what it is given has no effect."""
        if time.monotonic() - self._renewed > LOCK_SECONDS / 4:
            self.check()
            self._token, self._renewed = _new_token(), time.monotonic()
            self._storage.write(LOCK, self._token)

    def check(self) -> None:
        """Raises StoreError if another writer took it over, because this one seemed to be killed."""
        if not self._is_mine():
            raise StoreError(f"another process took over {self._storage.place} meanwhile; rerun the same command")

    def leave(self) -> None:
        """Let the next writer have it."""
        if self._is_mine():
            self._storage.remove(LOCK)

    def _is_mine(self) -> bool:
        return self._storage.read(LOCK) == self._token


def _new_token() -> bytes:
    return uuid.uuid4().hex.encode()


# -- staging folders ------------------------------------------------------------------------------


class StagingFolder:
    """This process's folder to make a target's shards in; what killed processes of this machine left beside it goes."""

    def __init__(self, target: Target):
        self._target, self._exit = target, contextlib.ExitStack()
        self._inputs: dict[str, Inputs] = {}
        parent = target.scratch
        with storage_errors(parent, "write to"):
            parent.mkdir(parents=True, exist_ok=True)
            files.remove_partial(parent, below=False)
            self.folder = self._exit.enter_context(files.folder_in_the_making(parent, "shards"))
        atexit.register(self.close)

    def prepare(self, record: SubsetRecord) -> Path:
        """The folder, with the metadata of a subset."""
        if not (self.folder / subset_path(record.name)).exists():
            try:
                self._target.bring_metadata(record, self.folder)
            except OSError as error:
                raise StoreError(
                    f"cannot write {record.name} to {self.folder.parent}: {error.strerror or error}; "
                    "finished shards are saved; make room and rerun the same command"
                ) from None
        return self.folder

    def inputs(self, record: SubsetRecord) -> Inputs:
        """Find the inputs of a subset in the release."""
        if record.name not in self._inputs:
            self._inputs[record.name] = self._target.inputs(record, self.folder)
        return self._inputs[record.name]

    def close(self) -> None:
        """Remove the folder."""
        self._exit.close()


_staging_folders: dict[Target, StagingFolder] = {}


def rollouts_at_work(target: Target) -> list[str]:
    """Other running processes that make shards of a release in a folder: "process 12", see `files.others_at_work`."""
    return files.others_at_work(target.scratch) if target.folder else []


def staging_folder_of(target: Target) -> StagingFolder:
    """This process's staging folder for a target."""
    if target not in _staging_folders:
        _staging_folders[target] = StagingFolder(target)
    return _staging_folders[target]


def leave(target: Target) -> None:
    """Remove this process's staging folder for a target."""
    folder = _staging_folders.pop(target, None)
    if folder is not None:
        folder.close()


def remove_staging_folders() -> None:
    """Remove this process's staging folders."""
    for target in list(_staging_folders):
        leave(target)


TIDY.append(remove_staging_folders)


class UploadQueue:
    """Sends shards one after the other, while others are made; what waits takes a bounded room.

    Args:
      bound: bytes that may wait; `send` blocks until there is room.
    """

    def __init__(self, bound: int):
        self._bound, self._waiting, self._changed = bound, 0, threading.Condition()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="upload")

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
