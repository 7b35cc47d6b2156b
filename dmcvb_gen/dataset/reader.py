"""Read the episodes of a subset: arrays by name, whole episodes, rows; of a folder or a URL, finished or not."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

import numpy as np
import zarr

from dmcvb_gen.dataset.chunks import open_array
from dmcvb_gen.dataset.manifest import ArraySpec, Layer, ListedLayer, SubsetRecord, runs
from dmcvb_gen.dataset.pictures import picture_of, shown
from dmcvb_gen.distractor_state import LABEL_DTYPES, DistractorState
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.spec import FIXED
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.zarr_files import ZarrFiles
from dmcvb_gen.text import quoted

TRANSITIONS = "action", "reward", "discount"
"""Arrays whose last stored row, of an episode's last observation, means nothing."""


def without_ellipsis(selection: Any, dimensions: int) -> tuple:
    """An index of an array of that many dimensions, with its `...` written out."""
    parts = list(selection) if isinstance(selection, tuple) else [selection]
    for place, part in enumerate(parts):
        if part is Ellipsis:
            parts[place : place + 1] = [slice(None)] * (dimensions - len(parts) + 1)
            break
    return tuple(parts) or (slice(None),)


class StoredArray:
    """One array of a subset, read as it is indexed; damaged bytes and lost connections are one line with a cure.

    Attributes:
      name: e.g. "pixels/top".
      shape, dtype, ndim: as in numpy; an entry for each episode that the subset will have.
      dimensions: names of the axes.
      attributes: stored with the array.
      chunking: its "chunks" and "shards", entries of each axis.
    """

    def __init__(self, array: zarr.Array, name: str, place: str, missing: np.ndarray, cure: str):
        self._array, self._place, self.name = array, place, name
        self._missing, self._cure = missing, cure
        self.shape, self.dtype, self.ndim = array.shape, array.dtype, array.ndim
        self.dimensions = tuple(map(str, getattr(array.metadata, "dimension_names", None) or ()))
        self.attributes, self.chunking = dict(array.attrs), {"chunks": array.chunks, "shards": array.shards}

    def __repr__(self) -> str:
        return f"<StoredArray {self.name}: {self.dtype} {self.shape}>"

    def __getitem__(self, selection: Any) -> np.ndarray:
        """Values at an index of each axis: numbers, slices, and along one axis a list or a mask.

        Raises:
          IndexError: the index does not fit the array.
        """
        return self.outer(self._index(selection))

    def _index(self, selection: Any) -> tuple:
        """The index as Zarr takes it, looked at before anything is read: what fails then is damaged."""
        parts = without_ellipsis(selection, self.ndim)
        found = [np.arange(size)[part] for size, part in zip(self.shape, parts, strict=False)]
        lists = sum(isinstance(part, list | np.ndarray) for part in parts)
        if len(parts) > self.ndim or lists > 1 or any(chosen.ndim > 1 for chosen in found):
            raise IndexError(f"{self!r}: give a number or a slice for each axis, and a list for one; or see outer()")
        forward = [isinstance(part, slice) and (part.step or 1) > 0 for part in parts]  # Zarr takes no others
        return tuple(part if plain else chosen for part, chosen, plain in zip(parts, found, forward, strict=True))

    def outer(self, selection: tuple) -> np.ndarray:
        """Values at a selection along each axis for itself: slices, indices or arrays of them."""
        self._check_here(selection[0])
        with storage_errors(self._place, decoding=True):
            return cast(np.ndarray, self._array.oindex[selection])

    def rows(self, episodes: np.ndarray, rows: int | None = None) -> np.ndarray:
        """(episode, ...) values of episodes in any order; neighbors are read at once.

        Zarr's own selection of scattered rows takes half the time for small arrays, thirty times the time for pictures.

        Args:
          rows: read the first rows of the step axis alone.
        """
        self._check_here(episodes)
        order = np.argsort(episodes, kind="stable")
        wanted, rest = episodes[order], (slice(rows),) * (self.ndim > 1)
        with storage_errors(self._place, decoding=True):
            runs = np.split(wanted, np.flatnonzero(np.diff(wanted) != 1) + 1)
            scattered = len(runs) > 1 and "height" not in self.dimensions
            parts = [wanted] if scattered else [slice(int(run[0]), int(run[-1]) + 1) for run in runs]
            read = [self._array.oindex[(part, *rest)] for part in parts]
            values = cast(np.ndarray, read[0] if len(read) == 1 else np.concatenate(read))
        return values if np.array_equal(wanted, episodes) else values[np.argsort(order)]

    def _check_here(self, selection: Any) -> None:
        """Raises StoreError for an episode that is not here, which would read as zero or black."""
        if self._missing.any() and self._missing[selection].any():
            raise StoreError(self._cure)


