"""Steps at random: a subset in; frame stacks with their state, action and reward out, by index, numpy alone.

A `StepSource` has `__len__` and `__getitem__`, which is what Grain (`grain.MapDataset.source`), tf.data
(`from_generator`) and torch's samplers ask of a random-access source.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import shown, training_pictures
from dmcvb_gen.loaders.blocks import Block, check_count, choose, stack_channels
from dmcvb_gen.parallel.memory import UNKNOWN_MEMORY, free_memory

SHARE_OF_MEMORY = 0.25
"""Of the free memory: what is held at most, if nobody says."""


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
        sent to); else each step is read from the store, some hundred times slower. By default held where they take
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
        self.pictures = (training_pictures(subset) if pictures == "agents" else shown(subset, pictures)).arrays
        self.episodes = choose(subset, episodes)
        by_episode = dict(zip(subset.episodes.tolist(), subset.lengths.tolist(), strict=True))
        lengths = np.array([by_episode[int(episode)] for episode in self.episodes], int)
        self._ends = np.cumsum(lengths)
        if in_memory is None:
            size = int(np.sum(lengths + 1)) * len(self.pictures) * subset.record.size**2 * 3
            fresh = getattr(subset, "fresh", False)  # then each of a loader's workers paints and holds its own
            holders = 1 + (os.cpu_count() or 1) if fresh else 1
            in_memory = size <= SHARE_OF_MEMORY * (free_memory() or UNKNOWN_MEMORY) / holders
        self.in_memory = in_memory
        self._held: tuple[int, Block] | None = None
        self._reading = threading.Lock()  # of several threads, one reads

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        place = int(index) + len(self) if index < 0 else int(index)
        if not 0 <= place < len(self):
            raise IndexError(f"step {index} of {len(self)}")
        if self.in_memory:
            return {name: value[0] for name, value in self.block.gather(np.array([place])).items()}
        return self._read(place)

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, np.ndarray]]:
        """Many steps at once, which a torch DataLoader asks for; in memory as fast as one batch."""
        if not self.in_memory:
            return [self[index] for index in indices]
        batch = self.gather(indices)
        return [{name: value[row] for name, value in batch.items()} for row in range(len(indices))]

    def gather(self, indices: Sequence[int]) -> dict[str, np.ndarray]:
        """Many steps as one batch: the arrays of an item, with a leading axis."""
        places = np.asarray(indices, int)
        if len(places) and not (-len(self) <= places.min() and places.max() < len(self)):
            raise IndexError(f"steps {places.min()}..{places.max()} of {len(self)}")
        places = places % max(len(self), 1)
        if self.in_memory:
            return self.block.gather(places)
        if not len(self):
            raise IndexError("the source has no steps")
        items = [self._read(int(place)) for place in (places if len(places) else [0])]
        return {name: np.stack([item[name] for item in items])[: len(places)] for name in items[0]}

    @property
    def block(self) -> Block:
        """All steps, in memory; read again where the subset's distractors have become those of another epoch."""
        with self._reading:
            epoch = getattr(self.subset, "shown_epoch", 0)
            if self._held is None or self._held[0] != epoch:
                self._held = None  # free the old pictures before new ones are painted
                self._held = epoch, Block(self.subset, self.episodes, self.pictures, self.stack, self.next_step)
            return self._held[1]

    def __getstate__(self) -> dict[str, Any]:
        # What is held is read again where the source lands: quicker than sending it.
        return {name: value for name, value in self.__dict__.items() if name != "_reading"} | {"_held": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_reading": threading.Lock()}

    def _read(self, place: int) -> dict[str, np.ndarray]:
        number = int(np.searchsorted(self._ends, place, side="right"))
        episode = int(self.episodes[number])
        step = int(place - (self._ends[number - 1] if number else 0))
        array, values = self.subset.array, {}
        first, after = max(0, step - self.stack + 1), step + (2 if self.next_step else 1)
        if self.pictures:
            frames = np.stack([array(name)[episode, first:after] for name in self.pictures], axis=1)
        for ahead, prefix in enumerate(("", "next_")[: 2 if self.next_step else 1]):
            values[f"{prefix}state"] = array("state")[episode, step + ahead]
            if self.pictures:
                rows = np.maximum(np.arange(step + ahead - self.stack + 1, step + ahead + 1), 0) - first
                values[f"{prefix}pixels"] = stack_channels(frames[np.maximum(rows, 0)])
        values |= {name: np.asarray(array(name)[episode, step]) for name in ("action", "reward", "discount")}
        return values | {"episode": np.asarray(episode), "step": np.asarray(step)}
