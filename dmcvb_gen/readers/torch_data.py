"""Torch data sets of a subset: frame stacks, transitions, whole episodes, and a shuffled stream.

They hold no open files, so they may be sent to the workers of a `DataLoader`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from dmcvb_gen.readers.blocks import Block, stack_channels, stream
from dmcvb_gen.readers.release import SubsetReader, picture_names


def _tensors(values: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.as_tensor(np.ascontiguousarray(value)) for name, value in values.items()}


class StepDataset(Dataset):
    """Any step at random: frame stack, state, action, reward, discount (see `blocks.Block.gather` for the shapes).

    Args:
      episodes: indices of committed episodes, all by default.
      pictures: picture arrays, all visible views by default; () gives states alone.
      stack: frames a stack.
      next_step: also "next_pixels" and "next_state".
      in_memory: read everything now: random steps are then some hundred times faster.
    """

    def __init__(
        self,
        subset: SubsetReader,
        episodes: Sequence[int] | None = None,
        pictures: Sequence[str] | None = None,
        stack: int = 3,
        next_step: bool = False,
        in_memory: bool = False,
    ):
        self.subset, self.stack, self.next_step = subset, stack, next_step
        self.pictures = picture_names(subset, pictures)
        self.episodes = subset.choose(episodes)
        by_episode = dict(zip(subset.episodes.tolist(), subset.lengths.tolist(), strict=True))
        self._ends = np.cumsum([by_episode[int(episode)] for episode in self.episodes])
        self._block = Block(subset, self.episodes, self.pictures, stack, next_step) if in_memory else None

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        if index < 0:
            index += len(self)
        if not 0 <= index < len(self):
            raise IndexError(f"step {index} of {len(self)}")
        if self._block is not None:
            return {name: value[0] for name, value in _tensors(self._block.gather(np.array([index]))).items()}
        place = int(np.searchsorted(self._ends, index, side="right"))
        episode = int(self.episodes[place])
        step = int(index - (self._ends[place - 1] if place else 0))
        array, values = self.subset.array, {}
        first, after = max(0, step - self.stack + 1), step + (2 if self.next_step else 1)
        if self.pictures:
            frames = np.stack([array(name)[episode, first:after] for name in self.pictures], axis=1)
        for ahead, prefix in enumerate(("", "next_")[: 2 if self.next_step else 1]):
            values[f"{prefix}state"] = array("state")[episode, step + ahead]
            if self.pictures:
                rows = np.maximum(np.arange(step + ahead - self.stack + 1, step + ahead + 1), 0) - first
                values[f"{prefix}pixels"] = stack_channels(frames[np.maximum(rows, 0)])
        values |= {name: array(name)[episode, step] for name in ("action", "reward", "discount")}
        return _tensors(values | {"episode": np.asarray(episode), "step": np.asarray(step)})


class EpisodeDataset(Dataset):
    """Whole episodes: "pixels" (L + 1, view * 3, height, width) uint8, "state" (L + 1, state), "action" (L, action),
    "reward", "discount" (L,), "episode"; episodes differ in length L where a task can end early.

    Args: as for `StepDataset`.
    """

    def __init__(
        self,
        subset: SubsetReader,
        episodes: Sequence[int] | None = None,
        pictures: Sequence[str] | None = None,
    ):
        self.subset, self.pictures = subset, picture_names(subset, pictures)
        self.episodes = subset.choose(episodes)

    def __len__(self) -> int:
        return len(self.episodes)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        episode = int(self.episodes[index])
        values = self.subset.episode(episode, ["state", "action", "reward", "discount", *self.pictures])
        if self.pictures:
            frames = np.stack([values.pop(name) for name in self.pictures], axis=1)  # (row, view, height, width, 3)
            values["pixels"] = stack_channels(frames[:, None])
        return _tensors(values | {"episode": np.asarray(episode)})


class StreamDataset(IterableDataset):
    """All steps once an epoch, shuffled, read an episode at a time; shared among ranks and loader workers.

    Give it to a `DataLoader` with `batch_size=None` when it makes the batches itself (`batch_size` here), and call
    `set_epoch` before each epoch for another order.

    Args:
      batch_size, episodes, pictures, stack, next_step, shuffle, seed, buffer, drop_last: see `blocks.stream`.
      rank, world: this process's share; those of torch.distributed by default, where it runs.
    """

    def __init__(self, subset: SubsetReader, *, rank: int | None = None, world: int | None = None, **options):
        self.subset, self.options, self.epoch = subset, options, options.pop("epoch", 0)
        running = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if running else 0
        self.world = world if world is not None else torch.distributed.get_world_size() if running else 1

    def set_epoch(self, epoch: int) -> None:
        """Take another order (and the same one for the same number)."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[dict[str, torch.Tensor]]:
        worker = get_worker_info()
        place = (worker.id, worker.num_workers) if worker else (0, 1)
        items = stream(
            self.subset,
            epoch=self.epoch,
            rank=self.rank,
            world=self.world,
            worker=place[0],
            workers=place[1],
            **self.options,
        )
        for values in items:
            yield _tensors(values)
