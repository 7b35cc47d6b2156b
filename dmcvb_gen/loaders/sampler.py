"""The steps of a subset for training, with numpy alone: any step by its index, or all of them in shuffled batches.

Both gather from a `StepTable`, and torch's data sets stand on them. A `StepSource` has `__len__` and `__getitem__`,
which is what Grain (`grain.MapDataset.source`), tf.data (`from_generator`) and torch's samplers ask for. A `stream`
draws episodes in a shuffled order, holds `buffer` of them in memory, and mixes their steps: reading whole episodes
costs a tenth of reading single frame stacks.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.steps import Selection, StepTable
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.parallel.cores import usable_cores
from dmcvb_gen.parallel.memory import UNKNOWN_MEMORY, free_memory

SHARE_OF_MEMORY = 0.25
"""Share of the free memory that is held at most, by default."""
Steps = dict[str, np.ndarray]
"""A batch, see `StepTable.gather`."""
Views = Sequence[str] | Literal["agents"] | None
"""Views (or their arrays), in this order; None: all that the subset shows; "agents": those that agents see and
`dmcvb_gen.evaluate` gives, which are all but the overhead view of mazes; (): states alone."""


def check_count(name: str, value: int, least: int = 1) -> int:
    """Return `value` if it is a whole number, and at least so large.

    Raises:
      DmcvbError: it is not.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise DmcvbError(f"{name} is {value!r}; give a whole number of at least {least}")
    return int(value)


