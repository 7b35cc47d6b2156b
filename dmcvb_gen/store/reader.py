"""Reading a release: a folder (or any fsspec URL) in, subsets and episodes out; what is not committed is not there."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import zarr

from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.store.manifest import MANIFEST, CommitRecord, Manifest, SubsetRecord, parse_commit, parse_manifest
from dmcvb_gen.store.writer import commit_path, read_commits, shard_count, subset_path


class Subset:
    """One subset of a release, read-only.

    Attributes:
      record: what the manifest says of it.
      commits: shard -> commit record, of the committed shards.
    """

    def __init__(self, root: str, record: SubsetRecord, commits: Mapping[int, CommitRecord], storage_options: dict):
        self.root, self.record, self.commits = root, record, dict(commits)
        self._storage_options = storage_options

    name = property(lambda self: self.record.name)
    task = property(lambda self: self.record.task)
    level = property(lambda self: self.record.level)
    setting = property(lambda self: self.record.setting)

    def __repr__(self) -> str:
        return f"<Subset {self.name}: {len(self.episodes)} of {self.record.episodes} episodes>"

    def __getstate__(self):  # zarr handles are opened again where the subset lands
        return {
            key: value for key, value in self.__dict__.items() if key not in ("group", "lengths", "returns", "paths")
        }

    @functools.cached_property
    def group(self) -> zarr.Group:
        """The Zarr group, read-only."""
        path = f"{self.root}/{subset_path(self.name)}"
        options = {"storage_options": self._storage_options} if "://" in self.root else {}
        return zarr.open_group(path, mode="r", **options)

    @property
    def attrs(self) -> dict[str, Any]:
        return dict(self.group.attrs)

    @functools.cached_property
    def paths(self) -> dict[str, str]:
        """Array name -> path in the Zarr group, see `schema.stored_name`."""
        members = self.group.members(max_depth=None)
        return {str(item.attrs.get("array", path)): path for path, item in members if isinstance(item, zarr.Array)}

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of all arrays, e.g. "pixels", "pixels/top", "exogenous/camera_position"."""
        return tuple(sorted(self.paths))

    def array(self, name: str) -> zarr.Array:
        """One array, lazy, with an entry for each episode that the subset will have.

        Raises:
          UnknownNameError: the subset has no such array.
        """
        if name not in self.paths:
            raise UnknownNameError(f"array of {self.name}", name, self.arrays)
        return self.group[self.paths[name]]

    @property
    def pixel_arrays(self) -> tuple[str, ...]:
        return tuple(name for name in self.arrays if name.split("/")[0].startswith("pixels"))

    @property
    def episodes(self) -> np.ndarray:
        """(episode,) int: indices of the committed episodes."""
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
        source = self.array(array)
        if episodes is None:
            chosen = self.episodes
        elif isinstance(episodes, slice):
            chosen = self.episodes[np.isin(self.episodes, np.arange(self.record.episodes)[episodes])]
        else:
            chosen = np.atleast_1d(np.asarray(list(episodes), int))
            missing = np.setdiff1d(chosen, self.episodes)
            if len(missing):
                raise StoreError(f"{self.name} has no episode {missing[0]}; it has {_ranges(self.episodes)}")
        if not len(chosen):
            return np.zeros((0, *source.shape[1:]), source.dtype)
        if len(chosen) == chosen[-1] - chosen[0] + 1 and (np.diff(chosen) == 1).all():
            return source[int(chosen[0]) : int(chosen[-1]) + 1]
        return source.oindex[chosen]

    def episode(self, index: int, arrays: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """One episode, cut to its length L.

        Returns:
          Arrays by name: L + 1 rows of pixels, state, physics and labels; L rows of action, reward and discount.
        """
        length = int(self.read("length", [index])[0])
        values = {}
        for name in self.arrays if arrays is None else arrays:
            value = self.read(name, [index])[0]
            if self.array(name).ndim > 1:
                value = value[: length if name in ("action", "reward", "discount") else length + 1]
            values[name] = value
        return values


def _ranges(indices: np.ndarray) -> str:
    if not len(indices):
        return "none yet"
    breaks = np.flatnonzero(np.diff(indices) != 1)
    starts, ends = np.r_[0, breaks + 1], np.r_[breaks, len(indices) - 1]
    return ", ".join(f"{indices[a]}..{indices[b]}" for a, b in zip(starts, ends, strict=True))


class Release:
    """A release, read-only: `manifest` and `subsets` (name -> Subset)."""

    def __init__(self, root: str, manifest: Manifest, subsets: dict[str, Subset]):
        self.root, self.manifest, self.subsets = root, manifest, subsets

    def __repr__(self) -> str:
        return f"<Release {self.manifest.name} {self.manifest.version}: {len(self.subsets)} subsets>"

    def __getitem__(self, name: str) -> Subset:
        if name not in self.subsets:
            raise UnknownNameError("subset", name, self.subsets)
        return self.subsets[name]

    @property
    def path(self) -> Path:
        """The folder of a local release."""
        if "://" in self.root:
            raise StoreError(f"{self.root} is not a local folder; fetch it first")
        return Path(self.root)


def open_release(path: str | Path, storage_options: dict | None = None) -> Release:
    """Open a release for reading.

    Args:
      path: its folder, or an fsspec URL such as "s3://bucket/name".
      storage_options: passed to fsspec for a URL.

    Raises:
      StoreError: there is no release, or its manifest or a commit record is damaged.
    """
    path = str(path)
    if "://" not in path:
        root = Path(path)
        if not (root / MANIFEST).is_file():
            raise StoreError(f"{path} holds no release (no {MANIFEST}); give the folder that `rollout --out` made")
        manifest = parse_manifest((root / MANIFEST).read_bytes(), str(root / MANIFEST))
        commits = {subset.name: read_commits(root, subset) for subset in manifest.subsets}
    else:
        storage_options = storage_options or {}
        try:
            filesystem, base = fsspec.core.url_to_fs(path, **storage_options)
            base = base.rstrip("/")
            manifest = parse_manifest(filesystem.cat_file(f"{base}/{MANIFEST}"), f"{path}/{MANIFEST}")
            commits = {subset.name: _remote_commits(filesystem, base, subset) for subset in manifest.subsets}
        except FileNotFoundError:
            raise StoreError(f"{path} holds no release (no {MANIFEST})") from None
        except ImportError as error:
            raise StoreError(f"cannot open {path}: {error}") from None
        path = path.rstrip("/")
    subsets = {
        record.name: Subset(path, record, commits[record.name], storage_options or {}) for record in manifest.subsets
    }
    return Release(path, manifest, {name: subset for name, subset in subsets.items() if len(subset.commits)})


def _remote_commits(filesystem: fsspec.AbstractFileSystem, base: str, subset: SubsetRecord) -> dict[int, CommitRecord]:
    paths = {f"{base}/{commit_path(subset.name, shard)}": shard for shard in range(shard_count(subset))}
    found = filesystem.cat(list(paths), on_error="omit")
    if isinstance(found, bytes):  # fsspec gives bare bytes for a single path
        found = {next(iter(paths)): found}
    commits = {}
    for path, text in found.items():
        commit = parse_commit(text, path)
        commits[commit.shard] = commit
    return commits


def to_json(record: Any) -> Any:
    """A pydantic record as plain JSON values."""
    return json.loads(record.model_dump_json())
