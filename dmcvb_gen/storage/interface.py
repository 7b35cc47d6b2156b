"""The interface to the files of a release, wherever they are: a place comes in, bytes come out, or one-line errors.

An implementation gives a few methods (`_read`, `_create`, ...) that raise what their client raises. `Store` adds what
all share: bounds, checks of paths, digests while bytes pass, and errors of one line without secrets.
"""

from __future__ import annotations

import abc
import contextlib
import errno
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, Final

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import LASTING, creating, replacing
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.storage.errors import Refused, storage_errors

PIECE = 16 * 2**20
"""Bytes that are in memory at once while a file passes."""
LONGEST_PATH = 1000
"""Characters of a path; S3 takes 1024 bytes."""
ANY: Final = "*"
"""Of `Store.replace`: whatever is there."""


class NotThere(StoreError):
    """There is no such file."""


def check_path(path: str) -> str:
    """A path below a store's root: parts with "/" between, none of them "." or "..", no control characters.

    Raises:
      StoreError: it is none.
    """
    parts = path.split("/")
    if len(path) > LONGEST_PATH or not path.isprintable() or "\\" in path or {"", ".", ".."} & {*parts}:
        raise StoreError(f"{path[:80]!r} is no path below a release; give names with / between")
    return path


class Store(abc.ABC):
    """Files below a folder or URL, by relative path. It pickles, and keeps no client that a fork could break.

    Every method raises StoreError with one line: what failed, where, and the cure.

    Attributes:
      folder: the folder on this machine; None if the files are elsewhere.
      writable: False if files can only be read, or (on the Hub) only be written by `upload` and `finish`.
    """

    folder: Path | None = None
    writable: bool = True

    @property
    @abc.abstractmethod
    def place(self) -> str:
        """Folder or URL for messages, without user, password, query or token."""

    # -- what an implementation gives -------------------------------------------------------------

    @abc.abstractmethod
    def _read(self, path: str, start: int, length: int) -> bytes:
        """At most `length` bytes from `start`; fewer at the file's end. Raises FileNotFoundError."""

    @abc.abstractmethod
    def _size(self, path: str) -> int:
        """Bytes of a file. Raises FileNotFoundError."""

    def _pieces(self, path: str, limit: int) -> Iterator[bytes]:
        """A file's bytes piece by piece, `limit` at most."""
        for start in range(0, limit, PIECE):
            asked = min(PIECE, limit - start)
            piece = self._read(path, start, asked)
            yield piece
            if len(piece) < asked:
                return

    def _list(self, prefix: str) -> Mapping[str, int]:
        """Every file below a folder ("" for all): path -> bytes. Raises FileNotFoundError."""
        raise StoreError(f"{self.place} gives no list of its files; check the URL, or fetch the release first")

    def _create(self, path: str, data: bytes | Path) -> None:
        """Write a file as one atomic operation. Raises FileExistsError."""
        raise self.read_only()

    def _replace(self, path: str, data: bytes, expected: str | None) -> bool:
        """Write a file in place of version `expected` (None: of nothing, ANY: of all); False if that is not there."""
        raise self.read_only()

    def _version(self, path: str) -> str:
        """What names the present content. Raises FileNotFoundError."""
        raise self.read_only()

    def _delete(self, path: str) -> None:
        """Remove a file. Raises FileNotFoundError."""
        raise self.read_only()

    def _secrets(self) -> Sequence[str]:
        """Strings that no message may show."""
        return ()

    def read_only(self) -> StoreError:
        """The error of a place that cannot be written to."""
        return StoreError(f"{self.place} can only be read; give a folder, s3://, gs:// or az://")

    # -- reading ----------------------------------------------------------------------------------

    def read(self, path: str, limit: int) -> bytes:
        """The bytes of a file.

        Args:
          limit: bytes that it may have; no more are brought to memory.

        Raises:
          NotThere: there is no such file. StoreError: it is larger, it is no regular file, or see the class.
        """
        return b"".join(self._bounded(path, limit))

    def find(self, path: str, limit: int) -> bytes | None:
        """The bytes of a file that a place may lack, see `read`; None if it does.

        A server that may not list its files (S3) refuses what is not there: ask where another file could be read.
        """
        try:
            return self.read(path, limit)
        except NotThere:
            return None
        except Refused:
            if self.folder is not None:
                raise
            return None

    def read_range(self, path: str, start: int, length: int) -> bytes:
        """Exactly `length` bytes of a file, from byte `start` on.

        Raises:
          NotThere: there is no such file. StoreError: it ends before, it is no regular file, or see the class.
        """
        with self._errors(path, "read"):
            data = self._read(path, start, length) if length else b""
        if len(data) != length:
            raise StoreError(
                f"{self.place}/{path} is damaged: bytes {start} to {start + length} were asked for, {len(data)} came; "
                "fetch or regenerate it"
            )
        return data

    def size(self, path: str) -> int | None:
        """Bytes of a file; None if it is not there."""
        return self._found(path, lambda: self._size(path), None)

    def sha256(self, path: str, limit: int) -> str:
        """SHA-256 of a file, in hex, read piece by piece.

        Raises:
          NotThere: there is no such file. StoreError: it has more than `limit` bytes, or see the class.
        """
        digest = hashlib.sha256()
        for piece in self._bounded(path, limit):
            digest.update(piece)
        return digest.hexdigest()

    def _bounded(self, path: str, limit: int) -> Iterator[bytes]:
        """A file's bytes piece by piece. Raises StoreError, also if there are more than `limit`."""
        size = 0
        with self._errors(path, "read"):
            for piece in self._pieces(path, limit + 1):
                size += len(piece)
                if size > limit:
                    raise StoreError(f"{self.place}/{path} is larger than the {limit:,} bytes that it may have")
                yield piece

    def version(self, path: str) -> str | None:
        """An opaque name of a file's present content, for `replace`; None if it is not there. Ask before you read."""
        return self._found(path, lambda: self._version(path), None)

    def list(self, prefix: str = "") -> dict[str, int]:
        """Path -> bytes of every file below a folder, hidden ones (a part begins with ".") apart; maybe none."""
        prefix = prefix.strip("/")
        found = self._found(prefix or None, lambda: self._list(prefix), {})
        return {path: size for path, size in sorted(found.items()) if "/." not in f"/{path}"}

    def download(self, path: str, target: str | Path, size: int, sha256: str) -> None:
        """Copy a file to `target` on this machine, whole or not at all; what is there already stays.

        Args:
          size, sha256: that it must have.

        Raises:
          NotThere: there is no such file. StoreError: its bytes are others, there is no room, or see the class.
        """
        target = Path(target)
        with storage_errors(target.parent, "write to"):
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with creating(target) as out:
                    self._bring(path, out, size, sha256)
            except OSError as error:
                if error.errno == errno.EEXIST:
                    return
                if error.errno in LASTING:
                    raise
                with replacing(target) as partial, partial.open("wb") as out:  # the disk knows no such files
                    self._bring(path, out, size, sha256)

    def _bring(self, path: str, out: BinaryIO, size: int, sha256: str) -> None:
        digest = hashlib.sha256()
        for piece in self._bounded(path, size):
            digest.update(piece)
            out.write(piece)
        if out.tell() != size or digest.hexdigest() != sha256:
            raise StoreError(f"{self.place}/{path} does not have the size or SHA-256 of its list; it was not kept")

    def _found(self, path: str | None, look: Callable[[], Any], default: Any) -> Any:
        """What `look` gives; the default if nothing is there."""
        try:
            with self._errors(path, "read"):
                return look()
        except NotThere:
            return default

    # -- writing ----------------------------------------------------------------------------------

    def create(self, path: str, data: bytes | Path) -> bool:
        """Put a file if nothing is there; False, and nothing is written, if something is.

        Args:
          data: its bytes, or a local file that has them.

        Raises:
          StoreError: no room, no right, no bucket, or see the class.
        """
        with self._errors(path, "write to"):
            try:
                self._create(path, data)
            except FileExistsError:
                return False
        return True

    def replace(self, path: str, data: bytes, expected: str | None = ANY) -> bool:
        """Put a file in place of what is there, as one atomic operation.

        Args:
          expected: the `version` that must be there; None if nothing may be; ANY for whatever is.

        Returns:
          False, and nothing is written, if something else is there. What has these very bytes is not something else.
        """
        with self._errors(path, "write to"):
            if self._replace(path, data, expected):
                return True
            try:  # a reply that was lost made a client try twice
                return self._read(path, 0, len(data) + 1) == data
            except FileNotFoundError:
                return False

    def delete(self, path: str) -> None:
        """Remove a file, if it is there."""
        with self._errors(path, "write to"), contextlib.suppress(FileNotFoundError, NotADirectoryError):
            self._delete(path)

    def begin(self) -> None:  # noqa: B027
        """Make the place ready to be published to, if it has something to make first (a repository of the Hub)."""

    def upload(
        self, root: Path, paths: Sequence[str], workers: int = 8, tick: ProgressCallback = ignore
    ) -> Sequence[str]:
        """`create` files of a local folder at the same paths; `tick` is called with 1 for each.

        Returns:
          The paths where something was already; the caller compares its digest.
        """

        def put(path: str) -> str | None:
            made = self.create(path, root / path)
            tick(1)
            return None if made else path

        with ThreadPoolExecutor(max(1, workers)) as pool:
            return [there for there in pool.map(put, paths) if there]

    def finish(self, contents: Mapping[str, bytes], expected: str | None = ANY) -> bool:
        """Put small files in order; the last one, the manifest, in place of version `expected` (see `replace`)."""
        *others, (last, data) = contents.items()
        for path, content in others:
            self.replace(path, content)
        return self.replace(last, data, expected)

    def tag(self, name: str, message: str) -> None:  # noqa: B027
        """Give what was published a name, if the place has versions."""

    # -- errors -----------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _errors(self, path: str | None, doing: str) -> Iterator[None]:
        """Turn what a client raises into one line without secrets. None is the place itself."""
        full = self.place if path is None else f"{self.place}/{check_path(path)}"
        try:
            with storage_errors(full, doing, decoding=True):
                try:
                    yield
                except (FileNotFoundError, NotADirectoryError):
                    if doing != "read":
                        raise
                    raise NotThere(f"{full} is not there; check the path, or fetch or regenerate it") from None
        except DmcvbError as error:
            message = str(error)
            for secret in self._secrets():
                message = message.replace(secret, "...")
            raise type(error)(message) from None
