"""Write a release: first the manifest, then shards one by one, at last the digests.

A shard is written whole, file by file, each file atomically; only then its commit record. So a crash at
any moment leaves committed shards and files without a record, which the next run overwrites.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dmcvb_gen.dataset.append import merged
from dmcvb_gen.dataset.index import INDEX, ZARR_JSON, metadata_paths, refuse_altered_folder, write_release
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    local_manifest,
    shard_count,
    shard_episodes,
    subset_path,
    write_json_atomically,
)
from dmcvb_gen.dataset.manifest import environment as this_environment
from dmcvb_gen.dataset.schema import SCHEMA_VERSION, ArraySpec, create_arrays, picture_layout_for, stored_name
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import PARTIAL, copy_file, parse_json, remove_partial, sha256_file
from dmcvb_gen.storage.remote import storage_errors

LOCK, LOCK_SECONDS = ".lock", 60.0
"""Held while a release's manifest is written, or the release is fetched; and how long a writer waits for it."""
CREATED = ".created"
"""Marker of a subset whose arrays are all there; no part of the release."""


@contextlib.contextmanager
def write_lock(root: Path, wait: float = 0) -> Iterator[None]:
    """Keep other writers out of a release's folder while the block runs; shards may still be written.

    Args:
      wait: seconds to wait for another writer.

    Raises:
      StoreError: another one is at work.
    """
    import filelock  # readers do without

    try:
        with filelock.FileLock(root / LOCK, timeout=wait):
            yield
    except filelock.Timeout:
        raise StoreError(f"another process is writing to {root}; wait for it, or stop it, and run this again") from None


def mark_created(root: Path, subset: SubsetRecord) -> None:
    """Say that all arrays of a subset are there."""
    (root / subset_path(subset.name) / CREATED).touch()


def start_release(root: Path, manifest: Manifest) -> Manifest:
    """Create a release folder, or continue with the one that is there, and add what is new.

    Raises:
      StoreError: the folder holds something else, or what contradicts this release, or cannot be written.
    """
    path = root / MANIFEST
    with storage_errors(root, "write to"), contextlib.ExitStack() as stack:
        _refuse_other_content(root)
        root.mkdir(parents=True, exist_ok=True)
        stack.enter_context(write_lock(root, wait=LOCK_SECONDS))  # of two who begin at once, the second takes up
        if path.exists():
            there = local_manifest(root)
            old = merged(there, manifest, str(root))
            refuse_altered_folder(root, there)
            environments = old.environments
            for environment in manifest.environments:
                if environment not in environments:
                    environments = (*environments, environment)
            manifest = old.model_copy(update={"environments": environments, "digest": None})
            (root / INDEX).unlink(missing_ok=True)  # written again when the release is finished
        _clear(root)
        write_json_atomically(path, manifest)
    return manifest


def _refuse_other_content(root: Path) -> None:
    """Raises StoreError if a folder holds something, but no release."""
    if not root.exists() or (root / MANIFEST).exists():
        return
    if any(path.name != LOCK and not path.name.endswith(PARTIAL) for path in root.iterdir()):
        if not (root / MANIFEST).exists():  # another process may have begun it meanwhile
            raise StoreError(f"{root} is not empty and holds no release; choose an empty or new folder for --out")


def _clear(root: Path, manifest: Manifest | None = None, foreign: bool = False) -> None:
    """Delete what killed processes left in the making: at the top, in small folders and beside arrays' metadata.

    The folders of chunks have far more files and are not searched: shards are made in staging folders.

    Args:
      manifest: names the subsets whose metadata folders are searched, too.
      foreign: see `remove_partial`.
    """
    remove_partial(root, below=False)
    for name in ("commits", "policies", "backgrounds"):
        remove_partial(root / name)
    for record in manifest.subsets if manifest else ():
        for path in metadata_paths(root, record):
            remove_partial((root / path).parent, foreign=foreign, below=False)


