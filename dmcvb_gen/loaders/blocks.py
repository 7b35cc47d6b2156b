"""Steps for training: a few whole episodes are read at a time and their steps mixed; batches of numpy arrays out.

Reading whole episodes costs a tenth of reading single frame stacks from the store, so a stream draws episodes in a
shuffled order, holds `buffer` of them in memory, and mixes their steps.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.errors import DmcvbError, StoreError


def check_count(name: str, value: int) -> int:
    """`value`.

    Raises:
      DmcvbError: it is below 1.
    """
    if value < 1:
        raise DmcvbError(f"{name}={value}: give at least 1")
    return value


def choose(subset: Subset, episodes: Iterable[int] | None) -> np.ndarray:
    """(episode,) int: indices of committed episodes, all by default.

    Raises:
      StoreError: one of them is not there.
    """
    chosen = subset.episodes if episodes is None else np.asarray(list(episodes), int)
    missing = np.setdiff1d(chosen, subset.episodes)
    if len(missing):
        raise StoreError(f"{subset.name} has no episode {missing[0]}; it has {len(subset.episodes)} episodes")
    return chosen


def stack_channels(frames: np.ndarray) -> np.ndarray:
    """(..., stack, view, height, width, 3) -> (..., stack * view * 3, height, width), oldest frame first."""
    moved = np.moveaxis(frames, -1, -3)
    return moved.reshape(*moved.shape[:-5], math.prod(moved.shape[-5:-2]), *moved.shape[-2:])


class Block:
    """Episodes in memory, their rows one after the other.

    Args:
      pictures: names of picture arrays, in the order of the channels; none: states alone.
      stack: frames a stack; the first frame of an episode is repeated before it (paper, section 4).
      next_step: give what comes next, too.
    """

    def __init__(
        self, subset: Subset, episodes: Iterable[int], pictures: Sequence[str], stack: int = 3, next_step: bool = False
    ):
        names = ["state", "action", "reward", "discount", "length"]
        loaded = [subset.episode(int(episode), [*names, *pictures]) for episode in episodes]
        lengths = np.array([int(values["length"]) for values in loaded])
        starts = np.cumsum(lengths + 1) - (lengths + 1)
        self.stack, self.next_step = stack, next_step
        self.episode = np.repeat(np.asarray(episodes, int), lengths)
        self.step = np.concatenate([np.arange(length) for length in lengths])
        self._start = np.repeat(starts, lengths)
        self._state = np.concatenate([values["state"] for values in loaded])
        self._flat = {n: np.concatenate([values[n] for values in loaded]) for n in ("action", "reward", "discount")}
        self._frames = None
        if pictures:
            self._frames = np.concatenate(
                [np.stack([values[name] for name in pictures], axis=1) for values in loaded]
            )  # (row, view, height, width, 3)

    def __len__(self) -> int:
        return len(self.step)

    def gather(self, steps: np.ndarray) -> dict[str, np.ndarray]:
        """Steps by their place in the block.

        Returns:
          "pixels" (step, stack * view * 3, height, width) uint8, "state" (step, state) float32, "action" (step,
          action) float32, "reward" and "discount" (step,) float32, "episode" and "step" (step,) int64; with
          `next_step` also "next_pixels" and "next_state".
        """
        rows = self._start[steps] + self.step[steps]
        values = self._observe(rows, self._start[steps], "")
        values |= {name: array[steps] for name, array in self._flat.items()}
        values |= {"episode": self.episode[steps], "step": self.step[steps]}
        if self.next_step:
            values |= self._observe(rows + 1, self._start[steps], "next_")
        return values

    def _observe(self, rows: np.ndarray, starts: np.ndarray, prefix: str) -> dict[str, np.ndarray]:
        values = {f"{prefix}state": self._state[rows]}
        if self._frames is not None:
            back = np.arange(self.stack - 1, -1, -1)
            values[f"{prefix}pixels"] = stack_channels(self._frames[np.maximum(rows[:, None] - back, starts[:, None])])
        return values


def share(episodes: np.ndarray, rank: int, world: int, worker: int = 0, workers: int = 1) -> np.ndarray:
    """The episodes of one rank and worker; ranks get equally many.

    Raises:
      DmcvbError: there are fewer episodes than ranks.
    """
    if not 0 <= rank < world:
        raise DmcvbError(f"rank {rank} is not in 0..{world - 1}; give rank < world")
    if len(episodes) < world:
        raise DmcvbError(f"{len(episodes)} episodes cannot be shared by {world} ranks; use fewer ranks")
    return episodes[: len(episodes) - len(episodes) % world][rank::world][worker::workers]


def stream(
    subset: Subset,
    *,
    batch_size: int | None = None,
    episodes: Sequence[int] | None = None,
    pictures: Sequence[str] | None = None,
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
) -> Iterator[dict[str, np.ndarray]]:
    """One pass over the steps of episodes.

    Args:
      batch_size: steps a batch (see `Block.gather`); None gives single steps, without the leading axis.
      episodes: indices of committed episodes, all by default.
      pictures: views (or their arrays), in this order; by default all that the subset shows; () reads states alone.
      shuffle: mix episodes, and steps among the `buffer` episodes in memory; the same for the same seed, epoch and
        number of workers.
      rank, world, worker, workers: this process's share of the episodes. All ranks give as many batches as the one
        whose episodes have the fewest steps (mazes' differ in length), so that none waits for another.
      drop_last: leave out a batch that is not full.

    Raises:
      DmcvbError: a number below 1, or fewer episodes than ranks.
    """
    for name, value in (("stack", stack), ("buffer", buffer), ("batch_size", 1 if batch_size is None else batch_size)):
        check_count(name, value)
    chosen = choose(subset, episodes)
    names = shown(subset, pictures).arrays
    order = np.random.default_rng([seed, epoch, 0]).permutation(chosen) if shuffle else chosen
    own, most = share(order, rank, world, worker, workers), None
    if world > 1:
        most = _batches(subset, order, batch_size, world, workers, drop_last)[rank][worker]
    mixer = np.random.default_rng([seed, epoch, 1 + rank * workers + worker])
    items = _mixed(subset, own, names, mixer if shuffle else None, batch_size, stack, next_step, buffer, drop_last)
    yield from itertools.islice(items, most)


def _batches(
    subset: Subset, order: np.ndarray, batch_size: int | None, world: int, workers: int, drop_last: bool
) -> list[list[int]]:
    """How many batches each rank's workers give: as many a rank as the shortest rank has.

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
    batch_size: int | None,
    stack: int,
    next_step: bool,
    buffer: int,
    drop_last: bool,
) -> Iterator[dict[str, np.ndarray]]:
    """The steps of episodes in their order, `buffer` episodes at a time, these mixed if there is a mixer."""
    rest: list[dict[str, np.ndarray]] = []
    for first in range(0, len(order), buffer):
        block = Block(subset, order[first : first + buffer], names, stack, next_step)
        steps = np.arange(len(block)) if mixer is None else mixer.permutation(len(block))
        if batch_size is None:
            for step in steps:
                yield {name: value[0] for name, value in block.gather(np.array([step])).items()}
            continue
        held, start = sum(len(part["step"]) for part in rest), 0
        while start < len(steps):
            taken = steps[start : start + batch_size - held]
            rest.append(block.gather(taken))
            held, start = held + len(taken), start + len(taken)
            if held == batch_size:
                yield _join(rest)
                rest, held = [], 0
    if rest and not drop_last:
        yield _join(rest)


def _join(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return parts[0] if len(parts) == 1 else {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
