"""Work done side by side: functions and arguments in, results as they come; in this process or in fresh ones.

::

    with open_pool(workers=4, tick=bar.update) as pool:
        for job in jobs:
            pool.submit(job, run_job, job)      # run_job(job, tick=...) in a worker
        for job, result in pool.results():
            ...                                 # may submit more

Functions and arguments travel by pickle between processes of one program and user; nothing is unpickled from a file.
"""

from __future__ import annotations

import abc
import atexit
import itertools
import multiprocessing
import os
import queue
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from typing import Any, TypeVar

from dmcvb_gen.errors import StoreError

Item = TypeVar("Item")
Tick = Callable[..., None]
"""Told by the functions at work how far they are; called in the process that asked for the work."""

IN_FLIGHT = 2
"""Pieces of work handed out for each worker: one at work, one that waits for it."""
POLL_SECONDS = 0.2
"""How often progress is passed on while no result comes."""
KEPT = "what was committed is safe: run the same command again"


def ignore(*_) -> None:
    """A tick for callers that show no progress."""


class Later:
    """A result that is on its way while its worker goes on with something else.

    Args:
      wait: gives the result once it is there, or raises what went wrong.
    """

    def __init__(self, wait: Callable[[], Any]):
        self.wait = wait


class Pool(abc.ABC):
    """Where functions are run; a context manager that ends its workers when it is left, at once on an error.

    `submit(key, function, *arguments)` has `function(*arguments, tick=...)` run; `results()` gives (key, result) as
    they come, until nothing is left of what was submitted, then or meanwhile. The first exception of a function is
    raised by `results()`. A function may give a `Later`: its worker takes the next piece of work, and the result comes
    when it is there.
    """

    @abc.abstractmethod
    def submit(self, key: Any, function: Callable, *arguments: Any) -> None:
        """Have `function(*arguments, tick=...)` run; `key` comes back with its result."""

    @abc.abstractmethod
    def results(self) -> Iterator[tuple[Any, Any]]:
        """(key, result) of all that was submitted, as they come.

        Raises:
          StoreError: a worker was killed.
        """

    def close(self, at_once: bool = False) -> None:  # noqa: B027 (nothing to end by default)
        """End the workers; with `at_once`, also what they are doing."""

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, kind, *_) -> None:
        self.close(at_once=kind is not None)


class SerialPool(Pool):
    """One after the other, in this process, when the result is asked for."""

    def __init__(self, tick: Tick = ignore):
        self._tick, self._waiting = tick, deque()

    def submit(self, key, function, *arguments):
        self._waiting.append((key, function, arguments))

    def results(self):
        late: deque[tuple[Any, Later]] = deque()
        while self._waiting or late:
            if self._waiting:
                key, function, arguments = self._waiting.popleft()
                result = function(*arguments, tick=self._tick)
                if not isinstance(result, Later):
                    yield key, result
                    continue
                late.append((key, result))
            while late and (len(late) > 1 or not self._waiting):
                key, later = late.popleft()
                yield key, later.wait()


