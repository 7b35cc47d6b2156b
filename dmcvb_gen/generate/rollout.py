"""Run a plan: its jobs by workers, then the digests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from dmcvb_gen.dataset.manifest import Manifest
from dmcvb_gen.generate.engine import JobResult
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.plan import Plan, finish
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore


@dataclass(frozen=True)
class RolloutResult:
    """The result of running a plan.

    Attributes:
      manifest: of the release; of a part, as it was when the part began.
      steps: transitions that were made now.
      seconds: on the clock.
      seconds_by_part: of all workers together: "physics", "policy", "rendering" and "storage".
    """

    manifest: Manifest
    steps: int
    seconds: float
    seconds_by_part: dict[str, float]


def run_plan(
    plan: Plan,
    workers: Workers = 1,
    progress: ProgressCallback = ignore,
    *,
    finishing: bool = True,
    on_result: Callable[[JobResult], None] = ignore,
) -> RolloutResult:
    """Make every shard of a plan, and write the digests of subsets that are whole.

    Args:
      plan: prepared by `plan.prepare`.
      workers: processes, or a Ray cluster.
      progress: called with the number of frames rendered since the last call.
      finishing: write the digests; False for a part, because other machines make the rest.
      on_result: called with the result of each job.

    Raises:
      StoreError: the disk is full, or another machine has committed other bytes.
    """
    started, steps, seconds = time.monotonic(), 0, dict[str, float]()
    for result in run_jobs(plan.jobs, workers, progress):
        steps += result.steps
        for part, value in result.seconds.items():
            seconds[part] = seconds.get(part, 0.0) + value
        on_result(result)
    manifest = finish(plan) if finishing else plan.manifest
    return RolloutResult(manifest, steps, time.monotonic() - started, seconds)
