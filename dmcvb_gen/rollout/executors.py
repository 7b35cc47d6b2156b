"""Doing many jobs: in this process or in worker processes; the data do not depend on which."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from dmcvb_gen.pool import Tick, ignore, open_pool
from dmcvb_gen.rollout.plan import Job
from dmcvb_gen.rollout.worker import JobResult, run_job


def run_jobs(jobs: Sequence[Job], workers: int = 1, tick: Tick = ignore) -> Iterator[JobResult]:
    """Run jobs and give their results as they come.

    Args:
      workers: processes, each with physics on one core; 1 works in this process, with physics on all cores.
      tick: told how many frames were painted since the last call.

    Raises:
      StoreError: a worker was killed (often for memory); what was committed is safe.
    """
    workers = min(workers, max(len(jobs), 1))
    kept = "what was committed is safe: run the same command again (fewer --episodes-per-shard need less memory)"
    with open_pool(workers, tick=tick, kept=kept) as pool:
        for job in jobs:
            pool.submit(job, run_job, job, os.cpu_count() or 1 if workers == 1 else 1)
        for _, result in pool.results():
            yield result