class StepSource:
    """Any step at random.

    An item is a dictionary: "pixels" (stack * view * 3, height, width) uint8, "state" (state,) float32, "action"
    (action,) float32, "reward" and "discount" () float32, "episode" and "step" () int64; with `next_step` also
    "next_pixels" and "next_state".

    Args:
      episodes: indices of episodes that are here, all by default.
      pictures: see `Views`.
      stack: frames a stack; the first frame of an episode is repeated before it (paper, section 4).
      next_step: give what comes next, too.
      in_memory: hold all steps (they are read at the first use, and once again in each process that the source is
        sent to); else each step is read from the store, some hundred times slower. By default held if they take
        up to a quarter of the free memory.

    Raises:
      UnknownNameError: no such view. StoreError: no such episode.
    """

    def __init__(
        self,
        subset: Subset,
        episodes: Sequence[int] | None = None,
        pictures: Views = None,
        stack: int = 3,
        next_step: bool = False,
        in_memory: bool | None = None,
    ):
        self.subset, self.stack, self.next_step = subset, check_count("stack", stack), next_step
        self.pictures = shown(subset, pictures).arrays
        self.episodes = subset.choose(episodes)
        lengths = subset.read("length", self.episodes)
        self._ends = np.cumsum(lengths)
        if in_memory is None:
            size = int(np.sum(lengths + 1)) * len(self.pictures) * subset.record.size**2 * 3 * subset.looks
            # Of fresh distractors, each of a loader's workers paints and holds its own.
            holders = 1 + usable_cores() if subset.fresh else 1
            in_memory = size <= SHARE_OF_MEMORY * (free_memory() or UNKNOWN_MEMORY) / holders
        self.in_memory = in_memory
        self._held: tuple[int, StepTable] | None = None
        self._reading = threading.Lock()  # of several threads, one reads

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> Steps:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Steps]:
        """Many steps at once, which a torch DataLoader asks for; in memory as fast as one batch."""
        batch = self.gather(indices)
        return [{name: value[row] for name, value in batch.items()} for row in range(len(indices))]

    def gather(self, indices: Sequence[int]) -> Steps:
        """Many steps as one batch: the arrays of an item, with a leading axis."""
        places = np.asarray(indices, int)
        if not len(self) or np.any((places < -len(self)) | (places >= len(self))):
            raise IndexError(f"steps {places.tolist()} of {len(self)}")
        places = places % len(self)
        if self.in_memory:
            return self.table.gather(self.table.steps[places], self.stack, self.next_step)
        items = [self._read(int(place)) for place in (places if len(places) else [0])]
        return {name: np.concatenate([item[name] for item in items])[: len(places)] for name in items[0]}

    @property
    def table(self) -> StepTable:
        """All steps, in memory; read again if the subset's distractors have become those of another epoch."""
        with self._reading:
            epoch = self.subset.epoch
            if self._held is None or self._held[0] != epoch:
                self._held = None  # free the old pictures before new ones are painted
                self._held = epoch, StepTable.read([Selection(self.subset, self.episodes, self.pictures)])
            return self._held[1]

    def __getstate__(self) -> dict[str, Any]:
        # What is held is read again where the source lands: quicker than sending it.
        return {name: value for name, value in self.__dict__.items() if name != "_reading"} | {"_held": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_reading": threading.Lock()}

    def _read(self, place: int) -> Steps:
        """A batch of the one step, read with the frames that it needs."""
        number = int(np.searchsorted(self._ends, place, side="right"))
        step = place - int(self._ends[number - 1] if number else 0)
        first = max(0, step - self.stack + 1)
        rows = slice(first, step + 1 + self.next_step)
        table = StepTable.window(self.subset, int(self.episodes[number]), rows, self.pictures)
        return table.gather(np.array([step - first]), self.stack, self.next_step)


def stream(
    subset: Subset,
    *,
    batch_size: int | None = None,
    episodes: Sequence[int] | None = None,
    pictures: Views = None,
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
      episodes, pictures, stack, next_step: see `StepSource`.
      shuffle: mix episodes, and steps among the `buffer` episodes in memory; the same for the same seed, epoch and
        number of workers.
      rank, world, worker, workers: this process's share of the episodes. All ranks give as many batches as the one
        whose episodes have the fewest steps (mazes' differ in length), so that none waits for another.
      drop_last: leave out a batch that is not full.

    Raises:
      DmcvbError: a number that is too small or not whole, or fewer episodes than ranks.
    """
    counts = {"stack": stack, "buffer": buffer, "batch_size": 1 if batch_size is None else batch_size}
    for name, value in counts.items():
        check_count(name, value)
    for name, value in {"seed": seed, "epoch": epoch}.items():
        check_count(name, value, least=0)
    names = shown(subset, pictures).arrays
    order = subset.choose(episodes)
    if shuffle:
        order = np.random.default_rng([seed, epoch, 0]).permutation(order)
    own, most = share(order, rank, world, worker, workers), None
    if world > 1:
        most = _batches(subset, order, batch_size, world, workers, drop_last)[rank][worker]
    mixer = np.random.default_rng([seed, epoch, 1 + rank * workers + worker]) if shuffle else None
    tables = (
        StepTable.read([Selection(subset, own[first : first + buffer], names)]) for first in range(0, len(own), buffer)
    )
    parts = (
        (table.gather(rows, stack, next_step), len(rows)) for table, rows in _drawn(tables, mixer, batch_size or 1)
    )
    for batch in itertools.islice(_joined(parts, batch_size or 1, drop_last), most):
        yield batch if batch_size else {name: value[0] for name, value in batch.items()}


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
        shares = [share(order, rank, world, worker, workers) for worker in range(workers)]
        steps = np.array([sum(lengths[int(episode)] for episode in own) for own in shares])
        size = batch_size or 1
        counts.append(steps // size if drop_last else -(-steps // size))
    if batch_size is None:
        return [np.min(counts, axis=0).tolist()] * world
    fewest = min(own.sum() for own in counts)
    return [np.diff(np.minimum(np.cumsum([0, *own]), fewest)).tolist() for own in counts]


def _drawn(
    tables: Iterator[StepTable], mixer: np.random.Generator | None, size: int
) -> Iterator[tuple[StepTable, np.ndarray]]:
    """Rows of one table after the other, mixed if there is a mixer, cut so that every `size` of them end a part."""
    held = 0
    for table in tables:
        rows = table.steps if mixer is None else mixer.permutation(table.steps)
        for part in np.split(rows, range(size - held, len(rows), size)):
            yield table, part
        held = (held + len(rows)) % size


def _joined(parts: Iterator[tuple[Steps, int]], size: int, drop_last: bool) -> Iterator[Steps]:
    """Parts joined to batches of `size` steps; the last one may have fewer."""
    held: list[Steps] = []
    count = 0
    for part, steps in parts:
        held, count = [*held, part], count + steps
        if count == size:
            yield _concatenated(held)
            held, count = [], 0
    if count and not drop_last:
        yield _concatenated(held)


def _concatenated(parts: Sequence[Steps]) -> Steps:
    return parts[0] if len(parts) == 1 else {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
