"""A folder on this machine, or one that several machines share."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from dmcvb_gen import files
from dmcvb_gen.storage.base import Result, Storage, StoredFile
from dmcvb_gen.storage.remote import public, storage_errors

_LINKING = threading.Lock()
"""Held while a file with several names is sent."""


@dataclass(frozen=True)
class LocalStorage(Storage):
    """Files in a folder. Each is whole or not there, and flushed to the disk.

    Attributes:
      folder: need not be there yet.
      url: the file: URL that it was given as.
    """

    folder: Path
    url: str = ""
    _sent: dict[tuple, str] = field(default_factory=dict, compare=False, repr=False)
    """Local files with several names that were sent -> their path here; their other names become links."""
    _tidied: set[Path] = field(default_factory=set, compare=False, repr=False)
    """Folders without files that killed processes left in the making."""

    @property
    def place(self) -> str:
        return public(self.url).rstrip("/") or str(self.folder)

    def _attempt(self, path: str, attempt: Callable[[], Result], doing: str) -> Result:
        def explained() -> Result:
            if self.url or doing == "move":  # which touches another folder, too
                return attempt()
            with storage_errors(self.folder / path, "read" if doing == "read" else "write to"):
                return attempt()

        return super()._attempt(path, explained, doing)

    def _read(self, path: str, start: int | None = None, end: int | None = None) -> bytes:
        if start is None or end is None:
            return (self.folder / path).read_bytes()
        with (self.folder / path).open("rb") as file:
            file.seek(start)
            return file.read(end - start)

    def _write(self, path: str, data: bytes) -> None:
        self._tidy(path)
        files.write_bytes(self.folder / path, data)

    def _tidy(self, path: str) -> None:
        """Delete what killed processes left beside a file that is about to be written, once for each folder."""
        parent = (self.folder / path).parent
        if parent not in self._tidied:
            self._tidied.add(parent)
            files.remove_partial(parent, below=False)

    def _create(self, path: str, data: bytes) -> None:
        target = self.folder / path
        files.remove_partial(target.parent, below=False)
        with files.replacing(target, new=True) as temporary:  # whole or not there; a file opened as a new one is not
            temporary.write_bytes(data)

    def _remove(self, path: str) -> None:
        (self.folder / path).unlink()

    def _list(self) -> dict[str, StoredFile]:
        found = {}
        for parent, folders, names in os.walk(self.folder):  # passes over what others remove meanwhile
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in names:
                path = Path(parent) / name
                with contextlib.suppress(FileNotFoundError):
                    stat = path.stat()
                    found[path.relative_to(self.folder).as_posix()] = StoredFile(stat.st_size, stat.st_mtime)
        return found

    def _size(self, path: str) -> int:
        return (self.folder / path).stat().st_size

    def _send(self, local: Path, path: str) -> None:
        self._tidy(path)
        node = local.stat()
        if node.st_nlink == 1:
            return files.copy_file(local, self.folder / path)
        key = (node.st_dev, node.st_ino, node.st_size, node.st_mtime_ns)
        with _LINKING:  # of two names that are sent at once, the second becomes a link
            twin = self._sent.get(key)
            if twin not in (None, path):
                with contextlib.suppress(OSError), files.replacing(self.folder / path) as temporary:
                    temporary.unlink()
                    os.link(self.folder / twin, temporary)
                    return None
            files.copy_file(local, self.folder / path)
            self._sent[key] = path
        return None
