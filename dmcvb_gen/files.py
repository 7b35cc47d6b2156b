"""Files that are whole or not there: bytes, text or JSON in, a file put in place at once, flushed to the disk.

A file in the making has a name of its own that ends in `PARTIAL`, beside the one that it becomes, so writers never
disturb each other and whatever has that ending may be deleted once its writer is gone.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PARTIAL = ".partial"
"""Ending of files in the making."""


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a fresh path to write to; when the block ends well, that file takes the place of `path`, else it goes.

    For writers that want a path; what they write is flushed to the disk before it is put in place.

    Raises:
      OSError: the folder cannot be made or written.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=PARTIAL)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp's files are their owner's alone
        os.replace(temporary, path)
        _flush_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _umask() -> int:
    """The process's mask of new files' rights, which can only be read by setting it (or from /proc, without)."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("Umask:"):
                return int(line.split()[1], 8)
    except OSError:
        pass
    return 0o022


def _flush_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the file system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return  # not every system opens folders
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


def write_bytes(path: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Put `data` in place of the file at `path`, whole or not at all.

    Raises:
      OSError: it cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)


def write_text(path: str | Path, text: str) -> None:
    """Put `text` (UTF-8) in place of the file at `path`, see `write_bytes`."""
    write_bytes(path, text.encode())


def json_bytes(value: Any) -> bytes:
    """A value (plain, or a pydantic model) as the JSON that the files of a release hold."""
    if hasattr(value, "model_dump"):
        value = value.model_dump(mode="json")
    return (json.dumps(value, indent=1) + "\n").encode()


def write_json(path: str | Path, value: Any) -> None:
    """Put `value` (plain, or a pydantic model) as JSON in place of the file at `path`, see `write_bytes`."""
    write_bytes(path, json_bytes(value))


def copy_file(source: str | Path, target: str | Path) -> None:
    """Copy a file so that `target` is whole or not there, see `write_bytes`."""
    with Path(source).open("rb") as read, replacing(target) as temporary, temporary.open("wb") as file:
        while piece := read.read(1 << 20):
            file.write(piece)


def remove_partial(folder: str | Path) -> None:
    """Delete what killed writers left in a folder (and below); call it only where no writer is at work."""
    for path in Path(folder).rglob(f"*{PARTIAL}"):
        if path.is_file():
            path.unlink(missing_ok=True)


def sha256_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, in hex."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_bytes(data: bytes) -> str:
    """SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()
