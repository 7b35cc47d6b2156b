"""Publish an export: every file is created or compared; the Hub gets the tag that LeRobot looks for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.dataset.manifest import MANIFEST, RECIPES
from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.release.export.registry import all_formats
from dmcvb_gen.release.fetch import Moved
from dmcvb_gen.storage.hugging_face import HubStore
from dmcvb_gen.storage.store import Store, open_store

INFO = "meta/info.json"
NO_DATA = ("README.md", "LICENSE")
"""Files of any origin that may lie next to an export."""


def export_format(folder: str | Path) -> str | None:
    """The format of the exports in a folder, by the file that only that format has; None if there is no export."""
    for name, kind in all_formats().items():
        if any(True for _ in _whole(Path(folder), kind.mark)):
            return name
    return None


def _whole(folder: Path, pattern: str) -> Iterator[Path]:
    """Paths below a folder that match a pattern, without what a killed export left in the making."""
    for path in folder.rglob(pattern):
        if not any(part.endswith(files.PARTIAL) for part in path.relative_to(folder).parts):
            yield path


def publish_export(
    folder: str | Path,
    url: str,
    *,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    tick: ProgressCallback = ignore,
) -> Moved:
    """Put an export at a URL; run again after an interruption, it resumes.

    Args:
      folder: folder that `export` wrote: a subset's, or a folder of several (except for LeRobot on the Hub).
      url: s3://bucket/name, gs://, az://, hf://datasets/owner/name or file:.
      options: options of the storage client.
      tick: called with 1 for each file.

    Raises:
      StoreError: there is no export, a release or files of another export are there, access is refused, or a file
        could not be moved.
    """
    folder, kind = Path(folder), export_format(folder)
    if kind is None:
        raise StoreError(
            f"{folder} holds neither a release nor an export; give the folder that `rollout` or `export` made"
        )
    store = open_store(url, options)
    if kind == "lerobot" and isinstance(store, HubStore) and (store.folder_there or not (folder / INFO).is_file()):
        raise StoreError(
            f"LeRobot finds one data set a repository: publish one folder with {INFO} to hf://datasets/OWNER/NAME, or "
            "export the subsets as one data set with --merge"
        )
    paths = sorted(path.relative_to(folder).as_posix() for path in _whole(folder, "*") if path.is_file())
    sizes = {path: (folder / path).stat().st_size for path in paths}
    expect(tick, len(paths))
    store.begin()
    _refuse_others(store, paths)
    for path in (there := store.upload(folder, paths, workers, tick)):
        if store.sha256(path, sizes[path]) != files.sha256_file(folder / path):
            raise StoreError(f"{store.place}/{path} is of another export; give another URL")
    if kind == "lerobot":
        store.tag(json.loads((folder / INFO).read_text())["codebase_version"], f"{folder.name}, by dmcvb-gen")
    return Moved(len(paths), sum(sizes.values()), len(paths) - len(there))


def _refuse_others(store: Store, paths: Sequence[str]) -> None:
    """Raise StoreError if a place holds a release, or files that a reader would take for this export's."""
    there = store.list()
    if MANIFEST in there or any(path.startswith(RECIPES) for path in there):
        raise StoreError(f"{store.place} holds a release, which an export would damage; give another URL")
    kinds = {PurePosixPath(path).suffix for path in paths}
    others = [
        path for path in sorted({*there} - {*paths}) if path not in NO_DATA and PurePosixPath(path).suffix in kinds
    ]
    if others:
        more = f" and {len(others) - 1} more" if others[1:] else ""
        raise StoreError(
            f"{store.place} holds {others[0]}{more}, which this export lacks and its readers would read with it; "
            "remove the other files, or choose another URL"
        )
