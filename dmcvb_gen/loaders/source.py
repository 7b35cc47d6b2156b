"""Read any step of a subset by its index: frame stack, state, action and reward, with numpy alone.

A `StepSource` has `__len__` and `__getitem__`, which is what Grain (`grain.MapDataset.source`), tf.data
(`from_generator`) and torch's samplers ask of a random-access source.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.steps import Selection, StepTable
from dmcvb_gen.loaders.stream import Steps, check_count
from dmcvb_gen.parallel.cores import usable_cores
from dmcvb_gen.parallel.memory import UNKNOWN_MEMORY, free_memory

SHARE_OF_MEMORY = 0.25
"""Share of the free memory that is held at most, by default."""


class StepSource:
    """Any step at random.

    An item is a dictionary: "pixels" (stack * view * 3, height, width) uint8, "state" (state,) float32, "action"
    (action,) float32, "reward" and "discount" () float32, "episode" and "step" () int64; with `next_step` also
    "next_pixels" and "next_state".

    Args:
      episodes: indices of committed episodes, all by default.
      pictures: views (or their arrays), in this order; by default all that the subset shows; "agents": those that
        agents see and `dmcvb_gen.evaluate` gives, which are all but the overhead view of mazes; () gives states alone.
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
        pictures: Sequence[str] | Literal["agents"] | None = None,
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
            size = int(np.sum(lengths + 1)) * len(self.pictures) * subset.record.size**2 * 3
            fresh = getattr(subset, "fresh", False)  # then each of a loader's workers paints and holds its own
            holders = 1 + usable_cores() if fresh else 1
            in_memory = size <= SHARE_OF_MEMORY * (free_memory() or UNKNOWN_MEMORY) / holders
        self.in_memory = in_memory
        self._held: tuple[int, StepTable] | None = None
        self._reading = threading.Lock()  # of several threads, one reads

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> Steps:
        return {name: value[0] for name, value in self.gather([index]).items()}

    def __getitems__(self, indices: Sequence[int]) -> list[Steps]:
        """Many steps at once, which a torch DataLoader asks for; in memory as fast as one batch."""
        batch = self.gather(indices)
        return [{name: value[row] for name, value in batch.items()} for row in range(len(indices))]

    def gather(self, indices: Sequence[int]) -> Steps:
        """Many steps as one batch: the arrays of an item, with a leading axis."""
        places = np.asarray(indices, int)
        if len(places) and not (-len(self) <= places.min() and places.max() < len(self)):
            raise IndexError(f"steps {places.min()}..{places.max()} of {len(self)}")
        if not len(self):
            raise IndexError("the source has no steps")
        places = places % len(self)
        if self.in_memory:
            return self.table.gather(self.table.steps[places], self.stack, self.next_step)
        items = [self._read(int(place)) for place in (places if len(places) else [0])]
        return {name: np.concatenate([item[name] for item in items])[: len(places)] for name in items[0]}

    @property
    def table(self) -> StepTable:
        """All steps, in memory; read again if the subset's distractors have become those of another epoch."""
        with self._reading:
            epoch = getattr(self.subset, "shown_epoch", 0)
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
