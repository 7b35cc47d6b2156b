"""Run functions side by side, in this process or in fresh ones, and give their results as they come.

::

    with open_pool(workers=4, tick=bar.update) as pool:
        for job in jobs:
            pool.submit(job, run_job, job)      # run_job(job, tick=...) in a worker
        for job, result in pool.results():
            ...                                 # may submit more

Functions and arguments travel by pickle between processes of one program and user; nothing is unpickled from a file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext

from dmcvb_gen.parallel.base import KEPT, Needs, Pool, ProgressCallback, Ray, SerialPool, Workers, expect, ignore

__all__ = ["Needs", "Pool", "Ray", "ProgressCallback", "Workers", "expect", "ignore", "in_order", "open_pool"]


def open_pool(
    workers: Workers = 1,
    *,
    threads: int = 1,
    tick: ProgressCallback = ignore,
    kept: str = KEPT,
    needs: Needs | None = None,
    most: int | None = None,
) -> Pool:
    """A pool of `workers`; with one worker, the work is done in this process (on its own threads).

    Args:
      threads: threads of a worker process's libraries.
      tick, kept: see `processes.ProcessPool`.
      needs: of a piece of work, where it is placed on a cluster.
      most: how many pieces of work there will be at most; no more processes are of use.

    Raises:
      DmcvbError: the cluster cannot be reached.
    """
    if isinstance(workers, Ray):
        from dmcvb_gen.parallel.ray_pool import RayPool

        return RayPool(workers.address, needs, tick, threads)
    workers = workers if most is None else min(workers, most)
    if workers <= 1:
        return SerialPool(tick)
    from dmcvb_gen.parallel.processes import ProcessPool

    return ProcessPool(workers, threads, tick, kept)


def in_order(function: Callable, items: Sequence, workers: Workers | Pool = 1, tick: ProgressCallback = ignore) -> list:
    """`function(item, tick=...)` of all items, in their order.

    Args:
      workers: or an open pool, which stays open, with the tick that it has.

    Raises:
      StoreError: a worker was killed.
    """
    with nullcontext(workers) if isinstance(workers, Pool) else open_pool(workers, tick=tick, most=len(items)) as pool:
        for number, item in enumerate(items):
            pool.submit(number, function, item)
        results = dict(pool.results())
    return [results[number] for number in range(len(items))]
