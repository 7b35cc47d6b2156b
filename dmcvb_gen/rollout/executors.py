"""Doing many jobs: in this process, in worker processes, or on a Ray cluster; the data do not depend on which."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import queue
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.rollout.plan import Job
from dmcvb_gen.rollout.worker import JobResult, run_job

Tick = Callable[[int], None]
"""Told how many frames were painted since the last call."""


def run_serial(jobs: Sequence[Job], tick: Tick = lambda frames: None) -> Iterator[JobResult]:
    """One job after the other in this process; physics on all cores."""
    for job in jobs:
        yield run_job(job, tick, threads=os.cpu_count() or 1)


_ticks: multiprocessing.Queue | None = None


def _start_worker(ticks) -> None:
    global _ticks
    _ticks = ticks
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    import torch

    torch.set_num_threads(1)
    atexit.register(os._exit, 0)  # taking the interpreter apart lasts seconds and saves nothing


def _run_in_worker(job: Job) -> JobResult:
    return run_job(job, tick=_ticks.put, threads=1)


def run_processes(jobs: Sequence[Job], workers: int, tick: Tick = lambda frames: None) -> Iterator[JobResult]:
    """Jobs in `workers` processes; results as they come.

    Raises:
      StoreError: a worker was killed (often for memory); what was committed is safe.
    """
    context = multiprocessing.get_context("spawn")
    ticks = context.Queue()
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(ticks,))
    try:
        waiting = {pool.submit(_run_in_worker, job) for job in jobs}
        while waiting:
            done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            _drain(ticks, tick)
            for future in done:
                try:
                    yield future.result()
                except BrokenProcessPool:
                    raise StoreError(
                        "a worker process was killed (out of memory?); what was committed is safe: run the same "
                        "command again, with fewer --workers or --episodes-per-shard if it happens again"
                    ) from None
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        _drain(ticks, tick)


def _drain(ticks, tick: Tick) -> None:
    try:
        while True:
            tick(ticks.get_nowait())
    except queue.Empty:
        pass


def run_ray(jobs: Sequence[Job], tick: Tick = lambda frames: None) -> Iterator[JobResult]:
    """Jobs on the Ray cluster that RAY_ADDRESS names (or a local one); --out must be a shared folder.

    Raises:
      DmcvbError: ray is not installed.
    """
    try:
        import ray
    except ImportError:
        raise DmcvbError('--executor ray needs ray: pip install "dmcvb-gen[ray]"') from None
    ray.init(ignore_reinit_error=True, logging_level="ERROR")
    remote = ray.remote(num_cpus=1, max_retries=2)(run_job)
    waiting = {remote.remote(job): job for job in jobs}
    try:
        while waiting:
            done, _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(done[0])
            result = ray.get(done[0])
            tick(job.frames)
            yield result
    finally:
        for reference in waiting:
            ray.cancel(reference, force=True)


def run_jobs(
    jobs: Sequence[Job], workers: int = 1, tick: Tick = lambda frames: None, executor: str | None = None
) -> Iterator[JobResult]:
    """Run jobs and give their results as they come.

    Args:
      workers: processes; 1 works in this process.
      executor: "serial", "processes" or "ray"; by default what `workers` says.
    """
    executor = executor or ("serial" if workers <= 1 else "processes")
    if executor == "serial":
        yield from run_serial(jobs, tick)
    elif executor == "processes":
        yield from run_processes(jobs, min(workers, max(len(jobs), 1)), tick)
    elif executor == "ray":
        yield from run_ray(jobs, tick)
    else:
        raise DmcvbError(f"unknown executor {executor!r}; known: serial, processes, ray")
