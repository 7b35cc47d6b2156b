"""Moving single files to and from a file system of fsspec, checked by digest, retried, and gone on with when cut."""

from __future__ import annotations

import base64
import hashlib
import logging
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import fsspec

from dmcvb_gen.dataset.index import is_card
from dmcvb_gen.dataset.manifest import FileRecord
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import remove_partial, replacing, sha256_file
from dmcvb_gen.storage.remote import NO_ROOM, is_refusal, reason, refused, storage_errors

ATTEMPTS = 4
"""Tries of a file before giving up."""
PAUSE = 0.5
"""Seconds before the second try; doubled for each further one."""
PIECE = 16 * 2**20
"""Bytes of one read; a download that is cut goes on after the last whole piece."""
PART = 50 * 2**20
"""Bytes of a part of an S3 multipart upload (decides its ETag)."""
OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "hf", "az", "abfs"}
"""Protocols without folders."""

log = logging.getLogger(__name__)


class WrongBytes(Exception):
    """A file arrived with other bytes than its digest says."""


def protocol(filesystem: fsspec.AbstractFileSystem) -> str:
    return filesystem.protocol if isinstance(filesystem.protocol, str) else filesystem.protocol[0]


def retry(place: str, path: str, attempt, doing: str = "move"):
    """Call `attempt` until it succeeds, at most ATTEMPTS times.

    Args:
      doing: what it does to `path`, in a word; "read" where nothing is written, here or there.

    Raises:
      StoreError: access is refused, the disk is full, or it never succeeded.
    """
    import tenacity  # only where something is sent or fetched

    def said(state: tenacity.RetryCallState) -> None:
        error = state.outcome and state.outcome.exception()
        log.info("try %d of %s failed: %s", state.attempt_number, path, error and reason(error))

    attempts = tenacity.Retrying(
        stop=tenacity.stop_after_attempt(ATTEMPTS),
        wait=tenacity.wait_exponential(multiplier=PAUSE, min=0),
        retry=tenacity.retry_if_exception(_may_pass),
        before_sleep=said,
        reraise=True,
    )
    try:
        return attempts(attempt)
    except StoreError:
        raise
    except Exception as error:  # file systems raise their clients' own kinds
        if is_refusal(error):
            raise refused(place, error) from None
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            raise StoreError(
                f"no room for {path} ({error.strerror}); what was moved stays, make room and run the same command again"
            ) from None
        cure = "check the place and the network" if doing == "read" else "what was moved stays"
        raise StoreError(
            f"cannot {doing} {path} of {place} after {ATTEMPTS} tries ({reason(error)}); {cure}, run the same command "
            "again"
        ) from None


def _may_pass(error: BaseException) -> bool:
    """Whether trying again may help."""
    if isinstance(error, StoreError) or not isinstance(error, Exception) or is_refusal(error):
        return False
    return not (isinstance(error, OSError) and error.errno in NO_ROOM)


def _etags(path: Path) -> set[str]:
    """ETags that S3 may give a file: its MD5, or the MD5 of its parts' MD5s."""
    whole, parts = hashlib.md5(usedforsecurity=False), []
    with path.open("rb") as file:
        while piece := file.read(PART):
            whole.update(piece)
            parts.append(hashlib.md5(piece, usedforsecurity=False).digest())
    joined = hashlib.md5(b"".join(parts), usedforsecurity=False).hexdigest()
    return {whole.hexdigest(), f"{joined}-{len(parts)}"}


def has_bytes(filesystem: fsspec.AbstractFileSystem, remote: str, local: Path, record: FileRecord) -> bool:
    """Whether the remote file is the recorded one: by size, then by the store's own MD5, else by reading it back."""
    try:
        filesystem.invalidate_cache(remote.rsplit("/", 1)[0])
        facts = filesystem.info(remote)
    except FileNotFoundError:
        return False
    if facts.get("size") != record.bytes:
        return False
    etag = str(facts.get("ETag", "")).strip('"')
    if etag and etag in _etags(local):
        return True
    if "md5Hash" in facts:
        return base64.b64decode(facts["md5Hash"]).hex() in _etags(local)
    return remote_sha256(filesystem, remote, record.bytes) == record.sha256


def remote_sha256(filesystem: fsspec.AbstractFileSystem, remote: str, size: int) -> str:
    """SHA-256 of a remote file, read piece by piece."""
    digest = hashlib.sha256()
    for start in range(0, size, PIECE):
        digest.update(filesystem.cat_file(remote, start=start, end=min(start + PIECE, size)))
    return digest.hexdigest()


