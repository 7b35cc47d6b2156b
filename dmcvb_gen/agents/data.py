"""Training data of the agents: batches of frame stacks, states and transitions from a step table.

The rows are those of `dataset.steps.StepTable`. Pictures stay uint8 until they are in a batch. They are held in memory
(or on the accelerator) if they fit, else decoded once into a file that is mapped into memory.
"""

from __future__ import annotations

import math
import mmap
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from dmcvb_gen.agents.learners import Batch
from dmcvb_gen.arithmetic import to_unit
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.steps import FIELDS, Selection, StepTable
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.parallel import ignore
from dmcvb_gen.parallel.memory import UNKNOWN_MEMORY, free_memory

FRAMES = 3
"""Frames an observation; the first one of an episode is repeated (paper, appendix "Encoders")."""
PAD = 4
"""Pixels that a random shift may move a stack, either way (section 5, "Preprocessing details")."""
HOLD_OUT = 0.05
"""Share of the episodes that no agent learns from."""
STD_FLOOR = 1e-3
ENCODED_ROWS = 256
"""Observations that are encoded at a time."""
AHEAD = 4
"""Batches that threads draw ahead."""


@dataclass(frozen=True)
class Slice:
    """A part of a subset, by name.

    Attributes:
      share: share of its episodes, at least one, drawn by the seed of the split.
      episodes: so many of its episodes instead.
      goal_pair: only episodes of this fixed (start, goal) pair (mazes).
    """

    subset: str
    share: float = 1.0
    episodes: int | None = None
    goal_pair: int | None = None

    @property
    def label(self) -> str:
        """Its level, and how much of it: "expert", "20 expert", "5% expert", "expert goal 3"."""
        level = self.subset.split("/")[-2]
        if self.goal_pair is not None:
            return f"{level} goal {self.goal_pair}"
        if self.episodes is not None:
            return f"{self.episodes} {level}"
        return level if self.share == 1 else f"{100 * self.share:g}% {level}"


@dataclass(frozen=True)
class Normalization:
    """Centers and scales states: (s - mean) / std; both (state,) float32."""

    mean: torch.Tensor
    std: torch.Tensor

    def __call__(self, state: torch.Tensor) -> torch.Tensor:
        return (state - self.mean.to(state.device)) / self.std.to(state.device)

    @classmethod
    def of(cls, state: torch.Tensor) -> Normalization:
        """Statistics of (row, state) values, std floored at 1e-3."""
        values = state.double()
        std = values.std(dim=0, correction=0).clamp(min=STD_FLOOR)
        return cls(values.mean(dim=0).float(), std.float())