def create_subset(
    root: Path,
    subset: SubsetRecord,
    specs: tuple[ArraySpec, ...],
    rows: int,
    attributes: dict,
    exact: bool = False,
) -> None:
    """Create a subset's group and arrays (metadata alone), unless they are there already.

    Data are never at risk: where shards are committed, only metadata that is missing is written.

    Args:
      attributes: attributes of the group; its "schema_version" decides where arrays lie.
      exact: arrays that are there get room for the subset's episodes and no others, whatever their metadata say; for
        a folder of metadata alone, which growing that was interrupted may have left half changed.

    Raises:
      StoreError: the folder cannot be written.
    """
    path = root / subset_path(subset.name)
    shape = (subset.episodes, rows, subset.episodes_per_shard, picture_layout_for(subset.spec.camera_moves))
    with storage_errors(path, "write to"):
        if not (path / CREATED).exists():
            exact = False  # it will be, as nothing is there
            # File by file, each whole: of two who begin at the same time, none may clear away what the other wrote.
            _write_metadata(path, specs, attributes, shape, keep=any((root / "commits" / subset.name).glob("*.json")))
            mark_created(root, subset)  # an interrupted creation is done again from the start
        _grow(root, subset, attributes, exact)


def _grow(root: Path, subset: SubsetRecord, attributes: Mapping[str, Any], exact: bool) -> None:
    """Make room for more episodes in the arrays that are there: metadata alone.

    The group's file, which holds a copy of all arrays' metadata, is put in place last: while it is the old one, what
    was interrupted is done again. `exact`: see `create_subset`.
    """
    path = root / subset_path(subset.name)
    with storage_errors(path / ZARR_JSON, decoding=True):
        node = parse_json((path / ZARR_JSON).read_bytes())
        known = (node.get("consolidated_metadata") or {}).get("metadata", {}).values()
        if all(array["shape"][0] >= subset.episodes for array in known if "shape" in array) and known and not exact:
            return
    with tempfile.TemporaryDirectory() as folder:
        for name in metadata_paths(root, subset):
            copy_file(root / name, Path(folder) / (root / name).relative_to(path))
        group = zarr.open_group(folder, mode="r+", use_consolidated=False)
        for _, array in group.members(max_depth=None):
            if isinstance(array, zarr.Array) and (exact or array.shape[0] < subset.episodes):
                array.resize((subset.episodes, *array.shape[1:]))
        group.attrs["release"] = attributes.get("release", "")
        _put_metadata(Path(folder), path)


def fits(root: Path, subset: SubsetRecord) -> bool:
    """Return True if the metadata that are there give each array room for the subset's episodes, and no more."""
    rows = set()
    for name in metadata_paths(root, subset):
        with storage_errors(root / name, decoding=True):
            node = parse_json((root / name).read_bytes())
            copies = (node.get("consolidated_metadata") or {}).get("metadata", {}).values()
            rows |= {array["shape"][0] for array in (node, *copies) if "shape" in array}
    return rows <= {subset.episodes}


def _put_metadata(folder: Path, path: Path, keep: bool = False) -> None:
    """Consolidate a group that was made in `folder` and put its metadata in place, the group's last."""
    zarr.consolidate_metadata(str(folder))
    for source in sorted(folder.rglob(ZARR_JSON), key=lambda file: -len(file.parts)):
        target = path / source.relative_to(folder)
        if not (keep and target.exists()):
            copy_file(source, target)


def add_arrays(root: Path, subset: SubsetRecord, specs: tuple[ArraySpec, ...], rows: int, attributes: dict) -> None:
    """Give a subset that has shards already more arrays (metadata alone); its data, and its modalities, stay.

    Args:
      specs: specs of all arrays that the subset then has.
      attributes: attributes of the group, see `create_subset`.

    Raises:
      StoreError: the folder cannot be written.
    """
    path = root / subset_path(subset.name)
    shape = (subset.episodes, rows, subset.episodes_per_shard, picture_layout_for(subset.spec.camera_moves))
    with storage_errors(path, "write to"):
        _write_metadata(path, specs, attributes, shape, keep=False)
        mark_created(root, subset)


def _write_metadata(path: Path, specs: tuple[ArraySpec, ...], attributes: dict, shape: tuple, keep: bool) -> None:
    """Put a group's metadata in place file by file, beside chunks that may be there; `keep` what is there."""
    with tempfile.TemporaryDirectory() as folder:
        group = zarr.create_group(folder, attributes=attributes, overwrite=True)
        version = attributes.get("schema_version", SCHEMA_VERSION)
        create_arrays(group, specs, *shape, schema_version=version)  # type: ignore[misc]
        for there in (*path.glob(f"*/{ZARR_JSON}"), *path.glob(f"*/*/{ZARR_JSON}")):
            if not (target := Path(folder) / there.relative_to(path)).exists():  # a modality's
                copy_file(there, target)
        _put_metadata(Path(folder), path, keep)