def upload(
    filesystem: fsspec.AbstractFileSystem, place: str, local: Path, remote: str, record: FileRecord, fresh: bool = False
) -> bool:
    """Put one file there and check that it arrived; False if it was there already.

    Args:
      fresh: nothing is known to be there, so do not look first.

    Raises:
      StoreError: the local file is not the recorded one, or it cannot be put there.
    """
    with storage_errors(local):
        sound = local.is_file() and local.stat().st_size == record.bytes and sha256_file(local) == record.sha256
    if not sound:
        cure = "card" if is_card(record.path) else "regenerate"
        raise StoreError(f"{local} does not have its digest; run `dmcvb-gen {cure}` on the release first")
    options: dict[str, Any] = {"chunksize": PART} if protocol(filesystem) in ("s3", "s3a") else {}

    looked = not fresh

    def attempt():
        nonlocal looked
        if looked and has_bytes(filesystem, remote, local, record):
            return False
        looked = True  # after a failure it may be there all the same
        if protocol(filesystem) not in OBJECT_STORES:
            filesystem.makedirs(remote.rsplit("/", 1)[0], exist_ok=True)
        filesystem.put_file(str(local), remote, **options)
        if not has_bytes(filesystem, remote, local, record):
            raise WrongBytes("it arrived with other bytes")
        return True

    return retry(place, record.path, attempt)


def read_object(filesystem: fsspec.AbstractFileSystem, place: str, path: str) -> bytes | None:
    """A small file's bytes, None where it is not there."""

    def attempt():
        try:
            filesystem.invalidate_cache()
            return filesystem.cat_file(path)
        except FileNotFoundError:
            return None

    return retry(place, path.rsplit("/", 1)[-1], attempt, "read")


def list_files(filesystem: fsspec.AbstractFileSystem, place: str, base: str) -> dict[str, dict[str, Any]]:
    """Every file below a place: path in it -> what the store says of it ("size", ...); empty where nothing is."""

    def attempt() -> dict[str, dict[str, Any]]:
        filesystem.invalidate_cache()
        try:
            found = filesystem.find(base, detail=True)
        except FileNotFoundError:
            return {}
        return {path[len(base) + 1 :]: facts for path, facts in found.items()}

    return retry(place, "the list of files", attempt, "read")


def put_object(filesystem: fsspec.AbstractFileSystem, path: str, data: bytes) -> None:
    """Write a small file, in place of what is there."""
    if protocol(filesystem) not in OBJECT_STORES:
        filesystem.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
    filesystem.pipe_file(path, data)


def create_object(filesystem: fsspec.AbstractFileSystem, place: str, path: str, data: bytes) -> bool:
    """Write a small file that must not be there yet; False where it is.

    Atomic on local disks and S3, as good as can be elsewhere.

    Raises:
      StoreError: there is no such bucket, or see `retry`.
    """

    def attempt() -> bool:
        try:
            _create(filesystem, path, data)
        except FileExistsError:
            return False
        except FileNotFoundError as error:
            raise StoreError(f"{place}: {reason(error)}; create the bucket first") from None
        return True

    return retry(place, path.rsplit("/", 1)[-1], attempt)


def _create(filesystem: fsspec.AbstractFileSystem, path: str, data: bytes) -> None:
    if protocol(filesystem) not in OBJECT_STORES:
        filesystem.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
    if protocol(filesystem) in ("file", "local"):
        remove_partial(Path(path).parent, below=False)
        with replacing(path, new=True) as temporary:  # whole or not there; a file that is opened as a new one is not
            temporary.write_bytes(data)
        return
    try:
        filesystem.pipe_file(path, data, mode="create")
    except Exception as error:
        filesystem.invalidate_cache()
        if "PreconditionFailed" in f"{type(error).__name__} {error}" or "condition" in str(error):
            raise FileExistsError(path) from None
        raise


def download(filesystem: fsspec.AbstractFileSystem, place: str, remote: str, local: Path, record: FileRecord) -> int:
    """Bring one file here and check it; gives the bytes that were moved (0 if it was here already).

    Raises:
      StoreError: it has other bytes than recorded, is not there, or there is no room.
    """
    if local.is_file() and local.stat().st_size == record.bytes and sha256_file(local) == record.sha256:
        return 0
    local.parent.mkdir(parents=True, exist_ok=True)
    partial, moved = local.with_name(local.name + ".partial"), 0

    def attempt():
        nonlocal moved
        have = partial.stat().st_size if partial.exists() else 0
        if have > record.bytes:
            partial.unlink()
            have = 0
        with partial.open("ab") as file:
            while have < record.bytes:
                piece = filesystem.cat_file(remote, start=have, end=min(have + PIECE, record.bytes))
                if not piece:
                    raise WrongBytes(f"it ends after {have} of {record.bytes} bytes")
                file.write(piece)
                file.flush()
                have, moved = have + len(piece), moved + len(piece)
        if have != record.bytes or sha256_file(partial) != record.sha256:
            partial.unlink()
            raise WrongBytes("it does not have its digest")
        partial.replace(local)
        return moved

    return retry(place, record.path, attempt)


def in_parallel(work, items, workers: int, tick) -> list:
    """Results of `work(item)` for all items, `workers` at a time; the first error, of `tick` too, stops the rest."""
    with ThreadPoolExecutor(max(1, workers)) as pool:
        futures = [pool.submit(work, item) for item in items]
        waiting = set(futures)
        try:
            while waiting:
                done, waiting = wait(waiting, timeout=0.5, return_when=FIRST_EXCEPTION)
                for future in done:
                    tick(future.result())
        except BaseException:  # also of the tick, and a person's Ctrl-C
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return [future.result() for future in futures]
