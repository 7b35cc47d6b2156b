"""Read a release's subsets and episodes from a folder or any fsspec URL; readers see committed shards only."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import zarr

from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    local_manifest,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.dataset.pictures import picture_of
from dmcvb_gen.dataset.writer import read_commits
from dmcvb_gen.distractor_state import DISTRACTOR_STATE_NAMES, DistractorState
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.storage.remote import check_no_options, file_system, is_url, public, storage_errors
from dmcvb_gen.text import pluralize, quoted

MAX_STEP_BYTES = 2**20
"""Bytes of a step that is no picture, at most."""
TRANSITIONS = "action", "reward", "discount"
"""Arrays whose last stored row, of an episode's last observation, means nothing."""
MANY_EPISODES = 10**6
"""An array with more episodes than that, and ten times the manifest's, is damaged or hostile."""


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

    def __init__(self, array: zarr.Array, name: str, place: str, unpainted: np.ndarray | None = None, cure: str = ""):
        self._array, self._place, self.name = array, place, name
        self._unpainted, self._cure = unpainted, cure
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
        parts = self._index(selection)
        self._check_painted(parts[0])
        with storage_errors(self._place, decoding=True):
            lists = any(isinstance(part, np.ndarray) for part in parts)
            return cast(np.ndarray, self._array.oindex[parts] if lists else self._array[parts])

    def _index(self, selection: Any) -> tuple:
        """The index as Zarr takes it, looked at before anything is read: what fails then is damaged."""
        parts = without_ellipsis(selection, self.ndim)
        if len(parts) > self.ndim:
            raise IndexError(f"{len(parts)} indices are too many for {self!r}")
        found = []
        for axis, part in enumerate(parts):
            try:
                chosen = np.arange(self.shape[axis])[part]
            except IndexError as error:
                raise IndexError(f"axis {axis} of {self!r}: {error}") from None
            if chosen.ndim > 1:
                raise IndexError(f"axis {axis} of {self!r}: give a number, a slice, or a list of numbers")
            steps_back = isinstance(part, slice) and (part.step or 1) < 0  # Zarr knows no such slices, nor masks
            found.append(part if isinstance(part, slice) and not steps_back else chosen)
        if sum(isinstance(part, np.ndarray) for part in found) > 1:
            raise IndexError(f"{self!r}: give a list along one axis alone, or see outer()")
        return tuple(found)

    def outer(self, selection: tuple) -> np.ndarray:
        """Values at a selection along each axis for itself: slices, indices or arrays of them."""
        with storage_errors(self._place, decoding=True):
            return cast(np.ndarray, self._array.oindex[selection])

    def rows(self, episodes: np.ndarray, rows: int | None = None) -> np.ndarray:
        """(episode, ...) values of episodes in any order; of arrays with steps, those in a row are read at once.

        Zarr's own selection of scattered rows takes thirty times as long for pictures.

        Args:
          rows: read the first rows of the step axis alone.
        """
        self._check_painted(episodes)
        with storage_errors(self._place, decoding=True):
            if self.ndim == 1:
                return cast(np.ndarray, self._array.oindex[episodes])
            runs = np.split(episodes, np.flatnonzero(np.diff(episodes) != 1) + 1)
            read = [cast(np.ndarray, self._array[int(run[0]) : int(run[-1]) + 1, :rows]) for run in runs]
            return read[0] if len(read) == 1 else np.concatenate(read)

    def _check_painted(self, selection: Any) -> None:
        """Raises StoreError for an episode without pictures, which would read as black."""
        if self._unpainted is None or not self._unpainted.any():
            return
        missing = np.flatnonzero(np.atleast_1d(self._unpainted[selection]))
        if len(missing):
            raise StoreError(self._cure)


