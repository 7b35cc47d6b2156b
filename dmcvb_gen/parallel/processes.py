"""Run functions in fresh processes of this machine, and give their results as they come."""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import queue
import signal
import sys
import threading
import traceback
import types
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.parallel.base import IN_FLIGHT, KEPT, POLL_SECONDS, Pool, ProgressCallback, ignore, limit_threads


class ProcessPool(Pool):
    """Pool of fresh processes, which are never forked: MuJoCo, torch and OpenGL do not survive that.

    Workers leave Ctrl-C to the process that started them, end on SIGTERM, and end when that process is gone.

    Args:
      workers: processes, started as they are needed.
      threads: threads of a worker's own libraries.
      tick: called with what the functions report.
      kept: words for the work done so far, for the message about a killed worker.
    """

    def __init__(self, workers: int, threads: int = 1, tick: ProgressCallback = ignore, kept: str = KEPT):
        context = multiprocessing.get_context("spawn")
        super().__init__(tick)
        self._workers, self._kept = workers, kept
        self._messages = context.Queue()
        self._pool = ProcessPoolExecutor(workers, context, initializer=_start, initargs=(self._messages, threads))
        self._running: dict[Future, Any] = {}

    def results(self):
        try:
            while self._waiting or self._running:
                self._hand_out()
                done, _ = wait(self._running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
                self._pass_on()
                for future in done:
                    yield self._running.pop(future), future.result()
        except BrokenProcessPool:
            self._terminate()  # one that was just starting was overlooked
            raise StoreError(
                f"a worker process was killed (out of memory?); {self._kept}, with fewer --workers than "
                f"{self._workers} if it happens again"
            ) from None

    def _hand_out(self) -> None:
        while self._waiting and len(self._running) < IN_FLIGHT * self._workers:
            key, function, arguments = self._waiting.popleft()
            try:
                with _without_guardless_main():
                    future = self._pool.submit(_work, function, arguments)
            except OSError:
                if self._pool._broken:  # a worker died, and its queue was closed while the next worker started
                    raise BrokenProcessPool from None
                raise
            self._running[future] = key

    def _pass_on(self) -> None:
        """Pass on what the workers tell."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._tick(*self._messages.get_nowait())

    def _terminate(self) -> None:
        for process in list((self._pool._processes or {}).values()):
            process.terminate()

    def close(self, at_once=False):
        if at_once:
            self._terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pass_on()
        self._messages.close()


@contextlib.contextmanager
def _without_guardless_main() -> Iterator[None]:
    """Keep new processes from running the user's script again if it has no `if __name__ == "__main__"`.

    A process that is started imports the script, which would start processes in its turn. What it works on lies in
    modules, so it can do without.
    """
    main = sys.modules["__main__"]
    try:
        guarded = "__name__" in Path(getattr(main, "__file__", None) or "").read_text()
    except (OSError, ValueError):  # no script: a notebook, `python -c`
        guarded = True
    if not guarded:
        sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


# -- in a worker ----------------------------------------------------------------------------------


_messages: multiprocessing.Queue
"""To the parent: what a function tells."""


def _start(messages: multiprocessing.Queue, threads: int) -> None:
    global _messages
    _messages = messages
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
    _messages.put(facts)


def _work(function: Callable, arguments: tuple) -> Any:
    try:
        return function(*arguments, tick=_tell)
    except Exception as error:
        if isinstance(error, DmcvbError) or type(error).__module__ == "builtins":
            raise
        # Others may not survive pickling, and the parent would take that for a killed worker.
        told = RuntimeError(f"a worker failed: {type(error).__name__}: {' '.join(str(error).split())}")
        told.add_note(traceback.format_exc())
        raise told from None
