"""The interface to files wherever they are: whole small files, conditional creation, listing, checked transfers.

An implementation gives a few small methods (`_read`, `_write`, ...) that raise what their client raises. `Storage` adds
what all share: retries, digests, downloads that resume, and errors of one line.
"""

from __future__ import annotations

import abc
import contextlib
import hashlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes, sha256_file
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.storage.remote import NO_ROOM, is_refusal, is_url, reason, refused, storage_errors, without_parts

ATTEMPTS = 4
"""Tries of a file before giving up."""
PAUSE = 0.5
"""Seconds before the second try; doubled for each further one."""
PIECE = 16 * 2**20
"""Bytes of one read; a download that is cut goes on after the last whole piece."""
ABSENT = (FileNotFoundError, NotADirectoryError)
Result = TypeVar("Result")
log = logging.getLogger(__name__)


class WrongBytes(Exception):
    """A file arrived with other bytes than its digest says."""


class Digested(Protocol):
    """A file of a release: its path there, its size in bytes, and its SHA-256 in hex."""

    @property
    def path(self) -> str: ...
    @property
    def bytes(self) -> int: ...
    @property
    def sha256(self) -> str: ...


@dataclass(frozen=True)
class StoredFile:
    """A listed file: its bytes, and when it was written (seconds since 1970); None if the storage does not say."""

    bytes: int | None
    time: float | None = None


class Storage(abc.ABC):
    """Files below a folder or URL, by relative path. It pickles, and equals another one of the same place.

    All methods raise StoreError if the storage refuses access, has no room, or fails `ATTEMPTS` times.
    """

    folder: Path | None = None
    """The folder on this machine; None if the files are elsewhere."""
    needs_claim = True
    """Whether two publishers must exclude each other by a file, because many files cannot be written in one commit."""

    @property
    def lists_sizes(self) -> bool:
        """True if `list` finds every file, with its size."""
        return True

    @property
    @abc.abstractmethod
    def place(self) -> str:
        """Folder or URL for messages, without secrets."""

    # -- what an implementation gives -------------------------------------------------------------

    @abc.abstractmethod
    def _read(self, path: str, start: int | None = None, end: int | None = None) -> bytes:
        """Bytes of a file, or of a range of it. Raises FileNotFoundError."""

    @abc.abstractmethod
    def _write(self, path: str, data: bytes) -> None:
        """Write a file in place of what is there."""

    @abc.abstractmethod
    def _create(self, path: str, data: bytes) -> None:
        """Write a file that is not there, as one atomic operation if the storage has one. Raises FileExistsError."""

    @abc.abstractmethod
    def _remove(self, path: str) -> None:
        """Remove a file. Raises FileNotFoundError."""

    @abc.abstractmethod
    def _list(self) -> dict[str, StoredFile]:
        """Every file, hidden ones too. Raises FileNotFoundError if nothing is there."""

    @abc.abstractmethod
    def _size(self, path: str) -> int | None:
        """Bytes of a file as the storage has it now. Raises FileNotFoundError."""

    @abc.abstractmethod
    def _send(self, local: Path, path: str) -> None:
        """Copy a local file to a path."""

    def _same(self, file: Digested, local: Path) -> bool:
        """Return True if a stored file of the right size has a local file's bytes; read it unless the storage knows."""
        return self._sha256(file) == file.sha256

    def _fetch(self, file: Digested, partial: Path, root: Path) -> None:
        """Bring a file to `partial`, after the bytes that are there from an interrupted try."""
        have = partial.stat().st_size if partial.exists() else 0
        if have > file.bytes:
            partial.unlink()
            have = 0
        with partial.open("ab") as out:
            while have < file.bytes:
                piece = self._read(file.path, have, min(have + PIECE, file.bytes))
                if not piece:
                    raise WrongBytes(f"it ends after {have} of {file.bytes} bytes")
                out.write(piece)
                out.flush()
                have += len(piece)

    # -- small files ------------------------------------------------------------------------------

    def read(self, path: str, sha256: str | None = None) -> bytes | None:
        """A small file's bytes, None if it is not there.

        Args:
          sha256: that it must have; other bytes count as a failed try.
        """

        def attempt() -> bytes | None:
            try:
                data = self._read(path)
            except ABSENT:
                return None
            if sha256 not in (None, sha256_bytes(data)):
                raise WrongBytes("it does not have its digest")
            return data

        return self._attempt(path, attempt, "read")

    def write(self, path: str, data: bytes) -> None:
        """Write a small file, in place of what is there."""
        self._attempt(path, lambda: self._write(path, data), "write")

    def create(self, path: str, data: bytes) -> bool:
        """Write a small file unless one is there; False if one is. Atomic on local disks, S3 and the Hub.

        Raises:
          StoreError: there is no such bucket or folder, or see the class.
        """

        def attempt() -> bool:
            try:
                self._create(path, data)
            except FileExistsError:
                return False
            except FileNotFoundError as error:
                kind = "bucket" if is_url(self.place) else "folder"
                raise StoreError(f"{self.place}: {reason(error)}; create the {kind} first") from None
            return True

        return self._attempt(path, attempt, "write")

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""

        def attempt() -> None:
            with contextlib.suppress(*ABSENT):
                self._remove(path)

        self._attempt(path, attempt, "write")

    def list(self) -> dict[str, StoredFile]:
        """Every file by path, hidden ones (locks, and files in the making) apart; empty if nothing is there."""

        def attempt() -> dict[str, StoredFile]:
            try:
                found = self._list()
            except ABSENT:
                return {}
            return {path: file for path, file in found.items() if not f"/{path}".count("/.")}

        return self._attempt("the list of files", attempt, "read")

    def size(self, path: str) -> int | None:
        """Bytes of a file, None if it is not there (or the storage does not say)."""

        def attempt() -> int | None:
            try:
                return self._size(path)
            except ABSENT:
                return None

        return self._attempt(path, attempt, "read")

    # -- files with digests -----------------------------------------------------------------------

    def sha256(self, file: Digested) -> str:
        """The SHA-256 of a stored file, read piece by piece.

        Raises:
          StoreError: it is not there, or see the class.
        """
        return self._attempt(file.path, lambda: self._sha256(file), "read")

    def _sha256(self, file: Digested) -> str:
        digest = hashlib.sha256()
        for start in range(0, file.bytes, PIECE):
            end = min(start + PIECE, file.bytes)
            piece = self._read(file.path, start, end)
            if len(piece) > end - start:  # the whole file; `_fetch` can use that, a digest of pieces cannot
                raise StoreError(without_parts(self.place))
            digest.update(piece)
        return digest.hexdigest()

    def upload(self, root: Path, file: Digested, fresh: bool = False) -> bool:
        """Copy a file from the same path below a local folder, and check that it arrived; False if it was there.

        Args:
          fresh: nothing is known to be there, so do not look first.

        Raises:
          StoreError: the local file does not have its digest, or see the class.
        """
        local, looked = checked(root, file), not fresh

        def holds() -> bool:
            try:
                return self._size(file.path) == file.bytes and self._same(file, local)
            except ABSENT:
                return False

        def attempt() -> bool:
            nonlocal looked
            if looked and holds():
                return False
            looked = True  # after a failure it may be there all the same
            self._send(local, file.path)
            if not holds():
                raise WrongBytes("it arrived with other bytes")
            return True

        return self._attempt(file.path, attempt, "move")

    def download(self, file: Digested, root: Path) -> bool:
        """Copy a file to the same path below a local folder, checked and resumed; False if it was there already.

        Raises:
          StoreError: it is not there, it does not have its digest, or see the class.
        """
        local = root / file.path
        if local.is_file() and local.stat().st_size == file.bytes and sha256_file(local) == file.sha256:
            return False
        local.parent.mkdir(parents=True, exist_ok=True)
        partial = unfinished(local)

        def attempt() -> bool:
            self._fetch(file, partial, root)
            if partial.stat().st_size != file.bytes or sha256_file(partial) != file.sha256:
                partial.unlink()
                raise WrongBytes("it does not have its digest")
            partial.replace(local)
            return True

        return self._attempt(file.path, attempt, "move")

    # -- publishing -------------------------------------------------------------------------------

    def begin(self) -> None:  # noqa: B027
        """Make it ready to be published to, for storages with something to make first."""

    def upload_all(
        self, root: Path, files: Sequence[Digested], workers: int, tick: ProgressCallback = ignore, fresh: bool = False
    ) -> int:
        """`upload` many files, `workers` at a time; gives how many were not there. `tick` is called with 1 for each."""
        return sum(in_parallel(lambda file: self.upload(root, file, fresh), files, workers, lambda _: tick(1)))

    def write_last(self, contents: Mapping[str, bytes], new: bool = False) -> bool:
        """Write small files in order; those that make what was uploaded a release.

        Args:
          new: the last one must not be there yet.

        Returns:
          False if it was there. Then nothing is written, unless another process wrote it at the same moment.
        """
        *others, (path, data) = contents.items()
        if new and self.size(path) is not None:
            return False
        for other, content in others:
            self.write(other, content)
        if new:
            return self.create(path, data)
        self.write(path, data)
        return True

    def tag(self, name: str, message: str) -> None:  # noqa: B027
        """Give what is published a name, for storages with versions."""

    def tidy(self, root: Path) -> None:  # noqa: B027
        """Remove what downloads left in a local folder, once all are done."""

    def _attempt(self, path: str, attempt: Callable[[], Result], doing: str) -> Result:
        return retry(self.place, path, attempt, doing)


