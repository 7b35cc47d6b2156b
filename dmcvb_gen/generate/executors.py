"""Run many jobs: in this process, in worker processes or on a Ray cluster. The data do not depend on which."""

from __future__ import annotations

import math
import queue
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from dmcvb_gen.dataset.schema import EpisodeShape, array_specs
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.engine import JobResult, run_job
from dmcvb_gen.generate.jobs import Job
from dmcvb_gen.generate.render import frame_count
from dmcvb_gen.generate.target import leave
from dmcvb_gen.parallel import Needs, Pool, ProgressCallback, Workers, expect, ignore, open_pool
from dmcvb_gen.parallel.cores import usable_cores
from dmcvb_gen.parallel.memory import free_memory
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import format_bytes

PROCESS_BYTES = 1 << 30
"""Memory that a worker takes before it holds any episode: libraries, models, a renderer's buffers."""


def run_jobs(jobs: Sequence[Job], workers: Workers = 1, progress: ProgressCallback = ignore) -> Iterator[JobResult]:
    """Run jobs and yield their results as they finish.

    Args:
      workers: processes, each with physics on one core; 1 works in this process, with physics on all cores; or a Ray
        cluster.
      progress: called with the number of frames rendered since the last call. The expected number is that of full
        episodes at first, and follows the finished ones (mazes end early).

    Raises:
      StoreError: the shards need more memory than is free, or a worker was killed (often for memory); what was
        committed is safe.
    """
    check_memory(jobs, workers)
    kept = "finished shards are saved: rerun the same command (fewer --episodes-per-shard need less memory)"
    alone = workers == 1 or len(jobs) <= 1 and isinstance(workers, int)
    with open_pool(workers, tick=progress, kept=kept, needs=needs_of(jobs), most=max(len(jobs), 1)) as pool:
        for job in jobs:
            pool.submit(job, run_job, job, usable_cores() if alone else 1)
        expected = _Expected(jobs)
        expect(progress, expected.frames)
        try:
            for job, result in pool.results():
                expected.done(job, result)
                expect(progress, expected.frames)
                yield result
        finally:
            for target in {job.target for job in jobs}:
                leave(target)


def run_arriving(
    arriving: queue.SimpleQueue, pool: Pool, job_of: Callable[[Any], Job | None]
) -> Iterator[tuple[Job, JobResult]]:
    """Run jobs as they come, e.g. while the shards that they read are still being downloaded.

    Args:
      arriving: items to do, an exception to raise, or None at the end.
      job_of: the job of an item, None if nothing is left to do for it.
    """
    ended, running = False, 0
    results: Iterator[tuple[Job, JobResult]] = iter(())
    while not ended or running:
        while not ended:
            try:
                item = arriving.get(block=not running)  # there is nothing else to wait for
            except queue.Empty:
                break
            if isinstance(item, BaseException):
                raise item
            ended = item is None
            if not ended and (job := job_of(item)) is not None:
                pool.submit(job, run_job, job)
                running += 1
        done = next(results, None)
        if done is not None:
            running -= 1
            yield done
        elif running:
            results = pool.results()


class _Expected:
    """Expected frames of all jobs: of full episodes at first, then in proportion to the finished ones."""

    def __init__(self, jobs: Sequence[Job]):
        self._open: Counter = Counter()
        self._ended: Counter = Counter()
        self._painted: Counter = Counter()
        for job in jobs:
            self._open[self._kind(job)] += self._planned(job)

    def done(self, job: Job, result: JobResult) -> None:
        """Count a finished job: others of its task and level are taken to end as early."""
        kind, planned, episodes = self._kind(job), self._planned(job), len(job.episodes) * len(job.subsets)
        self._open[kind] -= planned
        self._ended[kind] += planned
        known = job.stored is not None  # stored episodes were counted as long as they are
        share = 1.0 if known else (result.steps + episodes) / (job.frames + episodes)
        self._painted[kind] += round(planned * share)

    @property
    def frames(self) -> int:
        shares = {kind: self._painted[kind] / planned for kind, planned in self._ended.items()}
        to_come = (planned * shares.get(kind, 1) for kind, planned in self._open.items())
        return sum(self._painted.values()) + round(sum(to_come))

    @staticmethod
    def _kind(job: Job) -> tuple[str, str]:
        return job.subsets[0].task, job.subsets[0].level

    @staticmethod
    def _planned(job: Job) -> int:
        if job.stored:
            steps = job.stored.subset.commits[job.shard].steps
            return sum(frame_count(record, steps, len(job.episodes)) for record in job.subsets)
        count = len(job.episodes)
        return sum(frame_count(record, count * record.max_steps, count) for record in job.subsets)


def check_memory(jobs: Sequence[Job], workers: Workers) -> None:
    """Raises StoreError, before any work, if the shards in progress need more memory than this machine has free.

    Ray is told what a job needs and finds it a place.
    """
    free = free_memory()
    if not isinstance(workers, int) or not jobs or free is None:
        return
    largest, side_by_side = max(jobs, key=_memory), max(1, min(workers, len(jobs)))
    needed = _memory(largest) - PROCESS_BYTES
    if needed * side_by_side <= free:
        return
    record = largest.subsets[0]
    advice = "fewer --workers or a machine with more memory" if side_by_side > 1 else "a machine with more memory"
    if largest.stored is None:
        advice = f"fewer --episodes-per-shard in a new release, or {advice}"
    raise StoreError(
        f"a shard of {record.name} ({len(largest.episodes)} episodes of {record.max_steps} steps, {record.size} pixels "
        f"a side) needs {format_bytes(needed)} of memory, {side_by_side} are made at once, and {format_bytes(free)} "
        f"are free; use {advice}"
    )


def needs_of(jobs: Sequence[Job]) -> Needs:
    """Return the most memory and scratch space that any job takes."""
    return Needs(memory=max(map(_memory, jobs), default=0))


def _memory(job: Job) -> int:
    """Bytes that a job holds at its peak: all states, and two picture arrays of one subset."""
    record = max(job.subsets, key=lambda record: record.pixels)
    specs = array_specs(EpisodeShape.of(get_task(record.task)), record.size)
    rows = len(job.episodes) * (record.max_steps + 1)
    simulated = sum(8 * math.prod(spec.shape) for spec in specs if not spec.picture)
    pictures = [math.prod(spec.shape) for spec in specs if spec.picture] if record.pixels else []
    return PROCESS_BYTES + rows * (simulated + 2 * max(pictures, default=0))
