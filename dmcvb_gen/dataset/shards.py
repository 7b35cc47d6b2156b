"""Shards of a release: choose them by subset and episode, read their commit records, and check their files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dmcvb_gen.dataset.manifest import (
    CommitRecord,
    FileRecord,
    Manifest,
    SubsetRecord,
    commit_path,
    parse_commit,
    shard_count,
    shard_episodes,
)
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes, sha256_file
from dmcvb_gen.spec import select

ShardKey = tuple[str, int]
"""(subset, shard)."""


def chosen_shards(
    manifest: Manifest, only: Sequence[str] = (), episodes: tuple[int, int] | None = None
) -> dict[ShardKey, SubsetRecord]:
    """The shards that hold any of the chosen episodes.

    Args:
      only: subset patterns such as "walker-walk/*/static", all subsets by default.
      episodes: (first, last + 1), all by default.

    Raises:
      UnknownNameError: a pattern that fits nothing.
      StoreError: no subset has such episodes.
    """
    names = set(select([record.name for record in manifest.subsets], list(only)))
    chosen = {}
    for record in manifest.subsets:
        for shard in range(shard_count(record)) if record.name in names else ():
            first, last = shard_episodes(record, shard)
            if episodes is None or (first < episodes[1] and episodes[0] < last):
                chosen[record.name, shard] = record
    if not chosen:
        most = max((record.episodes for record in manifest.subsets), default=0)
        first, last = episodes or (0, most)
        raise StoreError(f"no subset has episodes {first}:{last}; the longest has 0:{most}")
    return chosen


NOTHING: Mapping[str, str] = {}


def read_commit(
    root: Path, record: SubsetRecord, shard: int, known: Mapping[str, str] = NOTHING
) -> CommitRecord | None:
    """The shard's commit record, None if it is missing, unreadable or another shard's.

    Args:
      known: path in the release -> SHA-256 of files that are known; a record with another is as good as none.
    """
    name = commit_path(record.name, shard)
    try:
        data = (root / name).read_bytes()
        commit = parse_commit(data, str(root / name))
    except (OSError, StoreError):
        return None
    if name in known and sha256_bytes(data) != known[name]:
        return None
    mine = (commit.subset, commit.shard, commit.episodes) == (record.name, shard, shard_episodes(record, shard))
    return commit if mine else None


def damage(root: Path, record: SubsetRecord, shard: int, known: Mapping[str, str] = NOTHING) -> str | None:
    """Say what is wrong with a shard's files; None if every byte is as committed (`known`: see there)."""
    commit = read_commit(root, record, shard, known)
    if commit is None:
        return "has no commit record"
    for file in commit.files:
        if wrong := wrong_bytes(root, file):
            return f"{file.path} {wrong}"
    return None


def wrong_bytes(root: Path, file: FileRecord) -> str | None:
    """Say what is wrong with a file of a release, in words that follow its name; None if every byte is as recorded."""
    path = root / file.path
    try:
        if not path.is_file():
            return "is missing"
        if path.stat().st_size != file.bytes:
            return f"has {path.stat().st_size} bytes instead of {file.bytes}"
        return None if sha256_file(path) == file.sha256 else "does not have its digest"
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
