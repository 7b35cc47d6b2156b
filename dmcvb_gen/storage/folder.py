"""A folder on this machine, or one that several machines share."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock

from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.interface import ANY, PIECE, Store

LOCK = ".lock"
"""File that is locked to replace a file, and to create one where the disk knows no links."""
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW


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

    # -- reading ----------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _parent(self, path: str, make: bool = False) -> Iterator[tuple[int, str]]:
        """A handle of the folder that a path lies in, and its name there; links on the way are refused."""
        *folders, name = path.split("/")
        if make:
            self.folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            for folder in folders:
                if make:
                    with contextlib.suppress(FileExistsError):
                        os.mkdir(folder, dir_fd=handle)
                try:
                    below = os.open(folder, _FOLDER, dir_fd=handle)
                except NotADirectoryError:
                    self._refuse_link(folder, handle, path)
                    raise
                os.close(handle)
                handle = below
            yield handle, name
        finally:
            os.close(handle)

    def _refuse_link(self, name: str, parent: int, path: str) -> None:
        mode = os.stat(name, dir_fd=parent, follow_symlinks=False).st_mode
        if stat.S_ISLNK(mode):
            raise StoreError(f"{name} in {self.folder}/{path} is a link; a release holds files and folders alone")

    def _check_regular(self, status: os.stat_result, path: str) -> os.stat_result:
        if not stat.S_ISREG(status.st_mode):
            raise StoreError(f"{self.folder}/{path} is not a regular file; a release holds files and folders alone")
        return status

    def _status(self, path: str) -> os.stat_result:
        with self._parent(path) as (parent, name):
            return self._check_regular(os.stat(name, dir_fd=parent, follow_symlinks=False), path)

    def _size(self, path: str) -> int:
        return self._status(path).st_size

    def _read(self, path: str, start: int, length: int) -> bytes:
        with self._parent(path) as (parent, name):
            try:
                handle = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=parent)
            except OSError as error:
                if error.errno in (errno.ELOOP, errno.ENXIO):  # a link, or a socket
                    self._check_regular(os.stat(name, dir_fd=parent, follow_symlinks=False), path)
                raise
        try:
            size = self._check_regular(os.fstat(handle), path).st_size
            with open(handle, "rb", closefd=False) as file:
                file.seek(start)
                return file.read(max(0, min(length, size - start)))
        finally:
            os.close(handle)

    def _version(self, path: str) -> str:
        digest = hashlib.sha256()
        for piece in self._pieces(path, self._size(path)):
            digest.update(piece)
        return digest.hexdigest()

    def _list(self, prefix: str) -> Mapping[str, int]:
        found, folders = {}, [prefix]
        while folders:
            folder = folders.pop()
            with self._parent(f"{folder}/x".lstrip("/")) as (handle, _), os.scandir(handle) as entries:
                for entry in entries:
                    path = f"{folder}/{entry.name}".lstrip("/")
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(path)
                    elif entry.is_file(follow_symlinks=False):
                        with contextlib.suppress(FileNotFoundError):  # another process removed it
                            found[path] = entry.stat(follow_symlinks=False).st_size
        return found

    # -- writing ----------------------------------------------------------------------------------

    def _create(self, path: str, data: bytes | Path, move: bool) -> None:
        with self._parent(path, make=True) as (parent, name):
            try:
                if move and isinstance(data, Path):
                    _flush(data)
                    os.link(data, name, dst_dir_fd=parent, follow_symlinks=False)
                else:
                    _write_unnamed(data, parent, name)
            except FileExistsError:
                raise
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EIO):
                    raise
                self._create_locked(data, parent, name)  # the disk knows no such links
            os.fsync(parent)

    def _create_locked(self, data: bytes | Path, parent: int, name: str) -> None:
        with self._lock():
            with contextlib.suppress(FileNotFoundError):
                os.stat(name, dir_fd=parent, follow_symlinks=False)
                raise FileExistsError(name)
            _write_over(data, parent, name)

    def _replace(self, path: str, data: bytes, expected: str | None) -> bool:
        with self._parent(path, make=True) as (parent, name), self._lock():
            if expected != ANY and self._now(path) != expected:
                return False
            _write_over(data, parent, name)
            os.fsync(parent)
        return True

    def _now(self, path: str) -> str | None:
        try:
            return self._version(path)
        except FileNotFoundError:
            return None

    def _lock(self) -> FileLock:
        return FileLock(self.folder / LOCK, is_singleton=False, thread_local=False)

    def _delete(self, path: str) -> None:
        with self._parent(path) as (parent, name):
            os.unlink(name, dir_fd=parent)


def _flush(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _write(data: bytes | Path, handle: int) -> None:
    """Write bytes, or a file's, to an open file, and flush it to the disk."""
    with open(handle, "wb", closefd=False) as out:
        if isinstance(data, Path):
            with data.open("rb") as source:
                shutil.copyfileobj(source, out, PIECE)
        else:
            out.write(data)
        out.flush()
        os.fsync(handle)


def _write_unnamed(data: bytes | Path, parent: int, name: str) -> None:
    """Write a file that gets its name when it is whole, so that a killed process leaves nothing behind."""
    handle = os.open(".", os.O_TMPFILE | os.O_WRONLY, 0o666, dir_fd=parent)
    try:
        _write(data, handle)
        # With a folder's handle, Python follows the link that /proc has for an open file.
        os.link(f"/proc/self/fd/{handle}", name, src_dir_fd=parent, dst_dir_fd=parent, follow_symlinks=True)
    finally:
        os.close(handle)


def _write_over(data: bytes | Path, parent: int, name: str) -> None:
    """Write a file beside another and put it in its place; who holds the lock may use the same name again."""
    partial = f".{name}.partial"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(partial, dir_fd=parent)
    handle = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW, 0o666, dir_fd=parent)
    try:
        _write(data, handle)
        os.replace(partial, name, src_dir_fd=parent, dst_dir_fd=parent)
    except BaseException:
        os.unlink(partial, dir_fd=parent)
        raise
    finally:
        os.close(handle)
