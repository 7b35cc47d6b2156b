"""Arrays of float32 rows in memory-mapped files that outlive the process."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from dmcvb_gen.errors import DmcvbError


def rows_in(path: Path, shape: tuple[int, ...]) -> int:
    """Whole rows of `shape` that a file holds; 0 if there is none."""
    return path.stat().st_size // (4 * int(np.prod(shape))) if path.exists() else 0


def check_rows(folder: Path, found: int, position: int, full: bool, rows: int) -> None:
    """Refuse to resume a run whose replay buffer is gone: it would learn from zeros.

    Args:
      folder: the run's folder.
      found: rows that the buffer's files held before they were opened.
      position, full, rows: the buffer as it was saved.

    Raises:
      DmcvbError: the files hold fewer rows than were saved.
    """
    if found < (rows if full else position):
        raise DmcvbError(
            f"{folder} cannot be resumed: its replay buffer (resume/*.f32) is gone or cut; start again with another "
            "--out"
        )


def map_rows(path: Path, rows: int, shape: tuple[int, ...]) -> np.memmap:
    """Open a file of rows, keeping what it holds; it grows to `rows` if it has fewer, with zeros.

    The file takes its whole room on the disk at once: a disk that fills up later would kill the process at a
    write to the mapping (SIGBUS), where nothing can be said about it.

    Args:
      shape: shape of one row.

    Returns:
      (rows or more, *shape) float32.

    Raises:
      OSError: there is no room; the file is what it was.
    """
    found = rows_in(path, shape)
    rows = max(rows, found)
    size, before = rows * 4 * int(np.prod(shape)), path.stat().st_size if path.exists() else None
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(handle, 0, size)
        os.ftruncate(handle, size)
    except OSError:
        if before is None:
            path.unlink()
        else:
            os.ftruncate(handle, before)
        raise
    finally:
        os.close(handle)
    return np.memmap(path, np.float32, "r+", shape=(rows, *shape))
