"""A fault at the k-th change that this process makes below a folder: killed there, a full disk from there on, Ctrl-C.

Python tells an audit hook of every file that is opened, renamed, removed or made, just before it happens, in every
thread. So nothing of the code under test is replaced, and a process can end between any two of its file operations.
Ends within a write come from the limit of the size of a file: the kernel stops the process at that very byte.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import resource
import signal
import sys
from collections.abc import Iterator

_CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.chmod", "os.utime"}
_NEED_ROOM = {"open", "os.mkdir", "os.rename", "os.link"}


@contextlib.contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file that this process writes meanwhile can grow beyond so many bytes, as on a full disk."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)


def arm(root: str, mode: str, at: int) -> None:
    """Set a fault for the rest of this process, which is meant to be a child made for one operation.

    Args:
      root: folder below which changes count.
      mode: "kill": SIGKILL before the operation; "full": it and all later ones that need room find none; "interrupt":
        SIGINT; "cut": killed while a file is written, at byte `at`; "quota": no file can grow beyond byte `at`.
      at: number of the change to strike at, from 0; of "cut" and "quota" the byte of a file.
    """
    if mode in ("cut", "quota"):
        # By default Python ignores the signal, and the write fails with EFBIG as on a disk with a quota.
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if mode == "cut" else signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (at, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        return
    folder, numbers = os.path.abspath(root), itertools.count()

    def strike(event: str, arguments: tuple) -> None:
        if not _is_change(event, arguments, folder):
            return
        number = next(numbers)
        if mode == "full" and number >= at and event in _NEED_ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))
        if mode != "full" and number == at:
            os.kill(os.getpid(), signal.SIGKILL if mode == "kill" else signal.SIGINT)

    sys.addaudithook(strike)


def _is_change(event: str, arguments: tuple, folder: str) -> bool:
    if event == "open":
        changes = (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    else:
        changes = event in _CHANGES
    if not changes or not isinstance(arguments[0], (str, os.PathLike)):
        return False
    return os.path.abspath(arguments[0]).startswith(folder)
