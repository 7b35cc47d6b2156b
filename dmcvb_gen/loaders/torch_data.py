"""Torch data sets of a subset: frame stacks, transitions, whole episodes, and a shuffled stream.

They hold no open files, so they may be sent to the workers of a `DataLoader`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.steps import Part, StepTable
from dmcvb_gen.loaders.source import StepSource
from dmcvb_gen.loaders.stream import Steps, stream


def _tensors(values: Steps) -> dict[str, torch.Tensor]:
    return {name: torch.as_tensor(value) for name, value in values.items()}


class _Epochs:
    """An epoch that a loader's persistent workers see too: in shared memory, as they keep the data they began with."""

    def __init__(self, subset: Subset, given: int | None = None):
        self._subset = subset
        self._epoch = torch.tensor(-1 if given is None else given).share_memory_()  # -1: nobody has given one

    @property
    def number(self) -> int:
        return max(0, int(self._epoch))

    def set(self, epoch: int) -> None:
        self._epoch.fill_(epoch)

    @property
    def given(self) -> int:
        """The epoch; -1 where nobody has given one."""
        return int(self._epoch)

    def take(self, given: int | None = None) -> None:
        """Let the subset know (one with fresh distractors), in whichever process reads it.

        At every read, as other data sets of the subset may be at another epoch. One that was given none shows that of
        the subset. A pass that has begun keeps the epoch that was given before it.
        """
        given = self.given if given is None else given
        if given >= 0 and getattr(self._subset, "epoch", given) != given:
            self._subset.set_epoch(given)  # type: ignore[attr-defined]


class StepDataset(Dataset):
    """Any step at random: frame stack, state, action, reward, discount (see `source.StepSource`), as tensors.

    A `DataLoader` takes whole batches from it at once. Held in memory, as by default where it fits, it is as fast as
    a `StreamDataset`; larger subsets are better streamed.

    Args:
      options: of `StepSource`: episodes, pictures, stack, next_step, in_memory.
    """

    def __init__(self, subset: Subset, **options: Any):
        self.source, self._epochs = StepSource(subset, **options), _Epochs(subset)
        if self.source.in_memory:
            _ = self.source.table  # read now, so that workers that are forked share it

    def __len__(self) -> int:
        return len(self.source)

    def set_epoch(self, epoch: int) -> None:
        """Show other distractors, if the subset's are fresh, in a loader's workers too."""
        self._epochs.set(epoch)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        self._epochs.take()
        return _tensors(self.source[index])

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, torch.Tensor]]:
        self._epochs.take()
        batch = _tensors(self.source.gather(indices))
        return [{name: value[row] for name, value in batch.items()} for row in range(len(indices))]


class EpisodeDataset(Dataset):
    """Whole episodes: "pixels" (L + 1, view * 3, height, width) uint8, "state" (L + 1, state), "action" (L, action),
    "reward", "discount" (L,), "episode"; episodes differ in length L where a task can end early.

    Args:
      episodes, pictures: as for `StepSource`.
    """

    def __init__(
        self,
        subset: Subset,
        episodes: Sequence[int] | None = None,
        pictures: Sequence[str] | None = None,
    ):
        self.subset, self.pictures = subset, shown(subset, pictures).arrays
        self.episodes, self._epochs = subset.choose(episodes), _Epochs(subset)

    def __len__(self) -> int:
        return len(self.episodes)

    def set_epoch(self, epoch: int) -> None:
        """Show other distractors, if the subset's are fresh, in a loader's workers too."""
        self._epochs.set(epoch)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        self._epochs.take()
        episode = self.episodes[index]
        table = StepTable.read([Part(self.subset, self.episodes[[index]], self.pictures)])
        values = {name: getattr(table, name)[: len(table)] for name in ("action", "reward", "discount")}
        values |= {"state": table.state, "episode": episode}
        return _tensors(values if table.frames is None else values | {"pixels": table.frames})


class StreamDataset(IterableDataset):
    """All steps once an epoch, shuffled, read an episode at a time; shared among ranks and loader workers.

    Give it to a `DataLoader` with `batch_size=None` when it makes the batches itself (`batch_size` here), and call
    `set_epoch` before each epoch for another order.

    Args:
      batch_size, episodes, pictures, stack, next_step, shuffle, seed, buffer, drop_last: see `stream.stream`.
      rank, world: this process's share; those of torch.distributed by default, where it runs.
    """

    def __init__(self, subset: Subset, *, rank: int | None = None, world: int | None = None, **options: Any):
        self.subset, self.options = subset, options
        self._epochs = _Epochs(subset, options.pop("epoch", None))
        running = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if running else 0
        self.world = world if world is not None else torch.distributed.get_world_size() if running else 1

    @property
    def epoch(self) -> int:
        return self._epochs.number

    def set_epoch(self, epoch: int) -> None:
        """Take another order (and the same one for the same number), and show other distractors, if the subset's are
        fresh; in a loader's workers too."""
        self._epochs.set(epoch)

    def __iter__(self) -> Iterator[dict[str, torch.Tensor]]:
        given = self._epochs.given  # of the whole pass, though others may read the subset between its batches
        worker = get_worker_info()
        place = (worker.id, worker.num_workers) if worker else (0, 1)
        items = stream(
            self.subset,
            epoch=max(0, given),
            rank=self.rank,
            world=self.world,
            worker=place[0],
            workers=place[1],
            **self.options,
        )
        while True:
            self._epochs.take(given)
            values = next(items, None)
            if values is None:
                return
            yield _tensors(values)
