"""Run many works: in this process, in worker processes or on a Ray cluster. The data do not depend on which."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.engine import WorkResult, run_work
from dmcvb_gen.generate.works import Work
from dmcvb_gen.parallel import Needs, ProgressCallback, Workers, cores, expect, ignore, open_pool
from dmcvb_gen.parallel.memory import free_memory
from dmcvb_gen.text import format_bytes

PROCESS_BYTES = 1 << 30
"""Memory that a worker takes before it holds any episode: libraries, models, a renderer's buffers."""

STEPS_PER_PROCESS = 5_000
"""Frames that are worth the start of another process, some four seconds."""


def run_works(
    works: Sequence[Work], workers: Workers | None = 1, progress: ProgressCallback = ignore
) -> Iterator[WorkResult]:
    """Run works and yield their results as they finish.

    Args:
      workers: processes, each with physics on one core; 1 works in this process, with physics on all cores; None: as
        many as are of use; or a Ray cluster.
      progress: called with the number of frames rendered since the last call. The expected number is that of full
        episodes at first, and follows the finished ones (mazes end early).

    Raises:
      StoreError: the shards need more memory than is free, or a worker was killed (often for memory); what was
        put is safe.
    """
    workers = workers or default_workers(works)
    check_memory(works, workers)
    kept = "finished shards are saved: rerun the same command (fewer --episodes-per-shard need less memory)"
    alone = workers == 1 or len(works) <= 1 and isinstance(workers, int)
    needs = Needs(memory=max(map(_memory, works), default=0))
    with open_pool(workers, tick=progress, kept=kept, needs=needs, most=max(len(works), 1)) as pool:
        for number, work in enumerate(works):
            pool.submit(number, run_work, work, cores.usable_cores() if alone else 1)
        left, ended, rendered = sum(work.frames for work in works), 0, 0
        expect(progress, left)
        for number, result in pool.results():
            work = works[number]
            full = len(work.settings) * (work.steps + len(work.episodes))
            left, ended = left - work.frames, ended + work.frames
            rendered += round(work.frames * (result.steps + result.episodes) / full)
            expect(progress, rendered + round(left * rendered / ended))  # the others are taken to end as early
            yield result


def default_workers(works: Sequence[Work]) -> int:
    """Processes for works, see `cores.default_workers`; few frames are worth no other process."""
    worth = sum(work.frames for work in works) // STEPS_PER_PROCESS
    return cores.default_workers(min(len(works), worth), max(map(_memory, works), default=0))


def check_memory(works: Sequence[Work], workers: Workers) -> None:
    """Raises StoreError, before any work, if the shards in progress need more memory than this machine has free.

    Ray is told what a work needs and finds it a place.
    """
    free = free_memory()
    if not isinstance(workers, int) or not works or free is None:
        return
    largest, side_by_side = max(works, key=_memory), max(1, min(workers, len(works)))
    needed = _memory(largest) - PROCESS_BYTES
    if needed * side_by_side <= free:
        return
    raise StoreError(
        f"a shard of {largest.settings[0].record.name} needs {format_bytes(needed)} of memory, {side_by_side} are made "
        f"at once, and {format_bytes(free)} are free; give fewer --workers, or fewer --episodes-per-shard in a new one"
    )


def _memory(work: Work) -> int:
    """Bytes that a work holds at its peak: all states, the labels of a setting, and two image arrays."""
    rows = len(work.episodes) * work.trajectories.rows
    labels = max((setting.labels.row_bytes for setting in work.settings if setting.labels), default=0)
    images = max((layer.row_bytes for layer in work.images), default=0)
    return PROCESS_BYTES + 2 * rows * (work.trajectories.row_bytes + labels + images)
