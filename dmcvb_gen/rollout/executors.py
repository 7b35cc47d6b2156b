"""Doing many jobs: in this process, in worker processes or on a Ray cluster; the data do not depend on which."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from dmcvb_gen.pool import Needs, Tick, Workers, ignore, open_pool
from dmcvb_gen.rollout.jobs import Job
from dmcvb_gen.rollout.site import leave
from dmcvb_gen.rollout.worker import JobResult, run_job
from dmcvb_gen.store.schema import EpisodeShape, array_specs
from dmcvb_gen.tasks import get_task

PROCESS_BYTES = 1 << 30
"""Memory of a worker before it holds any episode: libraries, models, a renderer's buffers."""
GPU_SHARE = 0.25
"""Of a GPU, for a worker that paints there; the rest of its time it simulates."""


def run_jobs(jobs: Sequence[Job], workers: Workers = 1, tick: Tick = ignore) -> Iterator[JobResult]:
    """Run jobs and give their results as they come.

    Args:
      workers: processes, each with physics on one core; 1 works in this process, with physics on all cores; or a Ray
        cluster.
      tick: told how many frames were painted since the last call.

    Raises:
      StoreError: a worker was killed (often for memory); what was committed is safe.
    """
    kept = "what was committed is safe: run the same command again (fewer --episodes-per-shard need less memory)"
    alone = workers == 1 or len(jobs) <= 1 and isinstance(workers, int)
    with open_pool(workers, tick=tick, kept=kept, needs=needs_of(jobs), most=max(len(jobs), 1)) as pool:
        for job in jobs:
            pool.submit(job, run_job, job, os.cpu_count() or 1 if alone else 1)
        try:
            for _, result in pool.results():
                yield result
        finally:
            for site in {job.site for job in jobs}:
                leave(site)


def needs_of(jobs: Sequence[Job]) -> Needs:
    """What a job takes at most."""
    cuda = any(job.device != "cpu" for job in jobs)
    return Needs(memory=max(map(_memory, jobs), default=0), gpus=GPU_SHARE if cuda else 0)


def _memory(job: Job) -> int:
    """Bytes that a job holds at its height: all that was simulated, and two picture arrays of one setting."""
    record = job.subsets[0]
    specs = array_specs(EpisodeShape.of(get_task(record.task)), record.size)
    rows = len(job.episodes) * (record.max_steps + 1)
    simulated = sum(_row_bytes(spec) for spec in specs if not spec.picture)
    pictures = 2 * max((_row_bytes(spec) for spec in specs if spec.picture), default=0)
    return PROCESS_BYTES + rows * (simulated + pictures)


def _row_bytes(spec) -> int:
    size = 8
    for count in spec.shape:
        size *= count
    return size // 8 if spec.picture else size