class FrameTable:
    """The frames of a table that was read with a border of `PAD`, as a tensor.

    A shifted line of pixels is `size` bytes that stand together, so that picking frames, stacking them and moving them
    is one gather of lines, for any number of stacks. The borders take an eighth more bytes. Frames in a file are asked
    for before they are gathered, so that the disk reads a batch's stacks at once.

    Attributes:
      table: (row, channel, size, size + 2 PAD) uint8.
      mapped: True if they lie in a file.
    """

    def __init__(self, frames: np.ndarray, device: str | torch.device = "cpu"):
        self.mapped = isinstance(frames, np.memmap)
        self.table = torch.from_numpy(frames).to("cpu" if self.mapped else device)
        self._file = frames.base if isinstance(frames.base, mmap.mmap) else None
        if self._file is not None:
            _advise(self._file, mmap.MADV_RANDOM, 0, frames.nbytes)  # what stands beside a stack is not read with it
        _, self.channels, self.size, _ = frames.shape
        # Which pixel stands where, after padding.
        self._mirror = torch.from_numpy(np.pad(np.arange(self.size), PAD, mode="symmetric")).to(self.table.device)

    def shifted(self, rows: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        """(batch, frames) rows, (2, batch) offsets -> (batch, frames x channels, size, size) uint8."""
        rows, (down, right) = rows.to(self._mirror.device), shift.to(self._mirror.device)
        if self._file is not None:
            frame = self.table[0].numel()
            for first, last in rows[:, [0, -1]].tolist():
                _advise(self._file, mmap.MADV_WILLNEED, first * frame, (last + 1) * frame)
        (batch, frames), wide = rows.shape, self.size + 2 * PAD
        # The last line is picked twice. Otherwise planes of 64 x 64 would lie a page apart, and all channels of a pixel
        # would compete for the same few lines of the processor's cache when they are brought together.
        order = torch.arange(self.size + 1, device=rows.device).clamp(max=self.size - 1)
        line = self._mirror[down[:, None] + order]  # (batch, size + 1)
        plane = rows[:, :, None] * self.channels + torch.arange(self.channels, device=rows.device)
        first = plane.flatten(1) * (self.size * wide) + right[:, None]  # (batch, frames x channels)
        index = first[:, :, None] + (line * wide)[:, None]  # (batch, frames x channels, size + 1)
        flat = self.table.view(-1)
        lines = flat.as_strided((len(flat) - self.size + 1, self.size), (1, 1)).index_select(0, index.reshape(-1))
        return lines.view(batch, frames * self.channels, self.size + 1, self.size)[:, :, :-1]


def _advise(file: mmap.mmap, use: int, start: int, stop: int) -> None:
    """Tell the system how bytes start..stop of a mapped file will be used."""
    start -= start % mmap.PAGESIZE
    file.madvise(use, start, stop - start)


def normalize_pixels(pictures: torch.Tensor, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """(batch, channel, size, size) uint8 -> [-0.5, 0.5]; channels lie last in memory.

    Convolutions want that layout; otherwise they would convert it forward and backward. In this order bfloat16
    rounds once, as autocast would: 127.5 less is exact in 8 bits.
    """
    turned = pictures.contiguous(memory_format=torch.channels_last)  # while they are bytes
    return turned.to(dtype).sub_(127.5).mul_(1 / 255)


@dataclass(frozen=True)
class Sizes:
    """Numbers that networks are made for.

    Attributes:
      state, action: numbers of each.
      channels: channels of an observation: 3 x views x frames of the stack. picture: pixels a side. stack: frames.
        All 0 for agents that see states.
    """

    state: int
    action: int
    channels: int = 0
    picture: int = 0
    stack: int = 0


class TrainingData:
    """Episodes of one or several subsets, ready to be drawn from.

    Args:
      table: their rows, with frames that have a border of `PAD`, or none.
      held_out: (episode,) bool, which episodes no agent learns from.
      returns: (episode,) float64, of all episodes in it.
      device: device that holds everything.

    Attributes:
      state: (row, state) float32, normalized.
      action: (row, action) float32 in [-1, 1], whatever the task's bounds. reward, discount: (row,) float32.
      start, end: (row,) long, first and last row of the row's episode.
      normalization: normalization of the states, from the training episodes.
      train_rows, hold_out_rows: (n,) long, rows that hold a transition.
      latent: (row, latent) float32 of a frozen encoder (`encoded`); None elsewhere.
      stack: frames an observation; `but` gives another one.
    """

    latent: torch.Tensor | None = None
    stack: int = FRAMES
    labeled_rows: torch.Tensor

    def __init__(self, table: StepTable, held_out: np.ndarray, returns: np.ndarray | None = None, device: str = "cpu"):
        values = (getattr(table, name) for name in (*FIELDS, "start", "end", "steps"))
        state, *values, self.start, self.end, rows = (torch.from_numpy(value).to(device) for value in values)
        self.action, self.reward, self.discount = (value.float() for value in values)
        held = torch.from_numpy(np.repeat(held_out, table.lengths + 1)).to(device)
        self.train_rows, self.hold_out_rows = rows[~held[rows]], rows[held[rows]]
        self.normalization = Normalization.of(state[~held])
        self.state = self.normalization(state.float())
        self.frames = None if table.frames is None else FrameTable(table.frames, device)
        self.lengths, self.held_out, self.returns = table.lengths, held_out, returns

    @property
    def sizes(self) -> Sizes:
        """Sizes that networks for these data need."""
        pictures = () if self.frames is None else (self.frames.channels * self.stack, self.frames.size, self.stack)
        return Sizes(self.state.shape[1], self.action.shape[1], *pictures)

    @property
    def device(self) -> torch.device:
        return self.state.device

    def __len__(self) -> int:
        return len(self.train_rows)

    def observe(
        self, rows: torch.Tensor, shift: torch.Tensor | None = None, dtype: torch.dtype = torch.float32
    ) -> torch.Tensor:
        """Observations at rows: (batch, channels, size, size) in [-0.5, 0.5], or (batch, state) without pictures.

        Args:
          shift: (2, batch) long, offsets of the pictures down and right in 0..2 PAD; None: not shifted.
          dtype: dtype of pictures.
        """
        if self.frames is None:
            return self.state[rows]
        if shift is None:
            shift = rows.new_full((2, len(rows)), PAD)
        back = torch.arange(self.stack - 1, -1, -1, device=rows.device)
        stacks = torch.maximum(rows[:, None] - back, self.start[rows][:, None])
        return normalize_pixels(self.frames.shifted(stacks, shift).to(self.device), dtype)

    def batch(
        self,
        size: int,
        generator: np.random.Generator,
        *,
        next_observation: bool = False,
        k: int = 1,
        sample_k: bool = False,
        hold_out: bool = False,
        shift: bool = True,
        **options: Any,
    ) -> Batch:
        """Transitions drawn uniformly, with replacement.

        Args:
          next_observation: give the observation k steps later too, under the same shift.
          k: steps between the two; with `sample_k` drawn from 1..k for each.
          hold_out: draw from the held-out episodes, without shifts.
          shift: move each stack of pictures by up to 4 pixels either way (section 5, "Preprocessing details").
          options: dtype, pictures and later of `transitions`.

        Raises:
          DmcvbError: there are no transitions to draw from.
        """
        rows = self.hold_out_rows if hold_out else self.train_rows
        if next_observation and k > 1:
            rows = rows[rows + k <= self.end[rows]]
        if not len(rows):
            kind = "held-out " if hold_out else ""
            cure = "roll out more episodes" if k == 1 else f"roll out episodes of more than {k} steps"
            raise DmcvbError(f"there are no {kind}transitions to draw from (k = {k}); {cure}")
        index = generator.integers(len(rows), size=size)
        offsets = steps = None
        if shift and not hold_out and self.frames is not None and self.latent is None:
            offsets = self._to_device(generator.integers(2 * PAD + 1, size=(2, size)))
        if next_observation:
            steps = self._to_device(generator.integers(1, k + 1, size=size) if sample_k else np.full(size, k))
        return self.transitions(rows[self._to_device(index)], steps, offsets, **options)

    def transitions(
        self,
        rows: torch.Tensor,
        steps: torch.Tensor | None = None,
        shift: torch.Tensor | None = None,
        dtype: torch.dtype = torch.float32,
        pictures: bool = True,
        later: bool = False,
    ) -> Batch:
        """The transitions of given rows.

        Args:
          rows: (batch,) long.
          steps: (batch,) long, how far off the next observation is; None: no next observation.
          shift, dtype: see `observe`. Half the bytes are half the time to write them.
          pictures: give observations even if the data are encoded.
          later: the next observation is one step later, and the one that is `steps` later is given besides.
        """
        now = following = last = None
        if pictures or self.latent is None:
            now = self.observe(rows, shift, dtype)
            if steps is not None:
                following = self.observe(rows + (1 if later else steps), shift, dtype)
            if later:
                last = self.observe(rows + steps, shift, dtype)
        latent = self.latent
        return Batch(
            observation=now,
            state=self.state[rows],
            action=self.action[rows],
            reward=self.reward[rows],
            discount=self.discount[rows],
            next_observation=following,
            later_observation=last,
            k=steps,
            latent=None if latent is None else latent[rows],
            next_latent=None if latent is None or steps is None else latent[rows + steps],
        )

    def _to_device(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device)

    def with_labels(self, episodes: np.ndarray) -> TrainingData:
        """The same episodes, of which some are labeled, (episode,) bool: tests are of others."""
        labeled = self._to_device(np.repeat(episodes, self.lengths + 1))
        rows = torch.cat([self.train_rows, self.hold_out_rows])
        tests = self.hold_out_rows[~labeled[self.hold_out_rows]]
        return self.but(labeled_rows=rows[labeled[rows]], hold_out_rows=tests)

    @torch.no_grad()
    def encoded(
        self, encoder: nn.Module, dtype: torch.dtype = torch.float32, progress: Callable[[float], None] = ignore
    ) -> TrainingData:
        """The same episodes with the latents of a frozen encoder, computed once; its pictures are not shifted.

        Args:
          progress: called with the share of the rows that are encoded.
        """
        rows = torch.arange(len(self.state), device=self.device)
        parts = []
        for few in rows.split(ENCODED_ROWS):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
                parts.append(encoder(self.observe(few, dtype=dtype)).float())
            progress((int(few[-1]) + 1) / len(rows))
        return self.but(latent=torch.cat(parts))

    def but(self, **changes) -> TrainingData:
        """The same episodes with other attributes: `frames=None` for agents that see states, another `stack`."""
        twin = object.__new__(TrainingData)
        twin.__dict__.update(self.__dict__ | changes)
        return twin


def batches(draw: Callable[[int], Batch], steps: int, workers: int = 0) -> Iterator[tuple[int, Batch]]:
    """(step, batch) of each step, in order; `AHEAD` are drawn by threads meanwhile if there are workers."""
    if not workers:
        yield from ((step, draw(step)) for step in range(steps))
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting = {step: pool.submit(draw, step) for step in range(min(AHEAD, steps))}
        for step in range(steps):
            batch = waiting.pop(step).result()
            if step + AHEAD < steps:
                waiting[step + AHEAD] = pool.submit(draw, step + AHEAD)
            yield step, batch


def choose_episodes(subset: Subset, part: Slice, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(episodes, held out) of a slice of a subset, and which of those no agent learns from.

    5 % are held out, but none of a single episode, of a counted few or of a goal pair's: the paper's policies learn
    from all of those.
    """
    names = subset.episodes
    if part.goal_pair is not None:
        names = names[subset.read("goal_pair") == part.goal_pair]
    count = min(part.episodes or max(1, round(part.share * len(names))), len(names))
    chosen = np.random.default_rng(seed).permutation(len(names))[:count]
    few = part.episodes is not None or part.goal_pair is not None
    held_out = 0 if few else min(math.ceil(HOLD_OUT * count), count - 1)
    held = np.arange(count) >= count - held_out  # the last: labeled few are the first, and are learned from
    by_name = np.argsort(names[chosen])
    return names[chosen][by_name], held[by_name]


def labeled_episodes(release: Release, slices: Sequence[Slice], labels: Sequence[Slice], seed: int) -> np.ndarray:
    """(episode,) bool: which episodes of the slices are among the labeled ones, in the order of `load_data`."""
    split = [(part.subset, *choose_episodes(release[part.subset], part, seed)) for part in labels]
    known = {(subset, episode) for subset, episodes, held in split for episode in episodes[~held]}
    chosen = [(part.subset, choose_episodes(release[part.subset], part, seed)[0]) for part in slices]
    return np.array([(subset, episode) in known for subset, episodes in chosen for episode in episodes])


def default_memory(device: str = "cpu") -> int:
    """Bytes of pictures that are held: half of what the machine (or its accelerator) has free."""
    if device.startswith("cuda"):
        return torch.cuda.mem_get_info(device)[0] // 2
    return (free_memory() or UNKNOWN_MEMORY) // 2


def load_data(
    release: Release,
    slices: Sequence[Slice],
    *,
    pixels: bool = True,
    seed: int = 0,
    device: str = "cpu",
    memory: int | None = None,
    scratch: str | Path | None = None,
    tick: Callable[[float], None] = ignore,
) -> TrainingData:
    """Read slices of a release (mixed, if there are several) for training.

    Args:
      pixels: agents see pictures; else states.
      seed: seed of the episode split and of shares.
      memory: bytes of pictures to hold at most; larger data are mapped into memory from a file.
      scratch: folder of that file; the system's folder of temporary files by default.
      tick: called with the share of the data that is read, from 0 to 1.

    Raises:
      DmcvbError: the subsets are of different tasks or picture sizes, or hold no pictures.
    """
    subsets = [release[part.subset] for part in slices]
    names = [shown(subset, "agents").arrays if subset.pixel_arrays else () for subset in subsets]
    records = [subset.record for subset in subsets]
    alike = {(r.task, r.size, r.action_repeat, r.max_steps, len(n)) for r, n in zip(records, names, strict=True)}
    if len(alike) != 1:
        mixed = ", ".join(subset.name for subset in subsets)
        raise DmcvbError(f"cannot mix {mixed}: tasks, image sizes, action repeats or most steps differ")
    if pixels and not names[0]:
        raise DmcvbError(f"{subsets[0].name} has no images that agents are trained on")
    split = [choose_episodes(subset, part, seed) for subset, part in zip(subsets, slices, strict=True)]
    chosen, held_out = zip(*split, strict=True)
    parts = [Selection(s, e, n if pixels else ()) for s, e, n in zip(subsets, chosen, names, strict=True)]
    size, lengths = subsets[0].record.size, [part.subset.read("length", part.episodes) for part in parts]
    needed = int((np.concatenate(lengths) + 1).sum()) * 3 * len(names[0]) * size * (size + 2 * PAD)
    if memory is None:  # an accelerator's pictures are read into main memory first
        memory = min(default_memory(place) for place in ("cpu", device))
    table = StepTable.read(parts, PAD, None if needed <= memory else scratch or tempfile.gettempdir(), tick)
    bounds = subsets[0].array("action").attributes  # agents act in [-1, 1], whatever the task's bounds
    if "low" in bounds:
        table.action[:] = to_unit(table.action, *(np.array(bounds[name], np.float32) for name in ("low", "high")))
    returns = np.concatenate([part.subset.read("return", part.episodes) for part in parts])
    return TrainingData(table, np.concatenate(held_out), returns, device)
