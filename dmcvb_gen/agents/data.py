"""Training data of the agents: subsets of a release in, batches of frame stacks, states and transitions out.

Episodes lie one after the other in one table of rows, L + 1 rows an episode (row t: observation t, the action
taken there, its reward); a batch is a gather from that table, never a loop over samples::

    row        0    1   ...  L_0 | L_0 + 1 ...          start[e] + t
    frames     o_0  o_1 ...  o_L | o_0 of episode 1 ...  (channel, height, width) uint8

Pictures stay uint8 until they are in a batch. They are held in memory (or on the accelerator) where they fit, else
decoded once into a file that is mapped into memory.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.utils.data import Dataset

from dmcvb_gen.agents.learners import Batch
from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import training_pictures
from dmcvb_gen.errors import DmcvbError

FRAMES = 3
"""Frames an observation; the first one of an episode is repeated (paper, appendix "Encoders")."""
PAD = 4
"""Pixels that a random shift may move a stack, either way (section 5, "Preprocessing details")."""
HOLD_OUT = 0.05
"""Share of the episodes that no agent learns from."""
STD_FLOOR = 1e-3
ENCODED_ROWS = 256
"""Observations that are encoded at a time."""
READ_EPISODES = 10
"""Episodes decoded at a time while a subset is loaded."""


@dataclass(frozen=True)
class Source:
    """A part of a subset.

    Attributes:
      share: of its episodes, drawn by the seed of the split.
      episodes: so many of its episodes instead.
      goal_pair: only episodes of this fixed (start, goal) pair (mazes).
    """

    subset: Subset
    share: float = 1.0
    episodes: int | None = None
    goal_pair: int | None = None


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


def mirror(size: int) -> torch.Tensor:
    """(size + 2 PAD,) long: which pixel stands where after padding that repeats the border in reverse."""
    index = torch.arange(size + 2 * PAD) - PAD
    index = torch.where(index < 0, -index - 1, index)
    return torch.where(index >= size, 2 * size - 1 - index, index)


def _mapped_file(shape: tuple[int, ...], folder: Path) -> np.ndarray:
    """A uint8 array of that shape in a nameless file."""
    needed = math.prod(shape)
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise DmcvbError(
            f"{needed / 1e9:.1f} GB of pictures fit neither into memory nor into {folder} ({free / 1e9:.1f} GB free); "
            "give another --out, or more --memory"
        )
    with tempfile.TemporaryFile(dir=folder) as file:
        file.truncate(needed)
        return np.memmap(file, np.uint8, "r+", shape=shape)


class HeldFrames:
    """Pictures in memory, or in a file mapped into it, each line with its mirrored border at both ends.

    The borders take an eighth more bytes.

    A shifted line of pixels then is `size` bytes that stand together, so that picking frames, stacking them and moving
    them is one gather of lines, for any number of stacks.

    Args:
      rows: pictures it has room for; `put` fills it.
      scratch: a folder; the pictures then lie in a file there that is mapped into memory, so that the system keeps of
        them what fits. The file has no name and is gone with the process.

    Raises:
      DmcvbError: the folder has no room for the file.
    """

    def __init__(
        self,
        rows: int,
        channels: int,
        size: int,
        device: str | torch.device = "cpu",
        scratch: str | Path | None = None,
    ):
        self.channels, self.size, self.mapped = channels, size, scratch is not None
        shape = (rows, channels, size, size + 2 * PAD)
        if scratch is None:
            self.table = torch.empty(shape, dtype=torch.uint8, device=device)
        else:
            self.table = torch.from_numpy(_mapped_file(shape, Path(scratch)))
            device = "cpu"
        self._mirror = mirror(size).to(device)

    @property
    def pictures(self) -> torch.Tensor:
        """(row, channel, size, size) uint8, a view."""
        return self.table[..., PAD:-PAD]

    def put(self, first: int, pictures: torch.Tensor, channel: int = 0) -> None:
        """Fill rows from `first` on, channels from `channel` on, with (n, c, size, size) uint8 pictures."""
        rows, channels = slice(first, first + len(pictures)), slice(channel, channel + pictures.shape[1])
        filled = self.table[rows, channels]
        inner = filled[..., PAD:-PAD]
        inner[:] = pictures.to(filled.device)
        filled[..., :PAD], filled[..., -PAD:] = inner[..., :PAD].flip(-1), inner[..., -PAD:].flip(-1)

    def shifted(self, rows: torch.Tensor, down: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """(batch, frames) rows, (batch,) offsets in 0..2 PAD -> (batch, frames x channels, size, size) uint8."""
        rows, down, right = (values.to(self._mirror.device) for values in (rows, down, right))
        (batch, frames), wide = rows.shape, self.size + 2 * PAD
        line = self._mirror[down[:, None] + torch.arange(self.size, device=rows.device)]  # (batch, size)
        plane = rows[:, :, None] * self.channels + torch.arange(self.channels, device=rows.device)
        first = plane.flatten(1) * (self.size * wide) + right[:, None]  # (batch, frames x channels)
        index = first[:, :, None] + (line * wide)[:, None]  # (batch, frames x channels, size)
        flat = self.table.view(-1)
        lines = flat.as_strided((len(flat) - self.size + 1, self.size), (1, 1)).index_select(0, index.reshape(-1))
        return lines.view(batch, frames * self.channels, self.size, self.size)


def normalize_pixels(
    pictures: torch.Tensor, dtype: torch.dtype = torch.float32, out: torch.Tensor | None = None
) -> torch.Tensor:
    """(batch, channel, size, size) uint8 -> [-0.5, 0.5], written over `out` if given; channels lie last in memory.

    So convolutions want them; else these would turn them over again, forward and backward. In this order bfloat16
    rounds once, as autocast would: 127.5 less is exact in 8 bits.
    """
    values = pictures.to(dtype).sub_(127.5).mul_(1 / 255)  # as they lie, and turned last: a quarter faster
    return values.contiguous(memory_format=torch.channels_last) if out is None else out.copy_(values)


def stack_rows(row: torch.Tensor, start: torch.Tensor, frames: int) -> torch.Tensor:
    """(batch,) rows and the first rows of their episodes -> (batch, frames) rows, oldest first."""
    back = torch.arange(frames - 1, -1, -1, device=row.device)
    return torch.maximum(row[:, None] - back, start[:, None])


def training_views(subset: Subset) -> tuple[str, ...]:
    """The picture arrays that agents see (`store.pictures.training_pictures`); none where no pictures are stored."""
    return training_pictures(subset).arrays if subset.pixel_arrays else ()


@dataclass(frozen=True)
class Sizes:
    """Numbers that networks are made for.

    Attributes:
      state, action: numbers of each.
      channels: of an observation: 3 x views x frames of the stack. picture: pixels a side. stack: frames. All 0 for
        agents that see states.
    """

    state: int
    action: int
    channels: int = 0
    picture: int = 0
    stack: int = 0


class TrainingData(Dataset):
    """Episodes of one or several subsets, ready to be drawn from.

    As a torch data set it has an item a training transition: (observation, action); `__getitems__` gives many at
    once, which a DataLoader uses. Training calls `batch`.

    Attributes:
      state: (row, state) float32, normalized.
      action: (row, action) float32. reward, discount: (row,) float32.
      start, end: (row,) long, first and last row of the row's episode.
      normalization: of the states, from the training episodes.
      train_rows, hold_out_rows: (n,) long, rows that hold a transition.
      returns: (episode,) float64, of all episodes in it.
      latent: (row, latent) float32 of a frozen encoder (`encoded`); None elsewhere.
    """

    latent: torch.Tensor | None = None

    def __init__(
        self,
        state: torch.Tensor,
        action: torch.Tensor,
        reward: torch.Tensor,
        discount: torch.Tensor,
        lengths: np.ndarray,
        held_out: np.ndarray,
        frames: HeldFrames | None = None,
        stack: int = FRAMES,
        returns: np.ndarray | None = None,
    ):
        device = state.device
        first = np.cumsum(lengths + 1) - (lengths + 1)
        self.start = torch.as_tensor(np.repeat(first, lengths + 1), device=device)
        self.end = torch.as_tensor(np.repeat(first + lengths, lengths + 1), device=device)
        rows = torch.arange(len(state), device=device)
        out = torch.as_tensor(np.repeat(held_out, lengths + 1), device=device)
        self.train_rows = rows[(rows < self.end) & ~out]
        self.hold_out_rows = rows[(rows < self.end) & out]
        self.normalization = Normalization.of(state[~out])
        self.state = self.normalization(state)
        self.action, self.reward, self.discount = action, reward, discount
        self.frames, self.stack = frames, stack
        self.lengths, self.held_out, self.returns = lengths, held_out, returns

    @property
    def channels(self) -> int:
        """Channels of an observation: 3 x views x frames of the stack."""
        return self.frames.channels * self.stack

    @property
    def sizes(self) -> Sizes:
        """What networks for these data are made for."""
        pictures = () if self.frames is None else (self.channels, self.frames.size, self.stack)
        return Sizes(self.state.shape[1], self.action.shape[1], *pictures)

    @property
    def device(self) -> torch.device:
        return self.state.device

    def __len__(self) -> int:
        return len(self.train_rows)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        rows = self.train_rows[torch.as_tensor(indices, device=self.device)]
        observations = self.observe(rows, *self._no_shift(len(rows)))
        return list(zip(observations, self.action[rows], strict=True))

    def _no_shift(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        middle = torch.full((count,), PAD, device=self.device)
        return middle, middle

    def observe(
        self,
        rows: torch.Tensor,
        down: torch.Tensor,
        right: torch.Tensor,
        dtype: torch.dtype = torch.float32,
        out: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Observations at rows: (batch, channels, size, size) in [-0.5, 0.5], or (batch, state) without pictures."""
        if self.frames is None:
            return self.state[rows]
        stacks = stack_rows(rows, self.start[rows], self.stack)
        return normalize_pixels(self.frames.shifted(stacks, down, right).to(self.device), dtype, out)

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
        dtype: torch.dtype = torch.float32,
        reuse: Batch | None = None,
        pictures: bool = True,
    ) -> Batch:
        """Transitions drawn uniformly, with replacement.

        Args:
          next_observation: give the observation k steps later too, under the same shift.
          k: steps between the two; with `sample_k` drawn from 1..k for each.
          hold_out: draw from the held-out episodes, without shifts.
          shift: move each stack of pictures by up to 4 pixels either way (section 5, "Preprocessing details").
          dtype: of pictures. Half the bytes are half the time to write them.
          reuse: a batch drawn by the same call before and no longer needed: its pictures are written over. Fresh
            memory for a large batch costs several times the work that fills it.
          pictures: give observations even if the data are encoded.
        """
        rows = self.hold_out_rows if hold_out else self.train_rows
        if next_observation and k > 1:
            rows = rows[rows + k <= self.end[rows]]
        if not len(rows):
            raise DmcvbError(
                f"there are no {'held-out ' if hold_out else ''}transitions to draw from (k = {k}); roll out more "
                "episodes"
            )
        chosen = rows[self._to_device(generator.integers(len(rows), size=size))]
        if hold_out or not shift or self.frames is None or self.latent is not None:
            down, right = self._no_shift(size)
        else:
            down, right = self._to_device(generator.integers(2 * PAD + 1, size=(2, size)))
        steps = None
        if next_observation:
            steps = self._to_device(generator.integers(1, k + 1, size=size) if sample_k else np.full(size, k))
        return self.transitions(chosen, steps, down, right, dtype, reuse, pictures)

    def transitions(
        self,
        rows: torch.Tensor,
        steps: torch.Tensor | None = None,
        down: torch.Tensor | None = None,
        right: torch.Tensor | None = None,
        dtype: torch.dtype = torch.float32,
        reuse: Batch | None = None,
        pictures: bool = True,
    ) -> Batch:
        """The transitions of given rows.

        Args:
          rows: (batch,) long.
          steps: (batch,) long, how far off the next observation is; None: no next observation.
          down, right: (batch,) long, offsets of the pictures in 0..2 PAD; None: not shifted.
          dtype, reuse, pictures: as for `batch`.
        """
        if down is None or right is None:
            down, right = self._no_shift(len(rows))
        now = later = None
        if pictures or self.latent is None:
            now = self.observe(rows, down, right, dtype, reuse and reuse.observation)
            if steps is not None:
                later = self.observe(rows + steps, down, right, dtype, reuse and reuse.next_observation)
        latent = self.latent
        return Batch(
            observation=now,
            state=self.state[rows],
            action=self.action[rows],
            reward=self.reward[rows],
            discount=self.discount[rows],
            next_observation=later,
            k=steps,
            latent=None if latent is None else latent[rows],
            next_latent=None if latent is None or steps is None else latent[rows + steps],
        )

    def _to_device(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device)

    def states_only(self) -> TrainingData:
        """The same episodes for an agent that sees states: shares everything but the pictures."""
        return self._with(frames=None)

    def with_stack(self, stack: int) -> TrainingData:
        """The same episodes seen in stacks of another number of frames."""
        return self._with(stack=stack)

    @torch.no_grad()
    def encoded(self, encoder: nn.Module, dtype: torch.dtype = torch.float32) -> TrainingData:
        """The same episodes with the latents of a frozen encoder, computed once; its pictures are not shifted."""
        rows = torch.arange(len(self.state), device=self.device)
        parts = []
        for few in rows.split(ENCODED_ROWS):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
                parts.append(encoder(self.observe(few, *self._no_shift(len(few)), dtype)).float())
        return self._with(latent=torch.cat(parts))

    def _with(self, **changes) -> TrainingData:
        twin = object.__new__(TrainingData)
        twin.__dict__.update(self.__dict__ | changes)
        return twin


