"""Commands run in children forked from a process that has imported everything; killed and limited."""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.faults.inject import arm

PATIENCE = 1200
"""Seconds after which a command counts as hung."""
GRACE = 20
"""Seconds that what a command has started may outlive it."""


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code (minus the signal that killed it), what it said, how long it took.

    Attributes:
      stray: processes that it left behind.
    """

    code: int
    said: str
    seconds: float
    stray: tuple[int, ...] = ()


class Command:
    """A command at work, in a session of its own.

    What it prints goes into a large pipe, so that no full disk and no limit of a file's size can touch that.

    Args:
      arguments: of `dmcvb-gen`.
      strike: (mode, k) of `inject.arm` for changes below `below`.
    """

    def __init__(self, arguments: Sequence[str], below: Path, strike: tuple[str, int] | None = None):
        self._started = time.time()
        self._said, writing = os.pipe()
        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 1 << 20)
        self.pid = os.fork()
        if self.pid == 0:
            _live(list(arguments), writing, below, strike)
        os.close(writing)

    def alive(self) -> bool:
        found, status = os.waitpid(self.pid, os.WNOHANG)
        if found:
            self._status = status
        return not found

    def finish(self, after: float | None = None, act: Callable[[Command], bool] = lambda command: False) -> Ended:
        """Wait for its end; `after` so many seconds, `act` on it (True: that struck)."""
        hung = False
        while self.alive():
            elapsed = time.time() - self._started
            if after is not None and elapsed >= after and (act(self) or elapsed > after + 2):
                after = None
            if elapsed > PATIENCE and not hung:
                hung = True
                os.killpg(self.pid, signal.SIGKILL)
            time.sleep(0.003)
        seconds = time.time() - self._started
        code = os.waitstatus_to_exitcode(self._status)
        stray = session(self.pid)
        deadline = time.time() + GRACE
        while stray and time.time() < deadline:
            time.sleep(0.05)
            stray = session(self.pid)
        for pid in stray:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with os.fdopen(self._said, "rb") as pipe:
            os.set_blocking(pipe.fileno(), False)
            said = (pipe.read() or b"").decode(errors="replace") + ("\nHUNG" if hung else "")
        return Ended(code, said, seconds, tuple(stray))


def session(leader: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                fields = Path(f"/proc/{entry}/stat").read_text().rsplit(")", 1)[1].split()
                if int(fields[3]) == leader and fields[0] not in "ZX":
                    found.append(int(entry))
    return found


def _live(arguments: list[str], out: int, below: Path, strike: tuple[str, int] | None) -> None:
    """The life of the child; never returns."""
    code = 70
    try:
        os.setsid()
        for stream in (1, 2):
            os.dup2(out, stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if strike:
            arm(str(below), *strike)
        from dmcvb_gen.cli import main

        try:
            main(arguments, prog_name="dmcvb-gen")
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        except KeyboardInterrupt:
            code = 1
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
