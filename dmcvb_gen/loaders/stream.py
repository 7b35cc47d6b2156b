"""Stream steps for training: read a few whole episodes at a time, mix their steps, and give batches.

Reading whole episodes costs a tenth of reading single frame stacks from the store, so a stream draws episodes in a
shuffled order, holds `buffer` of them in memory, and mixes their steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.steps import Selection, StepTable
from dmcvb_gen.errors import DmcvbError

Steps = dict[str, np.ndarray]
"""A batch, see `StepTable.gather`."""


def check_count(name: str, value: int, least: int = 1) -> int:
    """Return `value` if it is a whole number, and at least so large.

    Raises:
      DmcvbError: it is not.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise DmcvbError(f"{name} is {value!r}; give a whole number, at least {least}")
    return int(value)


def share(episodes: np.ndarray, rank: int, world: int, worker: int = 0, workers: int = 1) -> np.ndarray:
    """The episodes of one rank and worker; ranks get equally many.

    Raises:
      DmcvbError: there are fewer episodes than ranks.
    """
    if not 0 <= rank < world:
        raise DmcvbError(f"rank {rank} is not in 0..{world - 1}; give rank < world")
    if not len(episodes):
        raise DmcvbError("no episodes are chosen; give at least one")
    if len(episodes) < world:
        raise DmcvbError(f"{len(episodes)} episodes cannot be shared by {world} ranks; use fewer ranks")
    return episodes[: len(episodes) - len(episodes) % world][rank::world][worker::workers]


def stream(
    subset: Subset,
    *,
    batch_size: int | None = None,
    episodes: Sequence[int] | None = None,
    pictures: Sequence[str] | Literal["agents"] | None = None,
    stack: int = 3,
    next_step: bool = False,
    shuffle: bool = True,
    seed: int = 0,
    epoch: int = 0,
    buffer: int = 32,
    rank: int = 0,
    world: int = 1,
    worker: int = 0,
    workers: int = 1,
    drop_last: bool = False,
) -> Iterator[Steps]:
    """One pass over the steps of episodes.

    Args:
      batch_size: steps a batch (see `StepTable.gather`); None gives single steps, without the leading axis.
      episodes: indices of committed episodes, all by default.
      pictures: views (or their arrays), in this order; by default all that the subset shows; "agents": those that
        agents see; () reads states alone.
      shuffle: mix episodes, and steps among the `buffer` episodes in memory; the same for the same seed, epoch and
        number of workers.
      rank, world, worker, workers: this process's share of the episodes. All ranks give as many batches as the one
        whose episodes have the fewest steps (mazes' differ in length), so that none waits for another.
      drop_last: leave out a batch that is not full.

    Raises:
      DmcvbError: a number that is too small or not whole, or fewer episodes than ranks.
    """
    for name, value in (("stack", stack), ("buffer", buffer), ("batch_size", 1 if batch_size is None else batch_size)):
        check_count(name, value)
    for name, value in (("seed", seed), ("epoch", epoch)):
        check_count(name, value, least=0)
    chosen, names = subset.choose(episodes), shown(subset, pictures).arrays
    order = np.random.default_rng([seed, epoch, 0]).permutation(chosen) if shuffle else chosen
    own, most = share(order, rank, world, worker, workers), None
    if world > 1:
        most = _batches(subset, order, batch_size, world, workers, drop_last)[rank][worker]
    mixer = np.random.default_rng([seed, epoch, 1 + rank * workers + worker])

    batches = _mixed(
        subset, own, names, mixer if shuffle else None, batch_size or 1, buffer, drop_last, stack, next_step
    )
    for batch in itertools.islice(batches, most):
        yield batch if batch_size else {name: value[0] for name, value in batch.items()}


def _batches(
    subset: Subset, order: np.ndarray, batch_size: int | None, world: int, workers: int, drop_last: bool
) -> list[list[int]]:
    """Count the batches of each rank's workers: every rank has as many as the shortest one.

    Of single steps (no batch size), each worker gives as many as that worker of any rank has: a loader that makes
    batches of them makes them by worker.
    """
    lengths = dict(zip(subset.episodes.tolist(), subset.lengths.tolist(), strict=True))
    counts = []
    for rank in range(world):
        steps = [
            sum(lengths[int(episode)] for episode in share(order, rank, world, worker, workers))
            for worker in range(workers)
        ]
        size = batch_size or 1
        counts.append([count // size if drop_last else -(-count // size) for count in steps])
    if batch_size is None:
        return [[min(own) for own in zip(*counts, strict=True)]] * world
    fewest = min(map(sum, counts))
    return [np.diff(np.minimum(np.cumsum([0, *own]), fewest)).tolist() for own in counts]


def _mixed(
    subset: Subset,
    order: np.ndarray,
    names: Sequence[str],
    mixer: np.random.Generator | None,
    size: int,
    buffer: int,
    drop_last: bool,
    stack: int,
    next_step: bool,
) -> Iterator[Steps]:
    """Batches of the steps of episodes in their order, `buffer` episodes at a time, these mixed if there is a mixer."""
    parts: list[Steps] = []  # of a batch that the episodes in memory did not fill
    for first in range(0, len(order), buffer):
        table = StepTable.read([Selection(subset, order[first : first + buffer], names)])
        rows = table.steps if mixer is None else mixer.permutation(table.steps)
        held = sum(len(part["step"]) for part in parts)
        for taken in np.split(rows, range(size - held, len(rows), size)):
            parts.append(table.gather(taken, stack, next_step))
            if held + len(taken) == size:
                yield _join(parts)
                parts, held = [], 0
        del table  # before the next episodes are read
    if parts and not drop_last:
        yield _join(parts)


def _join(parts: Sequence[Steps]) -> Steps:
    return parts[0] if len(parts) == 1 else {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