def write_shard(
    root: Path,
    subset: SubsetRecord,
    shard: int,
    arrays: Iterable[tuple[str, np.ndarray]],
    lengths: np.ndarray,
    environment: Mapping[str, str] | None = None,
    written: WrittenArrays | None = None,
) -> CommitRecord:
    """Write the arrays of one shard and commit it.

    Args:
      arrays: (name, values (episode of the shard, ...)) pairs, taken one after the other, so that a caller
        may make the big ones as they are asked for.
      lengths: (episode of the shard,) transitions of each episode.
      environment: environment that made them; by default this machine's, with pictures painted on the CPU.
      written: arrays of the same shard of sibling subsets; equal ones become links to them.

    Raises:
      StoreError: the disk is full or cannot be written; what was committed stays.
    """
    first, last = shard_episodes(subset, shard)
    record = root / commit_path(subset.name, shard)
    try:
        there = _read_commit(root, subset, shard)
        if there:  # another process has made it since this one planned to
            return there
        record.unlink(missing_ok=True)
        files = _write_arrays(root, subset, shard, arrays, written or WrittenArrays())
        commit = CommitRecord(
            subset=subset.name,
            shard=shard,
            episodes=(first, last),
            steps=int(np.sum(lengths)),
            files=tuple(sorted(files, key=lambda file: file.path)),
            environment=dict(environment if environment is not None else this_environment()),
            painted=subset.pixels,
        )
        write_json_atomically(record, commit)
    except OSError as error:
        raise _cannot_write(root, subset, shard, error) from None
    return commit


def write_pictures(
    root: Path,
    subset: SubsetRecord,
    commit: CommitRecord,
    arrays: Iterable[tuple[str, np.ndarray]],
    environment: Mapping[str, str] | None = None,
) -> CommitRecord:
    """Add its pictures to a shard that was committed without; what is there stays as it is.

    Args:
      commit: the shard's record.
      arrays: picture arrays, see `write_shard`.
      environment: environment that painted them; kept if it is what made the rest.

    Returns:
      The new record.

    Raises:
      StoreError: the disk is full or cannot be written; what was committed stays.
    """
    try:
        added = _write_arrays(root, subset, commit.shard, arrays, WrittenArrays())
        files = {file.path: file for file in (*commit.files, *added)}  # two may have painted it at the same time
        painted = commit.model_copy(
            update={
                "files": tuple(sorted(files.values(), key=lambda file: file.path)),
                "environment": dict(environment if environment is not None else this_environment()),
                "painted": True,
                "pictures": (),
            }
        )
        write_json_atomically(root / commit_path(subset.name, commit.shard), painted)
    except OSError as error:
        raise _cannot_write(root, subset, commit.shard, error) from None
    return painted


def _cannot_write(root: Path, subset: SubsetRecord, shard: int, error: OSError) -> StoreError:
    return StoreError(
        f"cannot write shard {shard} of {subset.name} to {root}: {error.strerror or error}; what was committed "
        "is safe, make room and rerun the same command"
    )


class WrittenArrays:
    """Files of a shard's arrays, for sibling subsets that store the same values.

    Args:
      folders: where these files may be by now: the staging folder, or the release that they were moved to.
    """

    def __init__(self, *folders: Path):
        self._folders = folders
        self._files: dict[str, tuple[np.ndarray, dict, FileRecord]] = {}

    def add(self, name: str, values: np.ndarray, array: zarr.Array, file: FileRecord) -> None:
        """Remember the file of an array."""
        self._files[name] = (values, _encoding(array), file)

    def link(self, name: str, values: np.ndarray, array: zarr.Array, target: Path) -> FileRecord | None:
        """Make `target` a link to the file that holds the very same values in the same encoding.

        Returns:
          That file's record; None if there is none, or links do not work here.
        """
        there = self._files.get(name)
        if there is None or there[0] is not values or there[1] != _encoding(array):
            return None
        for folder in self._folders:
            with contextlib.suppress(OSError):
                target.parent.mkdir(parents=True, exist_ok=True)
                os.link(folder / there[2].path, target)
                return there[2]
        return None


def _encoding(array: zarr.Array) -> dict:
    """What decides the bytes of a shard beside its values."""
    metadata = array.metadata.to_dict()
    return {name: value for name, value in metadata.items() if name not in ("shape", "attributes")}