def batches(
    draw: Callable[[int, Batch | None], Batch], first: int, last: int, workers: int = 0, ahead: int = 4
) -> Iterator[tuple[int, Batch]]:
    """(step, batch) for steps first .. last - 1, in order; drawn ahead by threads where there are workers.

    A batch is to be used before the next one is asked for: without workers its memory is used again.

    Args:
      draw: gives the batch of a step; told of a batch whose memory it may take.
    """
    if not workers:
        batch = None
        for step in range(first, last):
            batch = draw(step, batch)
            yield step, batch
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting = {step: pool.submit(draw, step, None) for step in range(first, min(first + ahead, last))}
        for step in range(first, last):
            batch = waiting.pop(step).result()
            if step + ahead < last:
                waiting[step + ahead] = pool.submit(draw, step + ahead, None)
            yield step, batch


def part_count(share: float, episodes: int) -> int:
    """How many of so many episodes a share is, at least one."""
    return max(1, round(share * episodes))


def choose_episodes(source: Source, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(episodes, held out) of a source: its share, and which of those no agent learns from.

    5 % are held out, but none of a single episode, of a counted few or of a goal pair's: the paper's policies learn
    from all of those.
    """
    names = source.subset.episodes
    if source.goal_pair is not None:
        names = names[source.subset.read("goal_pair") == source.goal_pair]
        if not len(names):
            raise DmcvbError(f"{source.subset.name} has no episodes of goal pair {source.goal_pair}")
    order = np.random.default_rng(seed).permutation(len(names))
    count = min(source.episodes or part_count(source.share, len(names)), len(names))
    few = source.episodes is not None or source.goal_pair is not None
    out = 0 if few else min(math.ceil(HOLD_OUT * count), count - 1)
    chosen = order[:count]
    held = np.zeros(count, bool)
    held[:out] = True
    by_name = np.argsort(names[chosen])
    return names[chosen][by_name], held[by_name]


def default_memory(device: str = "cpu") -> int:
    """Bytes of pictures that are held: half of what the machine (or its accelerator) has free."""
    if device.startswith("cuda"):
        return torch.cuda.mem_get_info(device)[0] // 2
    if "SC_AVPHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return 2**31  # macOS and Windows do not tell


def load_data(
    sources: Sequence[Source],
    *,
    pixels: bool = True,
    stack: int = FRAMES,
    seed: int = 0,
    device: str = "cpu",
    memory: int | None = None,
    scratch: str | Path | None = None,
) -> TrainingData:
    """Read subsets (mixed, where there are several) for training.

    Args:
      pixels: agents see pictures; else states.
      stack: frames an observation.
      seed: of the episode split and of shares.
      memory: bytes of pictures to hold at most; larger data are mapped into memory from a file.
      scratch: folder of that file; the system's folder of temporary files by default.

    Raises:
      DmcvbError: the subsets are of different tasks or picture sizes, or hold no pictures.
    """
    subsets = [source.subset for source in sources]
    names = _picture_arrays(subsets, pixels)
    chosen = [choose_episodes(source, seed) for source in sources]
    lengths = [
        subset.lengths[np.searchsorted(subset.episodes, e)] for subset, (e, _) in zip(subsets, chosen, strict=True)
    ]
    returns = [
        subset.returns[np.searchsorted(subset.episodes, e)] for subset, (e, _) in zip(subsets, chosen, strict=True)
    ]
    size, channels = subsets[0].record.size, 3 * len(names[0])
    rows = int(sum((length + 1).sum() for length in lengths))
    needed = rows * channels * size * (size + 2 * PAD)
    hold = pixels and needed <= (default_memory(device) if memory is None else memory)
    folder = None if hold else scratch or tempfile.gettempdir()
    held = HeldFrames(rows, channels, size, device, folder) if pixels else None
    tables = _read_rows(subsets, names, [episodes for episodes, _ in chosen], lengths, held)
    return TrainingData(
        **{name: torch.from_numpy(values).float().to(device) for name, values in tables.items()},
        lengths=np.concatenate(lengths).astype(np.int64),
        held_out=np.concatenate([out for _, out in chosen]),
        frames=held,
        stack=stack,
        returns=np.concatenate(returns),
    )


def _picture_arrays(subsets: Sequence[Subset], pixels: bool) -> list[tuple[str, ...]]:
    """The picture arrays of each subset that agents see.

    Raises:
      DmcvbError: the subsets are of different tasks or picture sizes, or (with `pixels`) hold no pictures.
    """
    names = [training_views(subset) for subset in subsets]
    if len({(subset.task, subset.record.size, len(n)) for subset, n in zip(subsets, names, strict=True)}) != 1:
        raise DmcvbError(f"cannot mix {', '.join(subset.name for subset in subsets)}: tasks or picture sizes differ")
    if pixels and not names[0]:
        raise DmcvbError(f"{subsets[0].name} has no pictures that agents are trained on")
    return names


def _read_rows(
    subsets: Sequence[Subset],
    names: Sequence[tuple[str, ...]],
    chosen: Sequence[np.ndarray],
    lengths: Sequence[np.ndarray],
    held: HeldFrames | None,
) -> dict[str, np.ndarray]:
    """The rows of all chosen episodes, one after the other; pictures go into `held`.

    Args:
      chosen: (episode,) indices of each subset. lengths: (episode,) of those.

    Returns:
      Tables of (row, ...) values.
    """
    tables: dict[str, list[np.ndarray]] = {"state": [], "action": [], "reward": [], "discount": []}
    first = 0
    for index, (subset, episodes, length) in enumerate(zip(subsets, chosen, lengths, strict=True)):
        step = np.arange(int(length.max()) + 1)
        for part in range(0, len(episodes), READ_EPISODES):
            few = episodes[part : part + READ_EPISODES]
            e, t = np.nonzero(step[None] <= length[part : part + READ_EPISODES, None])
            for name, table in tables.items():
                table.append(subset.read(name, few)[e, t])
            for view, name in enumerate(names[index] if held is not None else ()):
                pictures = torch.from_numpy(subset.read(name, few)[e, t])
                held.put(first, pictures.permute(0, 3, 1, 2), channel=3 * view)
            first += len(e)
    return {name: np.concatenate(parts) for name, parts in tables.items()}


__all__ = ["Batch", "Normalization", "Source", "TrainingData", "batches", "load_data"]
