"""Shards of a release that exists: which are damaged."""

from __future__ import annotations

from pathlib import Path

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.store.manifest import CommitRecord, SubsetRecord, parse_commit
from dmcvb_gen.store.writer import commit_path, shard_episodes


def read_commit(root: Path, record: SubsetRecord, shard: int) -> CommitRecord | None:
    """The shard's commit record, None where it is missing, unreadable or another shard's."""
    path = root / commit_path(record.name, shard)
    try:
        commit = parse_commit(path.read_bytes(), str(path))
    except (OSError, StoreError):
        return None
    mine = (commit.subset, commit.shard, commit.episodes) == (record.name, shard, shard_episodes(record, shard))
    return commit if mine else None


def damage(root: Path, record: SubsetRecord, shard: int) -> str | None:
    """What is wrong with a shard's files, in words; None where every byte is as committed."""
    commit = read_commit(root, record, shard)
    if commit is None:
        return "has no commit record"
    for file in commit.files:
        path = root / file.path
        if not path.is_file():
            return f"{file.path} is missing"
        if path.stat().st_size != file.bytes:
            return f"{file.path} has {path.stat().st_size} bytes instead of {file.bytes}"
        if sha256_file(path) != file.sha256:
            return f"{file.path} does not have its digest"
    return None
