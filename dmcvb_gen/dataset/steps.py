"""The step table: read episodes of one or several subsets, and gather any of their steps with the frames before them.

All that reads for training stands on it: numpy batches, `StepSource`, the torch data sets and the agents' data. An
episode of L transitions has L + 1 rows, and episodes lie one after the other::

    row        0    1   ...  L_0 | L_0 + 1 ...             start + step
    frames     o_0  o_1 ...  o_L | o_0 of episode 1 ...    (channel, height, width) uint8
    action     a_0  a_1 ...  0   | a_0 of episode 1 ...    reward and discount likewise

A batch is one gather from these rows, never a loop over samples.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.parallel import ignore
from dmcvb_gen.text import format_bytes

FIELDS = ("state", "action", "reward", "discount")
READ_BYTES = 2**26
"""Bytes of a picture array that are decoded at a time, at most, but an episode at least."""


@dataclass(frozen=True)
class Selection:
    """The arrays and episodes of a subset that a table holds.

    Attributes:
      episodes: (episode,) int, indices of committed episodes.
      pictures: names of picture arrays, in the order of their channels; () holds states alone.
    """

    subset: Subset
    episodes: np.ndarray
    pictures: Sequence[str] = ()


class StepTable:
    """Rows of episodes, held in memory or mapped into it.

    Attributes:
      state: (row, state) float32. action: (row, action) float32. reward, discount: (row,) float32.
      frames: (row, look * view * 3, size, size + 2 * border) uint8, each line with its mirrored border at both ends;
        None if the table holds states alone.
      looks: settings that each row is seen under, see `Subset.looks`.
      lengths: (episode,) int64, transitions of each episode.
      episode, step: (row,) int64, the episode's index in its subset and the place in the episode.
      start, end: (row,) int64, first and last row of the row's episode.
      steps: (step,) int64, the rows that hold a transition.
    """

    def __init__(
        self,
        fields: Mapping[str, np.ndarray],
        lengths: np.ndarray,
        frames: np.ndarray | None = None,
        episodes: np.ndarray | None = None,
        first: int = 0,
        looks: int = 1,
    ):
        """Make a table of values that are in memory.

        Args:
          fields: the arrays named in `FIELDS`.
          episodes: (episode,) int, their indices; 0, 1, ... by default.
          first: step of each episode's first row, for a window into an episode.
        """
        self.state, self.action, self.reward, self.discount = (fields[name] for name in FIELDS)
        self.lengths, self.frames, self.looks = lengths.astype(np.int64), frames, looks
        rows, starts = lengths + 1, np.cumsum(lengths + 1) - (lengths + 1)
        self.start, self.end = np.repeat(starts, rows), np.repeat(starts + lengths, rows)
        self.episode = np.repeat(np.arange(len(rows)) if episodes is None else np.asarray(episodes, int), rows)
        row = np.arange(len(self.start))
        self.step, self.steps = row - self.start + first, row[row < self.end]

    @classmethod
    def read(
        cls,
        parts: Sequence[Selection],
        border: int = 0,
        folder: str | Path | None = None,
        tick: Callable[[float], None] = ignore,
    ) -> StepTable:
        """Read whole episodes, few at a time.

        Args:
          border: pixels that each line of the frames is longer at both ends, mirrored.
          folder: the frames lie in a file there that is mapped into memory, so that the system keeps of them what
            fits. The file has no name and is gone with the process. None holds them in memory.
          tick: called with the share of the rows that is read, from 0 to 1.

        Raises:
          StoreError: an episode is not there, has no pictures, or cannot be read.
          DmcvbError: the folder has no room for the file.
        """
        lengths = [part.subset.read("length", part.episodes).clip(0, part.subset.record.max_steps) for part in parts]
        rows = int(sum((length + 1).sum() for length in lengths))
        looks, size, frames = parts[0].subset.looks, parts[0].subset.record.size, None
        if parts[0].pictures:
            shape = (rows, looks * 3 * len(parts[0].pictures), size, size + 2 * border)
            frames = np.empty(shape, np.uint8) if folder is None else _mapped(shape, Path(folder))
        values: dict[str, list[np.ndarray]] = {name: [] for name in FIELDS}
        row = 0
        tick(0.0)
        for part, length in zip(parts, lengths, strict=True):
            few = max(1, READ_BYTES // (3 * size**2 * (1 + int(length.max(initial=0)))))
            part.subset.prepare(part.episodes, part.pictures)
            for episode in range(0, max(1, len(length)), few):
                chosen, ends = part.episodes[episode : episode + few], 1 + length[episode : episode + few]
                for name, found in part.subset.rows(FIELDS, chosen).items():
                    values[name].append(found)
                if frames is not None:
                    seen = part.subset.seen(part.pictures, chosen, int(ends.max(initial=0)))
                    for last, end, pictures in zip(row + np.cumsum(ends), ends, seen, strict=True):
                        _fill(frames[last - end : last], [picture[:end] for picture in pictures], border)
                row += int(ends.sum())
                tick(row / max(1, rows))
        fields = {name: np.concatenate(found) for name, found in values.items()}
        episodes = np.concatenate([part.episodes for part in parts])
        return cls(fields, np.concatenate(lengths), frames, episodes, looks=looks)

    @classmethod
    def window(cls, subset: Subset, episode: int, rows: slice, pictures: Sequence[str] = ()) -> StepTable:
        """Read some rows of one episode, for less than the whole of it takes."""
        read = {name: subset.array(name)[episode, rows] for name in (*FIELDS, *pictures)}
        count, size, frames = len(read["state"]), subset.record.size, None
        if pictures:
            frames = np.empty((count, subset.looks * 3 * len(pictures), size, size), np.uint8)
            shown = [read[name] for name in pictures]
            if subset.looks > 1:
                shown = [picture[:, look] for look in range(subset.looks) for picture in shown]
            _fill(frames, shown)
        return cls(read, np.array([count - 1]), frames, np.array([episode]), rows.start, subset.looks)

    def __len__(self) -> int:
        """Transitions in the table."""
        return len(self.steps)

    def gather(self, rows: np.ndarray, stack: int = 3, next_step: bool = False) -> dict[str, np.ndarray]:
        """The steps of some rows, as one batch.

        Args:
          rows: (batch,) int, out of `steps`.
          stack: frames an observation; the first frame of an episode is repeated before it (paper, section 4).
          next_step: give what comes next, too.

        Returns:
          "state" (batch, state) float32, "pixels" (batch, stack * view * 3, height, width) uint8 with the oldest frame
          first, "action" (batch, action) float32, "reward" and "discount" (batch,) float32, "episode" and "step"
          (batch,) int64; with `next_step` also "next_state" and "next_pixels". Of several looks, "pixels" is
          (batch, look, stack * view * 3, height, width).
        """
        values = self.observe(rows, stack)
        values |= {name: getattr(self, name)[rows] for name in (*FIELDS[1:], "episode", "step")}
        return values | self.observe(rows + 1, stack, "next_") if next_step else values

    def observe(self, rows: np.ndarray, stack: int = 1, prefix: str = "") -> dict[str, np.ndarray]:
        """State and pixels of some rows, see `gather`."""
        values = {f"{prefix}state": self.state[rows]}
        if self.frames is not None:
            stacks = np.maximum(rows[:, None] - np.arange(stack - 1, -1, -1), self.start[rows][:, None])
            _, channels, size, wide = self.frames.shape
            border = (wide - size) // 2
            frames = self.frames[..., border : border + size][stacks]  # (batch, stack, look * channel, size, size)
            one, looks = channels // self.looks, [self.looks] * (self.looks > 1)
            frames = frames.reshape(len(rows), stack, self.looks, one, size, size).swapaxes(1, 2)
            values[f"{prefix}pixels"] = frames.reshape(len(rows), *looks, stack * one, size, size)
        return values


def _fill(frames: np.ndarray, pictures: Sequence[np.ndarray], border: int = 0) -> None:
    """Put pictures, (row, size, size, 3) a look and view, into (row, look * view * 3, size, size + 2 * border)."""
    inner = frames[..., border : border + frames.shape[2]]
    for place, picture in enumerate(pictures):
        inner[:, 3 * place : 3 * place + 3] = picture.transpose(0, 3, 1, 2)
    if border:
        frames[..., :border], frames[..., -border:] = inner[..., :border][..., ::-1], inner[..., -border:][..., ::-1]


def _mapped(shape: tuple[int, ...], folder: Path) -> np.ndarray:
    """A uint8 array of that shape in a nameless file."""
    needed = math.prod(shape)
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            if needed > free:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.posix_fallocate(file.fileno(), 0, needed)  # a hole that others fill meanwhile would kill this process
        except OSError as error:
            raise DmcvbError(
                f"{format_bytes(needed)} of images fit neither into memory nor into {folder} ({format_bytes(free)} "
                f"free; {error.strerror}); give another --out, or more --memory"
            ) from None
        return np.memmap(file, np.uint8, "r+", shape=shape)
