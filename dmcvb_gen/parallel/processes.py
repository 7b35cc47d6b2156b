"""Work done in fresh processes of this machine: functions and arguments in, results as they come."""

from __future__ import annotations

import atexit
import concurrent.futures
import itertools
import multiprocessing
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from typing import Any

from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel.base import IN_FLIGHT, KEPT, POLL_SECONDS, Future, Pool, ProgressCallback, ignore, limit_threads


class ProcessPool(Pool):
    """In processes that are started fresh (never forked: MuJoCo, torch and OpenGL do not survive that).

    Workers leave Ctrl-C to the process that started them, end on SIGTERM, and end when that process is gone.

    Args:
      workers: processes, started as they are needed.
      threads: of a worker's own libraries.
      tick: told what the functions tell.
      kept: what to say of the work done so far when a worker was killed.
    """

    def __init__(self, workers: int, threads: int = 1, tick: ProgressCallback = ignore, kept: str = KEPT):
        context = multiprocessing.get_context("spawn")
        self._workers, self._tick, self._kept = workers, tick, kept
        self._ticks, self._late = context.Queue(), context.Queue()
        queues = (self._ticks, self._late)
        self._pool = ProcessPoolExecutor(workers, context, initializer=_start, initargs=(*queues, threads))
        self._waiting: deque = deque()
        self._running: dict[concurrent.futures.Future, tuple[int, Any]] = {}
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


# -- in a worker ----------------------------------------------------------------------------------


_ticks: multiprocessing.Queue
_late: multiprocessing.Queue


class _OnItsWay:
    """Stands for a `Future`, which stays in its worker."""


def _start(ticks, late, threads: int) -> None:
    global _ticks, _late
    _ticks, _late = ticks, late
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    limit_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    atexit.register(os._exit, 0)  # taking the interpreter apart lasts seconds and saves nothing


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
    if not isinstance(result, Future):
        return result
    threading.Thread(target=_wait, args=(number, result), daemon=True).start()
    return _OnItsWay()


def _wait(number: int, later: Future) -> None:
    try:
        _late.put((number, later.wait(), None))
    except BaseException as error:
        _late.put((number, None, error))
