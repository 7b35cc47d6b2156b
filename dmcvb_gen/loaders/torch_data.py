"""Torch data sets of a subset: frame stacks, transitions, whole episodes, and a shuffled stream.

They hold no open files, so they may be sent to the workers of a `DataLoader`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.steps import Selection, StepTable
from dmcvb_gen.loaders.sampler import Steps, StepSource, Views, stream


def _tensors(values: Steps) -> dict[str, torch.Tensor]:
    return {name: torch.as_tensor(value) for name, value in values.items()}


class _OfEpoch:
    """Data of an epoch that a loader's persistent workers see too: in shared memory, as they keep the data they have.

    Attributes:
      subset: subset that is read.
      epoch: 0 at the start.
    """

    def __init__(self, subset: Subset, epoch: int | None = None):
        self.subset = subset
        self._epoch = torch.tensor(-1 if epoch is None else epoch).share_memory_()  # -1: none was given

    @property
    def epoch(self) -> int:
        return max(0, int(self._epoch))

    def set_epoch(self, epoch: int) -> None:
        """Show other distractors, if the subset's are fresh, and take another order (of a stream; the same one for the
        same number), in a loader's workers too."""
        self._epoch.fill_(epoch)

    def _show(self, epoch: int | None = None) -> None:
        """Let the subset know the epoch (one with fresh distractors), in whichever process reads it.

        At every read, as other data sets of the subset may be at another epoch. One that was given none shows that of
        the subset. A pass that has begun keeps the epoch that was given before it.
        """
        epoch = int(self._epoch) if epoch is None else epoch
        if epoch >= 0:
            self.subset.set_epoch(epoch)


class StepDataset(_OfEpoch, Dataset):
    """Any step at random: frame stack, state, action, reward, discount (see `StepSource`), as tensors.

    A `DataLoader` takes whole batches from it at once. Held in memory, as by default if it fits, it is as fast as
    a `StreamDataset`; larger subsets are better streamed.

    Args:
      options: options of `StepSource`: episodes, pictures, stack, next_step, in_memory.
    """

    def __init__(self, subset: Subset, **options: Any):
        super().__init__(subset)
        self.source = StepSource(subset, **options)
        if self.source.in_memory:
            _ = self.source.table  # read now, so that workers that are forked share it

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, torch.Tensor]]:
        self._show()
        batch = _tensors(self.source.gather(indices))
        return [{name: value[row] for name, value in batch.items()} for row in range(len(indices))]


class EpisodeDataset(_OfEpoch, Dataset):
    """Whole episodes: "pixels" (L + 1, view * 3, height, width) uint8, "state" (L + 1, state), "action" (L, action),
    "reward", "discount" (L,), "episode"; episodes differ in length L if a task can end early.

    Args:
      episodes, pictures: see `StepSource`.
    """

    def __init__(self, subset: Subset, episodes: Sequence[int] | None = None, pictures: Views = None):
        super().__init__(subset)
        self.pictures, self.episodes = shown(subset, pictures).arrays, subset.choose(episodes)

    def __len__(self) -> int:
        return len(self.episodes)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        self._show()
        episode = self.episodes[index]
        table = StepTable.read([Selection(self.subset, self.episodes[[index]], self.pictures)])
        values = {name: getattr(table, name)[: len(table)] for name in ("action", "reward", "discount")}
        return _tensors(values | table.observe(np.arange(len(table.state))) | {"episode": episode})


class StreamDataset(_OfEpoch, IterableDataset):
    """All steps once an epoch, shuffled, read an episode at a time; shared among a loader's workers.

    Give it to a `DataLoader` with `batch_size=None` when it makes the batches itself (`batch_size` here), and call
    `set_epoch` before each epoch for another order. For several ranks of torch.distributed, take a `StepDataset` and
    torch's `DistributedSampler`.

    Args:
      batch_size, episodes, pictures, stack, next_step, shuffle, seed, buffer, drop_last: see `sampler.stream`.
    """

    def __init__(self, subset: Subset, **options: Any):
        super().__init__(subset, options.pop("epoch", None))
        self.options = options

    def __iter__(self) -> Iterator[dict[str, torch.Tensor]]:
        given = int(self._epoch)  # of the whole pass, though others may read the subset between its batches
        worker = get_worker_info()
        place: dict[str, Any] = dict(worker=worker.id, workers=worker.num_workers) if worker else {}
        items = stream(self.subset, epoch=max(0, given), **place, **self.options)
        self._show(given)
        for values in items:
            yield _tensors(values)
            self._show(given)