class Subset:
    """One subset of a release, read-only.

    Attributes:
      record: its entry in the manifest.
      commits: shard -> commit record, of the committed shards.
    """

    def __init__(self, root: str, record: SubsetRecord, commits: Mapping[int, CommitRecord], storage_options: dict):
        self.root, self.record, self.commits = root, record, dict(commits)
        self._storage_options = storage_options

    def read_as(self, kind: Callable[..., Any], *options: Any) -> Any:
        """The same subset as another class of subset."""
        return kind(self.root, self.record, self.commits, self._storage_options, *options)

    @property
    def name(self) -> str:
        return self.record.name

    @property
    def task(self) -> str:
        return self.record.task

    @property
    def level(self) -> str:
        return self.record.level

    @property
    def setting(self) -> str:
        return self.record.setting

    def __repr__(self) -> str:
        return f"<Subset {self.name}: {len(self.episodes)} of {self.record.episodes} episodes>"

    def __getstate__(self) -> dict[str, Any]:  # zarr handles are opened again where the subset lands
        handles = ("group", "lengths", "returns", "paths", "_opened")
        return {key: value for key, value in self.__dict__.items() if key not in handles}

    @functools.cached_property
    def _opened(self) -> dict[str, StoredArray]:
        return {}

    @functools.cached_property
    def group(self) -> zarr.Group:
        """The Zarr group, read-only."""
        options = self._storage_options if is_url(self.root) else None
        with storage_errors(self.path, decoding=True):
            return zarr.open_group(self.path, mode="r", storage_options=options)

    @property
    def path(self) -> str:
        """Folder or URL of the Zarr group."""
        return f"{self.root}/{subset_path(self.name)}"

    @property
    def attrs(self) -> dict[str, Any]:
        return dict(self.group.attrs)

    @functools.cached_property
    def paths(self) -> dict[str, str]:
        """Array name -> path in the Zarr group, see `schema.stored_name`."""
        with storage_errors(self.path, decoding=True):
            members = self.group.members(max_depth=None)
            return {str(item.attrs.get("array", path)): path for path, item in members if isinstance(item, zarr.Array)}

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of all arrays, e.g. "pixels", "pixels/top", "exogenous/camera_position"."""
        return tuple(sorted(self.paths))

    def array(self, name: str) -> StoredArray:
        """One array, read when indexed, with an entry for each episode that the subset will have.

        Raises:
          UnknownNameError: the subset has no such array.
        """
        picture = picture_of(name) is not None
        if name in self._opened:
            return self._opened[name]
        if name not in self.paths:
            if picture and not self.record.pixels:
                raise StoreError(self._without_pictures)
            raise UnknownNameError(f"array of {self.name}", name, self.arrays)
        unpainted = self.unpainted if picture else None
        with storage_errors(self.path, decoding=True):
            array = self.group[self.paths[name]]
            assert isinstance(array, zarr.Array)  # `paths` names arrays alone
            self._check_shape(array, name)
            place = f"{self.path}/{self.paths[name]}"
            self._opened[name] = StoredArray(array, name, place, unpainted, self._without_pictures)
        return self._opened[name]

    @property
    def unpainted(self) -> np.ndarray:
        """(episode of the whole subset,) bool: committed, but without pictures."""
        without = np.zeros(self.record.episodes, bool)
        for commit in self.commits.values():
            without[slice(*commit.episodes)] = not commit.painted
        return without

    @property
    def _without_pictures(self) -> str:
        return (
            f"{self.name} has episodes without images; add them: `dmcvb-gen paint {quoted(public(self.root))}` "
            "(in Python, dmcvb_gen.open(..., paint=True) renders them as they are read)"
        )

    def _check_shape(self, array: zarr.Array, name: str) -> None:
        """Raises StoreError for an array of more episodes, steps or bytes a step than the manifest can mean."""
        record = self.record
        largest = (record.max_steps + 1) * max(16 * record.size**2, MAX_STEP_BYTES)
        entry = math.prod(array.shape[1:]) * array.dtype.itemsize
        rows = array.shape[1] if array.ndim > 1 else 1
        episodes = array.shape[0] if array.ndim else 0
        many = episodes > max(10 * record.episodes, MANY_EPISODES)
        if not episodes or many or entry > largest or rows > record.max_steps + 1 or not self._chunks_fit(array):
            raise StoreError(
                f"{name} of {self.name} is {array.dtype} {array.shape} in chunks of {array.chunks}, which does not fit "
                f"{record.episodes} episodes of {record.max_steps} steps; regenerate or fetch the release again"
            )

    def _chunks_fit(self, array: zarr.Array) -> bool:
        """Return True if no chunk is larger than a shard of the subset: any read of a chunk decodes all of it."""
        limits = (max(self.record.episodes_per_shard, 1), *(2 * size for size in array.shape[1:2]), *array.shape[2:])
        shapes = (array.chunks, array.shards or array.chunks)
        return all(size <= limit for shape in shapes for size, limit in zip(shape, limits, strict=True))

    @property
    def pixel_arrays(self) -> tuple[str, ...]:
        return tuple(name for name in self.arrays if picture_of(name) is not None)

    @property
    def episodes(self) -> np.ndarray:
        """(episode,) int: indices of the committed episodes."""
        return self._episodes.copy()

    @functools.cached_property
    def _episodes(self) -> np.ndarray:
        ranges = [np.arange(*self.commits[shard].episodes) for shard in sorted(self.commits)]
        return np.concatenate(ranges) if ranges else np.zeros(0, int)

    @functools.cached_property
    def lengths(self) -> np.ndarray:
        """(episode,) int32: transitions of each committed episode, in the order of `episodes`."""
        return self.array("length")[:][self.episodes]

    @functools.cached_property
    def returns(self) -> np.ndarray:
        """(episode,) float64: return of each committed episode, in the order of `episodes`."""
        return self.array("return")[:][self.episodes]

    @property
    def steps(self) -> int:
        """Transitions in all committed episodes."""
        return sum(commit.steps for commit in self.commits.values())

    @property
    def bytes(self) -> int:
        """Bytes of all committed shard files."""
        return sum(file.bytes for commit in self.commits.values() for file in commit.files)

    def read(self, array: str, episodes: slice | Iterable[int] | None = None) -> np.ndarray:
        """Values of one array.

        Args:
          array: a name out of `arrays`.
          episodes: indices of committed episodes (all of them by default).

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
        """(episode,) int: indices of committed episodes, all by default.

        Args:
          episodes: indices, or a mask of all committed ones (`subset.returns > 900`).

        Raises:
          StoreError: one of them is not there, or these are neither integers nor such a mask.
        """
        if episodes is None:
            return self.episodes
        chosen = np.asarray(list(episodes))
        if chosen.dtype == bool and chosen.shape == self.episodes.shape:
            return self.episodes[chosen]
        if chosen.size and chosen.dtype.kind not in "iu":
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
          episodes: indices of committed episodes.

        Returns:
          (row, ...) by name, L + 1 rows of each episode.
        """
        chosen = self.choose(episodes)
        length = self.read("length", chosen).clip(0, self.record.max_steps)  # a damaged one asks for no more memory
        used = np.arange(int(length.max(initial=-1)) + 1) <= length[:, None]
        read = ((name, self._read(name, chosen, used.shape[1])) for name in arrays)
        return {name: value.reshape(-1, *value.shape[2:]) if used.all() else value[used] for name, value in read}

    def labels(self, episodes: slice | Iterable[int] | None = None) -> DistractorState:
        """The stored labels of the distractors, leading shape (episode, step); see `read`."""
        names = [name for name in DISTRACTOR_STATE_NAMES if f"exogenous/{name}" in self.arrays]
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
        """Index and arrays of every committed episode, as `episode` gives them, in the order of `episodes`.

        Each array is read once a shard, which takes a fraction of reading each episode; a shard's arrays are in memory.

        Args:
          arrays: names of arrays, all by default.
        """
        names = self.arrays if arrays is None else tuple(arrays)
        with_steps = [name for name in names if self.array(name).ndim > 1]
        lengths = iter(self.lengths.clip(0, self.record.max_steps))
        for shard in sorted(self.commits):
            episodes = range(*self.commits[shard].episodes)
            values: dict[str, Any] = {name: self.read(name, episodes) for name in names if name not in with_steps}
            ends = np.cumsum([int(next(lengths)) + 1 for _ in episodes])[:-1]
            for name, rows in self.rows(with_steps, episodes).items():
                parts = np.split(rows, ends)
                values[name] = [part[:-1] for part in parts] if name in TRANSITIONS else parts
            for index, episode in enumerate(episodes):
                yield episode, {name: values[name][index] for name in names}


def _ranges(indices: np.ndarray) -> str:
    if not len(indices):
        return "none yet"
    breaks = np.flatnonzero(np.diff(indices) != 1)
    starts, ends = np.r_[0, breaks + 1], np.r_[breaks, len(indices) - 1]
    return ", ".join(f"{indices[a]}..{indices[b]}" for a, b in zip(starts, ends, strict=True))


class Release:
    """A release, read-only: `manifest` and `subsets` (name -> Subset)."""

    def __init__(self, root: str, manifest: Manifest, subsets: Mapping[str, Subset]):
        self.root, self.manifest, self.subsets = root, manifest, subsets

    def __repr__(self) -> str:
        return f"<Release {self.manifest.name} {self.manifest.version}: {pluralize(len(self.subsets), 'subsets')}>"

    def __iter__(self) -> Iterator[str]:
        """Names of the subsets that have episodes here."""
        return iter(self.subsets)

    def __contains__(self, name: object) -> bool:
        return name in self.subsets

    def __len__(self) -> int:
        return len(self.subsets)

    def __getitem__(self, name: str) -> Subset:
        if name in self.shortfalls and name not in self.subsets:
            raise StoreError(
                f"{name} belongs to {self.manifest.name}, but none of its episodes are here: not made or fetched yet, "
                f"or damaged; `dmcvb-gen verify {quoted(public(self.root))}` says which"
            )
        if name not in self.subsets:
            raise UnknownNameError("subset", name, self.subsets)
        return self.subsets[name]

    @property
    def shortfalls(self) -> dict[str, tuple[int, int]]:
        """Subsets of the manifest that are not whole here -> (episodes here, episodes that belong to them)."""
        here = {record.name: 0 for record in self.manifest.subsets}
        here |= {name: len(subset.episodes) for name, subset in self.subsets.items()}
        planned = {record.name: record.episodes for record in self.manifest.subsets}
        return {name: (count, planned[name]) for name, count in here.items() if count < planned[name]}

    @property
    def path(self) -> Path:
        """The folder of a local release."""
        if is_url(self.root):
            raise StoreError(f"{public(self.root)} is not a local folder; fetch it first")
        return Path(self.root)


def open_release(path: str | Path, storage_options: dict | None = None, skip: Collection[str] = frozenset()) -> Release:
    """Open a release for reading.

    Args:
      path: its folder, or an fsspec URL such as "s3://bucket/name".
      storage_options: passed to fsspec for a URL.
      skip: subsets that are known to be damaged, to be left out.

    Raises:
      StoreError: there is no release, its manifest or a commit record is damaged, or options are given for a folder.
    """
    path, options = str(path), storage_options or {}

    def wanted(manifest: Manifest) -> list[SubsetRecord]:
        return [record for record in manifest.subsets if record.name not in skip]

    if not is_url(path):
        check_no_options(path, options)
        root = Path(path)
        manifest = local_manifest(root)
        commits = {subset.name: read_commits(root, subset) for subset in wanted(manifest)}
    else:
        if path.startswith("file:") and "://" not in path:
            path = "file://" + path.removeprefix("file:")
        path = path.rstrip("/")
        filesystem, base = file_system(path, options)
        with storage_errors(path):
            try:
                text = filesystem.cat_file(f"{base}/{MANIFEST}")
            except FileNotFoundError:
                raise StoreError(f"{public(path)} holds no release (no {MANIFEST}); check the URL") from None
            manifest = parse_manifest(text, f"{public(path)}/{MANIFEST}")
            commits = {
                subset.name: _remote_commits(filesystem, base, subset, path, manifest.complete)
                for subset in wanted(manifest)
            }
    subsets = {record.name: Subset(path, record, commits[record.name], options) for record in wanted(manifest)}
    return Release(path, manifest, {name: subset for name, subset in subsets.items() if len(subset.commits)})


def load_manifest(root: str | Path) -> tuple[Path, Manifest]:
    """A local release's folder and manifest.

    Args:
      root: the folder, or a manifest's file, whose folder may hold nothing else.

    Raises:
      StoreError: there is none, it is a URL, damaged, or cannot be read.
    """
    if is_url(str(root)):
        raise StoreError(f"{public(str(root))} is not a local folder; fetch it first")
    root = Path(root)
    with storage_errors(root):
        if root.is_file():
            return root.parent, parse_manifest(root.read_bytes(), str(root))
    return root, local_manifest(root)


def _remote_commits(
    filesystem: Any, base: str, subset: SubsetRecord, place: str, complete: bool
) -> dict[int, CommitRecord]:
    """The committed shards of a subset at a URL, shard -> record.

    What cannot be read is raised: left out, it would be a release with fewer episodes. But where keys may not be
    listed, buckets refuse those that do not exist, as a release that is being made lacks some.
    """
    paths = {f"{base}/{commit_path(subset.name, shard)}": shard for shard in range(shard_count(subset))}
    found = filesystem.cat(list(paths), on_error="return")
    if not isinstance(found, dict):  # fsspec gives what a single path has
        found = {next(iter(paths)): found}
    absent = (FileNotFoundError, NotADirectoryError, *(() if complete else (PermissionError,)))
    shards = {path.lstrip("/"): shard for path, shard in paths.items()}  # some file systems give other slashes back
    commits = {}
    for path, text in found.items():
        if isinstance(text, absent):
            continue
        if isinstance(text, BaseException):
            raise text
        shard = shards[path.lstrip("/")]
        where = f"{public(place)}/{commit_path(subset.name, shard)}"
        commits[shard] = checked_commit(text, where, subset, shard)
    return commits