def unfinished(local: Path) -> Path:
    """The file beside `local` that holds what an interrupted download has brought of it."""
    return local.with_name(local.name + ".partial")


def checked(root: Path, file: Digested) -> Path:
    """A local file that has its digest.

    Raises:
      StoreError: its bytes have another digest, or it cannot be read.
    """
    local = root / file.path
    with storage_errors(local):
        if local.is_file() and local.stat().st_size == file.bytes and sha256_file(local) == file.sha256:
            return local
    raise StoreError(f"{local} does not have its digest; run `dmcvb-gen regenerate` on the release first")


def retry(place: str, path: str, attempt: Callable[[], Result], doing: str) -> Result:
    """Call `attempt` until it succeeds, at most ATTEMPTS times.

    Args:
      doing: what it does to `path`, in a word; "read" if nothing is written, here or there.

    Raises:
      StoreError: access is refused, the disk is full, or it never succeeded.
    """
    import tenacity  # only if something is sent or fetched

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
                f"no room for {path} ({error.strerror}); transferred files are kept; make room and rerun the command"
            ) from None
        cure = "check the place and the network" if doing == "read" else "transferred files are kept"
        raise StoreError(
            f"cannot {doing} {path} of {place} after {ATTEMPTS} tries ({reason(error)}); {cure}; rerun the same command"
        ) from None


def _may_pass(error: BaseException) -> bool:
    """Return True if trying again may help."""
    if isinstance(error, StoreError) or not isinstance(error, Exception) or is_refusal(error):
        return False
    return not (isinstance(error, OSError) and error.errno in NO_ROOM)


def in_parallel(
    work: Callable[[Any], Result], items: Iterable[Any], workers: int, tick: Callable[[Result], object] = ignore
) -> list[Result]:
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
