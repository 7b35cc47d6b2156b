"""A folder on this machine, or one that several machines share."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import LASTING, creating, flush_folder, sha256_file
from dmcvb_gen.storage.interface import ANY, PIECE, Store

LOCK = ".lock"
"""File that is locked to replace a file, and to create one where the disk knows no links."""


@dataclass(frozen=True)
class LocalStore(Store):
    """Files in a folder, each whole or not there, and flushed to the disk. No link below the root is followed.

    Attributes:
      folder: need not be there yet; may be a link itself.
    """

    folder: Path

    @property
    def place(self) -> str:
        return str(self.folder)

    def _at(self, path: str) -> Path:
        """The path on this machine; what leads through a link is refused."""
        full = self.folder
        for part in path.split("/") if path else ():
            full = full / part
            if full.is_symlink():
                raise StoreError(f"{full} is a link; a release holds files and folders alone")
        return full

    def _regular(self, path: str) -> tuple[Path, int]:
        """The path of a regular file, and its size."""
        full = self._at(path)
        status = full.lstat()
        if not stat.S_ISREG(status.st_mode):
            raise StoreError(f"{full} is not a regular file; a release holds files and folders alone")
        return full, status.st_size

    def _size(self, path: str) -> int:
        return self._regular(path)[1]

    def _read(self, path: str, start: int, length: int) -> bytes:
        full, size = self._regular(path)
        with full.open("rb") as file:
            file.seek(start)
            return file.read(max(0, min(length, size - start)))

    def _version(self, path: str) -> str:
        return sha256_file(self._regular(path)[0])

    def _list(self, prefix: str) -> Mapping[str, int]:
        found = {}
        for parent, folders, names in os.walk(self._at(prefix)):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for path in (Path(parent, name) for name in names):
                with contextlib.suppress(FileNotFoundError):  # another process removed it
                    status = path.lstat()
                    if stat.S_ISREG(status.st_mode):
                        found[path.relative_to(self.folder).as_posix()] = status.st_size
        return found

    def _create(self, path: str, data: bytes | Path) -> None:
        full = self._at(path)
        full.parent.mkdir(parents=True, exist_ok=True)
        try:
            with creating(full) as out:
                _write(data, out)
        except OSError as error:
            if error.errno in LASTING:
                raise
            with self._lock():  # the disk knows no such links
                if os.path.lexists(full):
                    raise FileExistsError(path) from None
                _write_over(data, full)
        flush_folder(full.parent)

    def _replace(self, path: str, data: bytes, expected: str | None) -> bool:
        full = self._at(path)
        full.parent.mkdir(parents=True, exist_ok=True)
        with self._lock():
            if expected != ANY and expected != (self._version(path) if os.path.lexists(full) else None):
                return False
            _write_over(data, full)
        flush_folder(full.parent)
        return True

    def _lock(self) -> FileLock:
        return FileLock(self._at(LOCK))

    def _delete(self, path: str) -> None:
        self._at(path).unlink()


def _write(data: bytes | Path, out: BinaryIO) -> None:
    """Write bytes, or a file's, to an open file."""
    if isinstance(data, Path):
        with data.open("rb") as source:
            shutil.copyfileobj(source, out, PIECE)
    else:
        out.write(data)


def _write_over(data: bytes | Path, full: Path) -> None:
    """Write a file beside another and put it in its place; who holds the lock may use the same name again."""
    partial = full.with_name(f".{full.name}.partial")
    partial.unlink(missing_ok=True)
    try:
        with partial.open("xb") as file:
            _write(data, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, full)
    finally:
        partial.unlink(missing_ok=True)
