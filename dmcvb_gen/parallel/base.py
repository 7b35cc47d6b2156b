"""Base of all pools of workers, which run functions and give results as they come."""

from __future__ import annotations

import abc
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from dmcvb_gen.options import Count

ProgressCallback = Callable[..., None]
"""Told by the functions at work how far they are; called in the process that asked for the work. One that can `expect`
is told beforehand how far they will get, see there."""

IN_FLIGHT = 2
"""Pieces of work handed out for each worker: one at work, one that waits for it."""
POLL_SECONDS = 0.2
"""How often progress is passed on while no result comes."""
KEPT = "finished shards are saved: rerun the same command"


def ignore(*_) -> None:
    """A tick for callers that show no progress."""


def expect(tick: ProgressCallback, count: float) -> None:
    """Tell a tick how much it will have been told at the end (by the best guess so far), if it has an `expect`."""
    getattr(tick, "expect", ignore)(count)


class Pool(abc.ABC):
    """Pool of workers; a context manager that ends its workers when it is left, at once on an error.

    `submit(key, function, *arguments)` has `function(*arguments, tick=...)` run; `results()` gives (key, result) as
    they come, until nothing is left of what was submitted, then or meanwhile. The first exception of a function is
    raised by `results()`.

    Args:
      tick: called with what the functions report.
    """

    def __init__(self, tick: ProgressCallback = ignore):
        self._tick = tick
        self._waiting: deque[tuple[Any, Callable, tuple]] = deque()

    def submit(self, key: Any, function: Callable, *arguments: Any) -> None:
        """Have `function(*arguments, tick=...)` run; `key` comes back with its result."""
        self._waiting.append((key, function, arguments))

    @abc.abstractmethod
    def results(self) -> Iterator[tuple[Any, Any]]:
        """(key, result) of all that was submitted, as they come.

        Raises:
          StoreError: a worker was killed.
        """

    def memory_each(self) -> int | None:
        """Bytes of memory for each piece of work at a time, if the pool places work by it; else None."""
        return None

    def close(self, at_once: bool = False) -> None:  # noqa: B027 (nothing to end by default)
        """End the workers; with `at_once`, also what they are doing."""

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, kind, *_) -> None:
        self.close(at_once=kind is not None)


class SerialPool(Pool):
    """Pool that runs its work in this process, one piece after another, when results are asked for."""

    def results(self):
        while self._waiting:
            key, function, arguments = self._waiting.popleft()
            yield key, function(*arguments, tick=self._tick)


@dataclass(frozen=True)
class Needs:
    """Resources of a piece of work: CPU cores, bytes of memory, a share of a GPU."""

    cpus: float = 1
    memory: int | None = None
    gpus: float = 0


@dataclass(frozen=True)
class Ray:
    """A Ray cluster to work on, in place of a number of processes.

    Attributes:
      address: of the cluster; None: what RAY_ADDRESS says, else one on this machine.
    """

    address: str | None = None


Workers = Count | Ray
"""Executor of the work: so many processes (1: this one), or a Ray cluster."""


def limit_threads(threads: int) -> None:
    """Have the libraries that this process imports (or has imported, as far as they listen) use `threads` threads."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = str(threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