def _write_arrays(
    root: Path, subset: SubsetRecord, shard: int, arrays: Iterable[tuple[str, np.ndarray]], written: WrittenArrays
) -> list[FileRecord]:
    """Write a shard's part of arrays, each flushed to the disk, or link those that are in `written`."""
    first, last = shard_episodes(subset, shard)
    group_path = root / subset_path(subset.name)
    group = zarr.open_group(str(group_path), mode="r+", use_consolidated=False)
    files = []
    for name, values in arrays:
        array, name = find_array(group, name)
        file = group_path / name / array.metadata.encode_chunk_key((shard,) + (0,) * (array.ndim - 1))
        for stale in file.parent.glob(f"{file.name}.*.partial"):
            stale.unlink(missing_ok=True)  # left by a killed writer
        file.unlink(missing_ok=True)
        relative = file.relative_to(root).as_posix()
        if equal := written.link(name, values, array, file):
            files.append(equal.model_copy(update={"path": relative}))
            continue
        array[first:last] = values
        if file.exists():  # an array of nothing but fill values has no file
            with file.open("rb") as handle:
                os.fsync(handle.fileno())
            files.append(FileRecord(path=relative, bytes=file.stat().st_size, sha256=sha256_file(file)))
            written.add(name, values, array, files[-1])
        elif np.any(values):
            raise StoreError(
                f"{file} vanished while it was written: another process writes the same release; let one of the "
                "two go on, and rerun the same command"
            )
    return files


def find_array(group: zarr.Group, name: str) -> tuple[zarr.Array, str]:
    """An array by its name, and its path, in the layout that the group has."""
    path = stored_name(name)
    path = path if path in group else name
    array = group[path]
    assert isinstance(array, zarr.Array)
    return array, path


def read_commits(root: Path, subset: SubsetRecord) -> dict[int, CommitRecord]:
    """The committed shards of a subset, shard -> record (those whose files are all there at their size)."""
    commits = {}
    with storage_errors(root):
        folder = (root / commit_path(subset.name, 0)).parent
        there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    for shard in range(shard_count(subset)):
        commit = _read_commit(root, subset, shard) if f"{shard:05d}.json" in there else None
        if commit:
            commits[shard] = commit
    return commits


def _read_commit(root: Path, subset: SubsetRecord, shard: int) -> CommitRecord | None:
    path = root / commit_path(subset.name, shard)
    with storage_errors(path):
        try:
            text = path.read_bytes()
        except FileNotFoundError:
            return None
        commit = checked_commit(text, str(path), subset, shard)
    return commit if all(_size(root / file.path) == file.bytes for file in commit.files) else None


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def subset_digest(commits: Mapping[int, CommitRecord]) -> str:
    """One SHA-256 over the digests of all files of a subset, in the order of shards and paths."""
    digest = hashlib.sha256()
    for shard in sorted(commits):
        for file in commits[shard].files:
            digest.update(f"{file.sha256}  {file.path}\n".encode())
    return digest.hexdigest()


def finish_release(
    root: Path, manifest: Manifest, known: Mapping[str, Mapping[int, CommitRecord]] | None = None
) -> Manifest:
    """Write the digests: of every file, of the subsets that are whole; the manifest is complete when all are.

    Args:
      known: subset -> shard -> record of the shards that are committed, if the shards are not in the folder.
    """
    subsets, complete, made, found = [], True, [], {}
    for subset in manifest.subsets:
        commits = read_commits(root, subset) if known is None else dict(known.get(subset.name, {}))
        found[subset.name] = commits
        whole = len(commits) == shard_count(subset)
        complete &= whole
        made += [commits[shard].environment for shard in sorted(commits)]
        subsets.append(subset.model_copy(update={"digest": subset_digest(commits) if whole else None}))
    if not all(made):  # shards of version 1 do not say where they were made, the manifest did
        made = [*manifest.environments, *(environment for environment in made if environment)]
    environments = tuple(environment for i, environment in enumerate(made) if environment not in made[:i])
    facts = {"subsets": tuple(subsets), "complete": complete, "environments": environments or manifest.environments}
    manifest = write_release(root, manifest.model_copy(update=facts), found)
    painted = all(commit.painted for shards in found.values() for commit in shards.values())
    with storage_errors(root, "write to"):
        _clear(root, manifest, foreign=complete and painted)  # nothing is left to make then
    return manifest


def finish_together(root: Path) -> Manifest:
    """See `finish_release`; of what the manifest says by now, for releases that others may have grown meanwhile.

    Raises:
      StoreError: see there; or what the release has digests of already is not what it was.
    """
    with storage_errors(root, "write to"), write_lock(root, wait=10 * LOCK_SECONDS):  # others finish for a while, too
        manifest = local_manifest(root)
        refuse_altered_folder(root, manifest)
        return finish_release(root, manifest)