class ProcessPool(Pool):
    """In processes that are started fresh (never forked: MuJoCo, torch and OpenGL do not survive that).

    Workers leave Ctrl-C to the process that started them, end on SIGTERM, and end when that process is gone.

    Args:
      workers: processes, started as they are needed.
      threads: of a worker's own libraries.
      tick: told what the functions tell.
      kept: what to say of the work done so far when a worker was killed.
    """

    def __init__(self, workers: int, threads: int = 1, tick: Tick = ignore, kept: str = KEPT):
        context = multiprocessing.get_context("spawn")
        self._workers, self._tick, self._kept = workers, tick, kept
        self._ticks, self._late = context.Queue(), context.Queue()
        queues = (self._ticks, self._late)
        self._pool = ProcessPoolExecutor(workers, context, initializer=_start, initargs=(*queues, threads))
        self._waiting: deque = deque()
        self._running: dict[Future, tuple[int, Any]] = {}
        self._on_their_way: dict[int, Any] = {}
        self._numbers = itertools.count()

    def submit(self, key, function, *arguments):
        self._waiting.append((key, function, arguments))

    def results(self):
        try:
            self._hand_out()
            while self._running or self._on_their_way:
                done, _ = wait(self._running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
                self._pass_on()
                for future in done:
                    (number, key), result = self._running.pop(future), future.result()
                    if isinstance(result, _OnItsWay):
                        self._on_their_way[number] = key
                    else:
                        yield key, result
                yield from self._arrived()
                self._hand_out()
        except BrokenProcessPool:
            raise StoreError(
                f"a worker process was killed (out of memory?); {self._kept}, with fewer --workers than "
                f"{self._workers} if it happens again"
            ) from None

    def _hand_out(self) -> None:
        while self._waiting and len(self._running) < IN_FLIGHT * self._workers:
            key, function, arguments = self._waiting.popleft()
            number = next(self._numbers)
            self._running[self._pool.submit(_work, number, function, arguments)] = (number, key)

    def _arrived(self) -> Iterator[tuple[Any, Any]]:
        while self._on_their_way:
            try:
                number, result, error = self._late.get(block=not self._running, timeout=POLL_SECONDS)
            except queue.Empty:
                self._check_alive()
                return
            if number not in self._on_their_way:  # faster than the word that it is on its way
                self._late.put((number, result, error))
                return
            key = self._on_their_way.pop(number)
            if error is not None:
                raise error
            yield key, result

    def _check_alive(self) -> None:
        if not self._running and any(not process.is_alive() for process in (self._pool._processes or {}).values()):
            raise BrokenProcessPool

    def _pass_on(self) -> None:
        try:
            while True:
                self._tick(*self._ticks.get_nowait())
        except queue.Empty:
            pass

    def close(self, at_once=False):
        if at_once:
            for process in list((self._pool._processes or {}).values()):
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pass_on()
        self._ticks.close()
        self._late.close()


def open_pool(workers: int = 1, *, threads: int = 1, tick: Tick = ignore, kept: str = KEPT) -> Pool:
    """A pool of `workers` processes; with one worker, the work is done in this process (on its own threads)."""
    return SerialPool(tick) if workers <= 1 else ProcessPool(workers, threads, tick, kept)


def run_all(
    function: Callable, items: Iterable[Item], workers: int = 1, *, threads: int = 1, tick: Tick = ignore
) -> Iterator[tuple[Item, Any]]:
    """(item, `function(item, tick=...)`) of all items, as they come.

    Raises:
      StoreError: a worker was killed.
    """
    items = list(items)
    with open_pool(min(workers, max(len(items), 1)), threads=threads, tick=tick) as pool:
        for item in items:
            pool.submit(item, function, item)
        yield from pool.results()


# -- in a worker ----------------------------------------------------------------------------------


_ticks: multiprocessing.Queue | None = None
_late: multiprocessing.Queue | None = None


class _OnItsWay:
    """Stands for a `Later`, which stays in its worker."""


def _start(ticks, late, threads: int) -> None:
    global _ticks, _late
    _ticks, _late = ticks, late
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    limit_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    atexit.register(os._exit, 0)  # taking the interpreter apart lasts seconds and saves nothing


def limit_threads(threads: int) -> None:
    """Have the libraries that this process imports (or has imported, as far as they listen) use `threads` threads."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = str(threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _tell(*facts: Any) -> None:
    _ticks.put(facts)


def _work(number: int, function: Callable, arguments: tuple) -> Any:
    result = function(*arguments, tick=_tell)
    if not isinstance(result, Later):
        return result
    threading.Thread(target=_wait, args=(number, result), daemon=True).start()
    return _OnItsWay()


def _wait(number: int, later: Later) -> None:
    try:
        _late.put((number, later.wait(), None))
    except BaseException as error:
        _late.put((number, None, error))
