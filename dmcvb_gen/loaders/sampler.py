"""The steps of a subset for training, with numpy alone: any step by its index, or all of them in shuffled batches.

Both gather from a `StepTable`, and torch's data sets stand on them. A `StepSource` has `__len__` and `__getitem__`,
which is what Grain (`grain.MapDataset.source`), tf.data (`from_generator`) and torch's samplers ask for. A `stream`
draws episodes in a shuffled order, holds `buffer` of them in memory, and mixes their steps: reading whole episodes
costs a tenth of reading single frame stacks.
"""

from __future__ import annotations

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


def _check_counts(least: int = 1, **counts: int) -> None:
    """Raises DmcvbError for what is no whole number, or below the least one."""
    for name, value in counts.items():
        if not isinstance(value, int | np.integer) or value < least:
            raise DmcvbError(f"{name} is {value!r}; give a whole number of at least {least}")


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
        _check_counts(stack=stack)
        self.subset, self.stack, self.next_step = subset, stack, next_step
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
        places = np.asarray(indices)
        whole = places.dtype.kind in "iu" or not places.size
        if not len(self) or not whole or np.any((places < -len(self)) | (places >= len(self))):
            raise IndexError(f"steps {places.tolist()} of {len(self)}; give whole numbers, from {-len(self)} on")
        places = places.astype(int) % len(self)
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
      worker, workers: this worker's share of the episodes.
      drop_last: leave out a batch that is not full.

    Raises:
      DmcvbError: a number that is too small, or no episodes.
    """
    _check_counts(stack=stack, buffer=buffer, batch_size=1 if batch_size is None else batch_size)
    _check_counts(0, seed=seed, epoch=epoch)
    names = shown(subset, pictures).arrays
    own = subset.choose(episodes)
    if not len(own):
        raise DmcvbError("no episodes are chosen; give at least one")
    if shuffle:
        own = np.random.default_rng([seed, epoch, 0]).permutation(own)
    own = own[worker::workers]
    mixer = np.random.default_rng([seed, epoch, 1 + worker]) if shuffle else None
    size, count = batch_size or 1, 0
    held: list[Steps] = []  # parts of a batch that is not full yet, with `count` steps
    for first in range(0, len(own), buffer):
        table = StepTable.read([Selection(subset, own[first : first + buffer], names)])
        rows = table.steps if mixer is None else mixer.permutation(table.steps)
        for part in np.split(rows, range(size - count, len(rows), size)):
            held, count = [*held, table.gather(part, stack, next_step)], count + len(part)
            if count == size:
                batch = _joined(held)
                yield batch if batch_size else {name: value[0] for name, value in batch.items()}
                held, count = [], 0
    if count and not drop_last:
        yield _joined(held)


def _joined(parts: Sequence[Steps]) -> Steps:
    return parts[0] if len(parts) == 1 else {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
