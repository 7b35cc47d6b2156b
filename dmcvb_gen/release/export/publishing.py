"""Publish an export: check every file; on the Hub make one commit with the tag that LeRobot looks for."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.dataset.index import CLAIM
from dmcvb_gen.dataset.manifest import MANIFEST, FileRecord
from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.release.export.registry import all_formats
from dmcvb_gen.release.fetch import Moved
from dmcvb_gen.storage import open_storage
from dmcvb_gen.storage.hub import client_errors, client_options, new_api, newest_of, on_the_hub

LEROBOT_INFO = "meta/info.json"
NO_DATA = ("README.md", "LICENSE")
"""Files that may be beside an export, whoever wrote them."""


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
    api: Any = None,
) -> Moved:
    """Put an export at a URL; run again after an interruption, it goes on.

    Args:
      folder: folder that `export` wrote: a subset's, or a folder of several (except for LeRobot on the Hub).
      url: s3://bucket/name, gs://, hf://datasets/owner/name, file: or any fsspec URL.
      options: options of fsspec. api: a `huggingface_hub.HfApi`, for tests.
      tick: called with 1 for each file.

    Raises:
      StoreError: there is no export, a release or files of another export are there, access is refused, or a file
        could not be moved.
    """
    folder = Path(folder)
    kind = export_format(folder)
    if kind is None:
        raise StoreError(
            f"{folder} holds neither a release nor an export; give the folder that `rollout` or `export` made"
        )
    paths = sorted(path for path in _whole(folder, "*") if path.is_file())
    records = [_record(path, folder) for path in paths]
    total = sum(record.bytes for record in records)
    expect(tick, len(records))
    if on_the_hub(url):
        _to_hub(folder, kind, url, records, api or new_api(**client_options(options or {})))
        tick(len(records))
        return Moved(len(records), total, len(records))
    storage = open_storage(url, options)
    _refuse_others(storage.place, storage.list(), records)
    return Moved(len(records), total, storage.upload_all(folder, records, workers, tick))


def _refuse_others(place: str, there: Collection[str], records: Sequence[FileRecord]) -> None:
    """Raise StoreError if a place holds a release, or files that a reader would take for this export's."""
    for name in (MANIFEST, CLAIM):
        if name in there:
            raise StoreError(f"{place} holds a release ({name}), which an export would damage; give another URL")
    mine = {record.path for record in records}
    kinds = {PurePosixPath(name).suffix for name in mine}
    others = sorted(
        name
        for path in map(PurePosixPath, set(there) - mine)
        if (name := str(path)) not in NO_DATA and not path.name.startswith(".") and path.suffix in kinds
    )
    if others:
        more = f" and {len(others) - 1} more" if others[1:] else ""
        raise StoreError(
            f"{place} holds {others[0]}{more}, which this export lacks and its readers would read with it; remove "
            "what is there, or give another URL"
        )


def _record(path: Path, folder: Path) -> FileRecord:
    """Not validated: the names are those that we found, and Zarr 2 has some that releases may not have (.zarray)."""
    name, size = path.relative_to(folder).as_posix(), path.stat().st_size
    return FileRecord.model_construct(path=name, bytes=size, sha256=files.sha256_file(path))


def _to_hub(folder: Path, kind: str, url: str, records: Sequence[FileRecord], api: Any) -> None:
    """One commit of all files into a data set repository; LeRobot's loader then looks for a tag of its version."""
    where, inside = newest_of(url)
    if kind == "lerobot" and (inside or not (folder / LEROBOT_INFO).is_file()):
        raise StoreError(
            f"LeRobot finds one data set a repository: publish one folder with {LEROBOT_INFO} to "
            "hf://datasets/OWNER/NAME, or export the subsets as one data set with --merge"
        )
    with client_errors(url):
        api.create_repo(**where, exist_ok=True)
        there = [name.removeprefix(inside) for name in api.list_repo_files(**where) if name.startswith(inside)]
        _refuse_others(url, there, records)
        message = f"{folder.name}: exported to {kind} by dmcvb-gen"
        partial = [f"*{files.PARTIAL}", f"*{files.PARTIAL}/*"]
        given = dict(folder_path=folder, path_in_repo=inside, commit_message=message, ignore_patterns=partial)
        api.upload_folder(**where, **given)
        if kind == "lerobot":
            version = json.loads((folder / LEROBOT_INFO).read_text())["codebase_version"]
            if version in {tag.name for tag in api.list_repo_refs(**where).tags}:
                api.delete_tag(**where, tag=version)  # it belongs to what was before
            api.create_tag(**where, tag=version)
