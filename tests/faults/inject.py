"""A fault at the k-th change that this process makes below a folder: killed there, a full disk from there on, Ctrl-C.

Python tells an audit hook of every file that is opened, renamed, removed or made, just before it happens, in every
thread. So nothing of the code under test is replaced, and a process can end between any two of its file operations.
Ends within a write come from the limit of the size of a file: the kernel stops the process at that very byte.
"""

from __future__ import annotations

import errno
import os
import resource
import signal
import sys

MODES = ("kill", "full", "interrupt", "cut", "quota")
"""kill: SIGKILL before the operation. full: it and all later ones that need room find none. interrupt: SIGINT.
cut: killed while a file is written, at byte `at`. quota: no file can grow beyond byte `at`."""
_CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.chmod", "os.utime"}
_NEED_ROOM = {"open", "os.mkdir", "os.rename", "os.link"}


class Counter:
    """Counts a process's changes below `root`, and strikes at the `at`-th (from 0); never with at=None."""

    def __init__(self, root: str, mode: str = "kill", at: int | None = None):
        self.root, self.mode, self.at, self.count = os.path.abspath(root), mode, at, 0

    def __call__(self, event: str, arguments: tuple) -> None:
        if event == "open":
            path, mode, flags = arguments
            if not (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                return
        elif event in _CHANGES:
            path = arguments[0]
        else:
            return
        if not isinstance(path, (str, os.PathLike)) or not os.path.abspath(path).startswith(self.root):
            return
        number, self.count = self.count, self.count + 1
        if self.at is None or number < self.at:
            return
        if self.mode == "full":
            if event in _NEED_ROOM:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        elif number == self.at:
            os.kill(os.getpid(), signal.SIGKILL if self.mode == "kill" else signal.SIGINT)


def arm(root: str, mode: str | None = None, at: int | None = None) -> Counter:
    """Set a fault for the rest of this process, which is meant to be a child made for one operation.

    Args:
      mode: one of MODES, None for no fault (operations are counted all the same).
    """
    counter = Counter(root, mode or "kill", at if mode in ("kill", "full", "interrupt") else None)
    if mode in ("cut", "quota"):
        # By default Python ignores the signal, and the write fails with EFBIG as on a disk with a quota.
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if mode == "cut" else signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (at, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    sys.addaudithook(counter)
    return counter
