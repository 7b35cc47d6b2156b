"""Write files atomically: bytes, text or JSON become a whole file, flushed to the disk, or none.

A file in the making has a name of its own that ends in `PARTIAL`, beside the one that it becomes, so writers never
disturb each other. Its writer holds a lock on it, which the system frees when the process ends: an unlocked one was
left by a killed process.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, BinaryIO

try:
    import fcntl
except ImportError:  # Windows: nothing is locked, so what killed processes left stays
    fcntl = None  # type: ignore[assignment]

PARTIAL = ".partial"
"""Ending of files in the making."""
LASTING = (errno.EEXIST, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS, errno.EIO)
"""Errors that another way of writing would meet, too."""
LARGEST_YAML = 100_000
"""Bytes of a file that a person wrote by hand; PyYAML, which is not fast, takes seconds for it at worst."""


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
    temporary = Path(name)
    try:
        _lock(handle)
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp's files are their owner's alone
        os.replace(temporary, path)
        flush_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(handle)


@contextlib.contextmanager
def creating(path: Path) -> Iterator[BinaryIO]:
    """Give an open file without a name, which becomes `path` when the block ends well; a killed process leaves nothing.

    Raises:
      FileExistsError: something is at `path`; it stays.
      OSError: it cannot be written, or the system or the disk knows no such files (see `LASTING`).
    """
    if not hasattr(os, "O_TMPFILE"):
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP), str(path))
    with os.fdopen(os.open(path.parent, os.O_TMPFILE | os.O_WRONLY, 0o666), "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
        # Given a handle, Python follows the link that /proc has for an open file.
        os.link(f"/proc/self/fd/{file.fileno()}", path, src_dir_fd=file.fileno(), follow_symlinks=True)


def _lock(handle: int) -> bool:
    """Lock an open file or folder for this process; False if another one has locked it, or the disk knows no locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


@functools.cache
def _umask() -> int:
    """The process's mask of new files' rights, which can only be read by setting it."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def flush_folder(folder: Path) -> None:
    """Make a rename last through a power cut, if the file system can."""
    with contextlib.suppress(OSError), _opened(folder) as handle:
        os.fsync(handle)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        yield handle
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


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
      ValueError: it is not JSON, not UTF-8, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_yaml(path: Path | Traversable) -> Any:
    """A small YAML file as plain values.

    Raises:
      OSError: it cannot be read. ValueError: not text, too large, not YAML, or a key is given twice (in a line).
    """
    import yaml  # reading releases needs none

    with path.open("rb") as file:
        content = file.read(LARGEST_YAML + 1)
    if len(content) > LARGEST_YAML:
        raise ValueError(f"over {LARGEST_YAML // 1000} kB, which no settings need")

    class OnceLoader(yaml.SafeLoader):
        """PyYAML itself would keep the last value of a key that is given twice, and drop the others without a word."""

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)
            seen = set()
            for key, _ in node.value:
                name = key.tag, str(key.value)
                if name in seen and not key.tag.endswith(":merge"):  # several merges lose nothing
                    raise ValueError(f"{key.value} is given twice (line {key.start_mark.line + 1}); keep one")
                seen.add(name)
            return node

    try:
        return yaml.load(content.decode(), OnceLoader)
    except UnicodeDecodeError:
        raise ValueError("not text in UTF-8") from None
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())}") from None


def write_json(path: str | Path, value: Any) -> None:
    """Put a plain value as JSON in place of the file at `path`, see `write_bytes`."""
    write_text(path, json.dumps(value, indent=1) + "\n")


@contextlib.contextmanager
def folder_in_the_making(parent: str | Path, name: str) -> Iterator[Path]:
    """A fresh folder in `parent` for files that will be moved to where they belong; it is gone when the block ends.

    Raises:
      OSError: it cannot be made.
    """
    made = Path(tempfile.mkdtemp(dir=parent, prefix=f".{name}.", suffix=PARTIAL))
    try:
        with contextlib.ExitStack() as stack:
            if fcntl is not None:  # Windows opens no folders
                _lock(stack.enter_context(_opened(made)))
            yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def remove_partial(folder: str | Path) -> None:
    """Delete what killed processes left in the making right in a folder; files with a lock stay."""
    for path in Path(folder).glob(f".*{PARTIAL}"):
        with contextlib.suppress(OSError), _opened(path) as handle:  # a link, or gone by now
            if not _lock(handle):
                continue
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def free_bytes(folder: str | Path) -> int:
    """Bytes that are free on the disk where a folder is, or would be."""
    path = Path(folder).absolute()
    return shutil.disk_usage(next(place for place in (path, *path.parents) if place.exists())).free


def sha256_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, in hex."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_if_readable(path: str | Path) -> str | None:
    """SHA-256 of a file's bytes; None if it cannot be read."""
    try:
        return sha256_file(path)
    except OSError:
        return None


def sha256_bytes(data: bytes) -> str:
    """SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()
