"""Arrays that are no array of the store: computed an episode at a time, joined of several subsets, or side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dmcvb_gen.dataset.reader import without_ellipsis


class ComputedArray:
    """An array that is computed an episode at a time when it is indexed; see `dataset.reader.StoredArray`.

    Args:
      compute: gives an episode's values at an index of the other axes.
    """

    def __init__(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype,
        dimensions: tuple[str, ...],
        compute: Callable[[int, tuple], np.ndarray],
    ):
        self.name, self.shape, self.dtype, self.dimensions = name, shape, dtype, dimensions
        self.ndim, self._compute = len(shape), compute
        self.attributes: dict[str, Any] = {}
        self.chunking: dict[str, Any] = {}

    def __getitem__(self, selection: Any) -> np.ndarray:
        first, *rest = without_ellipsis(selection, self.ndim)
        episodes = np.arange(self.shape[0])[first]
        if np.ndim(episodes) == 0:
            return self._compute(int(episodes), tuple(rest)).copy()  # what is kept stays as it is
        return self.rows(np.asarray(episodes))[(slice(None), *rest)]

    def outer(self, selection: tuple) -> np.ndarray:
        """Values at a selection along each axis for itself: slices, indices or arrays of them."""
        values = self.rows(np.atleast_1d(np.arange(self.shape[0])[selection[0]]))
        for axis in range(self.ndim - 1, 0, -1):
            values = values[(slice(None),) * axis + (selection[axis],)]
        return values[0] if np.ndim(selection[0]) == 0 and not isinstance(selection[0], slice) else values

    def rows(self, episodes: np.ndarray, rows: int | None = None) -> np.ndarray:
        """(episode, row, ...) values, rows past an episode's end zero."""
        values = [self._compute(int(episode), (slice(rows),)) for episode in episodes]
        return np.stack(values) if values else np.zeros((0, *self.shape[1:]), self.dtype)[:, :rows]


class JoinedArray(ComputedArray):
    """Arrays of several subsets, one after the other along the episodes.

    Args:
      starts: (part,) int, number of each part's first episode.
    """

    def __init__(self, parts: Sequence[Any], starts: np.ndarray):
        first, self._parts, self._starts = parts[0], parts, starts
        shape = (sum(part.shape[0] for part in parts), *first.shape[1:])
        super().__init__(first.name, shape, first.dtype, first.dimensions, self._of_episode)
        self.attributes = first.attributes

    def _of_episode(self, episode: int, rest: tuple) -> np.ndarray:
        part = int(np.searchsorted(self._starts, episode, "right")) - 1
        return self._parts[part][(episode - int(self._starts[part]), *rest)]

    def rows(self, episodes: np.ndarray, rows: int | None = None) -> np.ndarray:
        """See `ComputedArray.rows`; neighbors of one part are read together."""
        places = np.searchsorted(self._starts, episodes, "right") - 1
        runs = np.split(np.arange(len(episodes)), np.flatnonzero(np.diff(places)) + 1)
        own = episodes - self._starts[places]
        found = [self._parts[places[run[0]]].rows(own[run], rows) for run in runs if len(run)]
        return np.concatenate(found) if found else super().rows(episodes, rows)


class PairedArray(ComputedArray):
    """Images of one view under several settings, side by side on the third axis: (episode, step, setting, ...)."""

    def __init__(self, name: str, parts: Sequence[Any]):
        first, self._parts = parts[0], parts
        shape = (*first.shape[:2], len(parts), *first.shape[2:])
        dimensions = (*first.dimensions[:2], "setting", *first.dimensions[2:])
        super().__init__(name, shape, first.dtype, dimensions, lambda e, rest: self.rows(np.array([e]))[0][rest])

    def rows(self, episodes: np.ndarray, rows: int | None = None) -> np.ndarray:
        """See `ComputedArray.rows`."""
        (_, steps, *rest), episodes = self.shape, np.asarray(episodes)
        joined = np.empty((len(episodes), len(range(steps)[:rows]), *rest), self.dtype)
        for row, episode in enumerate(episodes):  # one by one, which copies least
            for look, part in enumerate(self._parts):
                joined[row, :, look] = part.rows(np.array([episode]), rows)[0]
        return joined