class Subset:
    """One subset of a release, read-only.

    Attributes:
      release: the `gate.Release` that it belongs to.
      record: its entry in the manifest.
      name, task, level, setting: as the record has them.
      fresh: True if each epoch shows other distractors.
      epoch: epoch of the distractors; 0 if they are those of the data.
      other_videos: folder of the videos that are shown, or "builtin"; None for those that the release names.
      looks: settings whose images stand side by side in each array of images; 1 but for `paired`.
    """

    fresh = False
    other_videos: str | None = None
    epoch = 0
    looks = 1

    def __init__(self, release: Any, record: SubsetRecord):
        self.release, self.record = release, record
        self.name, self.task, self.level, self.setting = record.name, record.task, record.level, record.setting

    def set_epoch(self, epoch: int) -> None:
        """Show the distractors of another epoch from now on, if they are fresh."""
        self.epoch = epoch if self.fresh else 0

    def __repr__(self) -> str:
        return f"<Subset {self.name}: {len(self.episodes)} of {self.record.episodes} episodes>"

    def __len__(self) -> int:
        """Episodes that are here."""
        return len(self._episodes)

    def __getstate__(self) -> dict[str, Any]:  # Zarr handles are opened again where the subset lands
        return {name: value for name, value in self.__dict__.items() if name != "_opened"}

    # -- layers and arrays ----------------------------------------------------------------------------

    @functools.cached_property
    def layers(self) -> tuple[Layer, ...]:
        """Its layers: trajectories, labels, then images."""
        return tuple(self.release.layers[name] for name in self.record.layers)

    @property
    def goal_seed(self) -> int | None:
        """Seed by which fixed goals were drawn; None if the setting has none, or does not say it."""
        return self.trajectories.makes.get("seed") if self.record.setting == FIXED else None

    @functools.cached_property
    def trajectories(self) -> Layer:
        """The layer of its states, actions and rewards."""
        return self.layers[0]

    @functools.cached_property
    def _specs(self) -> dict[str, tuple[Layer, ArraySpec]]:
        # Images that a paint has begun, and of which no shard is here yet, are no part of a finished release.
        known = (Layer,) if self.release.in_the_making else (ListedLayer,)
        layers = [layer for layer in self.layers if isinstance(layer, known) or self.release.here(layer.name)]
        return {spec.name: (layer, spec) for layer in layers for spec in layer.arrays}

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of all arrays, e.g. "pixels", "pixels/top", "exogenous/camera_position"."""
        return tuple(sorted(self._specs))

    @property
    def pixel_arrays(self) -> tuple[str, ...]:
        """Names of the arrays of RGB images of its own size."""
        return tuple(name for name in self.arrays if picture_of(name) is not None)

    def spec(self, name: str) -> ArraySpec:
        """The spec of one array.

        Raises:
          UnknownNameError: the subset has no such array.
        """
        return self._layer_of(name)[1]

    def _layer_of(self, name: str) -> tuple[Layer, ArraySpec]:
        if name not in self._specs:
            if name in shown(self).arrays:
                raise StoreError(self._without_images())
            raise UnknownNameError(f"array of {self.name}", name, self.arrays)
        return self._specs[name]

    def missing(self, layer: Layer) -> np.ndarray:
        """(episode of the whole subset,) bool: episodes whose shard of a layer is not here."""
        lacking = np.ones(self.record.episodes, bool)
        for number in self.release.here(layer.name):
            span = layer.episodes_of(number)
            lacking[span.start : span.stop] = False
        return lacking

    @functools.cached_property
    def _opened(self) -> dict[str, StoredArray]:
        return {}

    def array(self, name: str) -> StoredArray:
        """One array, read when indexed, with an entry for each episode that the subset will have.

        Raises:
          UnknownNameError: the subset has no such array.
        """
        if name not in self._opened:
            layer, spec = self._layer_of(name)
            prefix = f"{layer.group}/{spec.stored_name}"
            here = self.release.here(layer.name)
            files = {
                layer.file_path(spec, number).removeprefix(f"{prefix}/"): record.files[name]
                for number, record in self.release.records(layer.name).items()
                if number in here and name in record.files
            }
            array = open_array(layer, spec, self.record.episodes, ZarrFiles(self.release.store, prefix, files))
            cure = self._without_images(layer) if layer.kind == "images" else self._not_here
            place = f"{self.release.place}/{prefix}"
            self._opened[name] = StoredArray(array, name, place, self.missing(layer), cure)
        return self._opened[name]

    def _without_images(self, layer: Layer | None = None) -> str:
        size = layer.arrays[0].shape[0] if layer else self.record.size
        known = next(record for record in self.release.manifest.subsets if record.name == self.name)
        option = f" --size {size}" if size != known.size else ""
        python = "" if option else " (in Python, dmcvb_gen.open(..., paint=True) renders them as they are read)"
        command = f"dmcvb-gen paint {quoted(self.release.place)}{option}"
        if self.release.store.folder is None:
            command = f"dmcvb-gen fetch {quoted(self.release.place)} --paint --out FOLDER"
        return f"{self.name} has episodes without images; add them: `{command}`{python}"

    @property
    def _not_here(self) -> str:
        return f"{self.name} of {self.release.place} has {_ranges(self.episodes)} here; choose among these episodes"

    @property
    def unpainted(self) -> np.ndarray:
        """(episode of the whole subset,) bool: here, but without the images that the subset is about."""
        here = np.zeros(self.record.episodes, bool)
        here[self._episodes] = True
        lacking = [self.missing(self._specs[n][0]) if n in self._specs else here for n in shown(self).arrays]
        return here & np.any(lacking, axis=0)

    # -- episodes -------------------------------------------------------------------------------------

    @property
    def episodes(self) -> np.ndarray:
        """(episode,) int: indices of the episodes that are here."""
        return self._episodes.copy()

    @functools.cached_property
    def _episodes(self) -> np.ndarray:
        needed = [layer for layer in self.layers if layer.kind != "images" or layer.source]
        return np.flatnonzero(~np.any([self.missing(layer) for layer in needed], axis=0))

    @functools.cached_property
    def lengths(self) -> np.ndarray:
        """(episode,) int32: transitions of each episode that is here, in the order of `episodes`."""
        return self.read("length").clip(0, self.record.max_steps)

    @functools.cached_property
    def returns(self) -> np.ndarray:
        """(episode,) float64: return of each episode that is here, in the order of `episodes`."""
        return self.read("return")

    @property
    def steps(self) -> int:
        """Transitions in all episodes that are here."""
        return int(self.lengths.sum())

    @property
    def bytes(self) -> int:
        """Bytes of all its files that are here; settings that share trajectories count them each."""
        return sum(file.bytes for shard in self.shards() if shard.here for file in shard.files)

    def shards(self, episodes: tuple[int, int] | None = None) -> Iterator[Any]:
        """Its shards, or those with some episodes, (first, last + 1); see `gate.Release.shards`."""
        return self.release.shards([self.name], episodes)

    def read(self, array: str, episodes: slice | Iterable[int] | None = None) -> np.ndarray:
        """Values of one array.

        Args:
          array: a name out of `arrays`.
          episodes: indices of episodes that are here (all of them by default).

        Returns:
          (episode, step, ...) for arrays with steps, rows past an episode's length are zero; else (episode, ...).
        """
        if isinstance(episodes, slice):
            wanted = np.arange(self.record.episodes)[episodes]
            episodes = wanted[np.isin(wanted, self.episodes)]
        return self._read(array, self.choose(episodes))

    def _read(self, array: str, episodes: np.ndarray, rows: int | None = None) -> np.ndarray:
        source = self.array(array)
        return source.rows(episodes, rows) if len(episodes) else np.zeros((0, *source.shape[1:]), source.dtype)

    def choose(self, episodes: Iterable[int] | None = None) -> np.ndarray:
        """(episode,) int: indices of episodes that are here, all by default.

        Args:
          episodes: indices, or a mask of all of them (`subset.returns > 900`).

        Raises:
          StoreError: one of them is not there, or these are neither integers nor such a mask.
        """
        if episodes is None:
            return self.episodes
        chosen = np.asarray(list(episodes) if np.iterable(episodes) else episodes)
        if chosen.dtype == bool and chosen.shape == self.episodes.shape:
            return self.episodes[chosen]
        if chosen.ndim != 1 or chosen.size and chosen.dtype.kind not in "iu":
            raise StoreError(
                f"episodes are {chosen.dtype} of shape {chosen.shape}; give indices, or a mask of all "
                f"{len(self.episodes)} episodes of {self.name}"
            )
        chosen = chosen.astype(int)
        missing = np.setdiff1d(chosen, self.episodes)
        if len(missing):
            raise StoreError(f"{self.name} has no episode {missing[0]}; it has {_ranges(self.episodes)}")
        return chosen

    def prepare(self, episodes: np.ndarray, pictures: Iterable[str]) -> None:
        """Prepare to read rows of these episodes part by part; does nothing for stored pictures."""

    def rows(self, arrays: Iterable[str], episodes: Iterable[int]) -> dict[str, np.ndarray]:
        """Rows of episodes, one episode after the other.

        Args:
          arrays: names of arrays with steps.
          episodes: indices of episodes that are here.

        Returns:
          (row, ...) by name, L + 1 rows of each episode.
        """
        chosen = self.choose(episodes)
        length = self.read("length", chosen).clip(0, self.record.max_steps)  # a damaged one asks for no more memory
        used = np.arange(int(length.max(initial=-1)) + 1) <= length[:, None]
        read = ((name, self._read(name, chosen, used.shape[1])) for name in arrays)
        return {name: value.reshape(-1, *value.shape[2:]) if used.all() else value[used] for name, value in read}

    def seen(self, pictures: Sequence[str], episodes: np.ndarray, rows: int) -> Iterator[list[np.ndarray]]:
        """Pictures of one episode after another, to look at only: in their order (at least `rows`, ...).

        Of several looks, all pictures of one come before those of the next.
        """
        yield from map(list, zip(*(self._read(name, episodes, rows) for name in pictures), strict=True))

    def labels(self, episodes: slice | Iterable[int] | None = None) -> DistractorState:
        """The stored labels of the distractors, leading shape (episode, step); see `read`."""
        names = [name for name in LABEL_DTYPES if f"exogenous/{name}" in self.arrays]
        if not names:
            raise StoreError(f"{self.name} was imported and has no labels; ask for subsets that were rolled out")
        return DistractorState(**{name: self.read(f"exogenous/{name}", episodes) for name in names})

    def episode(self, index: int, arrays: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """One episode, cut to its length L.

        Returns:
          Arrays by name: L + 1 rows of pixels, state, physics and labels; L rows of action, reward and discount.
        """
        names = self.arrays if arrays is None else tuple(arrays)
        values = self.rows([name for name in names if self.array(name).ndim > 1], [index])
        values |= {name: values[name][:-1] for name in TRANSITIONS if name in values}
        return {name: values[name] if name in values else self.read(name, [index])[0] for name in names}

    def each_episode(self, arrays: Iterable[str] | None = None) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Index and arrays of every episode that is here, as `episode` gives them, in the order of `episodes`.

        Each array is read once a shard, which takes a fraction of reading each episode; a shard's arrays are in memory.

        Args:
          arrays: names of arrays, all by default.
        """
        names = self.arrays if arrays is None else tuple(arrays)
        with_steps = [name for name in names if self.array(name).ndim > 1]
        lengths = iter(self.lengths.clip(0, self.record.max_steps))
        per_shard = self.trajectories.episodes_per_shard
        for episodes in np.split(self._episodes, np.flatnonzero(np.diff(self._episodes // per_shard)) + 1):
            values: dict[str, Any] = {name: self.read(name, episodes) for name in names if name not in with_steps}
            ends = np.cumsum([int(next(lengths)) + 1 for _ in episodes])[:-1]
            for name, rows in self.rows(with_steps, episodes).items():
                parts = np.split(rows, ends)
                values[name] = [part[:-1] for part in parts] if name in TRANSITIONS else parts
            for index, episode in enumerate(episodes):
                yield int(episode), {name: values[name][index] for name in names}


def _ranges(indices: np.ndarray) -> str:
    return ", ".join(f"{first}..{last - 1}" for first, last in runs(indices.tolist())) or "none yet"
