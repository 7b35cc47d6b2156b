"""Check that a published release is what it says; nothing is stored on this machine.

Manifest, index and commit records are read and held against one another; files are read and compared with their
digests, a sample of them or all; of the rest, that they are there at their size.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.index import INDEX, root_digest
from dmcvb_gen.dataset.manifest import FileRecord, commit_path, shard_count
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.writer import subset_digest
from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.release.fetch import Source
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.release.verify import Verification, subset_of
from dmcvb_gen.storage.base import in_parallel

SAMPLE_FILES = 40
"""Files that are read if not all are asked for; spread evenly over the release."""
WORKERS = 8


def verify_url(
    url: str,
    options: dict[str, Any] | None = None,
    everything: bool = False,
    tick: ProgressCallback = ignore,
    workers: int = WORKERS,
) -> Verification:
    """Check a published release where it is.

    Args:
      options: options of fsspec.
      everything: read all files, not a sample.
      tick: called with 1 for each file.
      workers: files at once.

    Raises:
      StoreError: no release is there, or it cannot be read.
    """
    source = Source.find(url, options)
    findings = []
    if source.manifest.digest not in (None, root_digest(source.index.files, source.manifest)):
        findings.append(Issue("files", INDEX, "its files do not give the root digest of the manifest"))
    chosen = list(source.index.files)
    if not everything:
        places = np.unique(np.linspace(0, len(chosen) - 1, min(SAMPLE_FILES, len(chosen))).round().astype(int))
        chosen = [chosen[place] for place in places]

    def look(file: FileRecord) -> Issue | None:
        try:
            digest = source.storage.sha256(file)
        except StoreError as error:
            return Issue("files", subset_of(source.manifest, file.path), str(error))
        if digest == file.sha256:
            return None
        return Issue("files", subset_of(source.manifest, file.path), f"{file.path} does not have its digest")

    expect(tick, len(chosen))
    looked = in_parallel(look, chosen, workers, lambda _: tick(1))
    findings += [found for found in looked if found]
    damaged = {file.path for file, found in zip(chosen, looked, strict=True) if found}
    counts = {"subsets": 0, "episodes": 0, "steps": 0, "files": len(chosen)}
    try:
        release = open_release(url, options)
    except StoreError as error:
        return Verification(counts, (*findings, Issue("files", "commits", str(error))))
    findings += _missing(source, damaged)
    listed, finished = {file.path: file for file in source.index.files}, source.manifest.complete
    for subset in release.subsets.values():
        findings += _disagreements(subset, listed)
        finished &= all(commit_path(subset.name, shard) in listed for shard in subset.commits)
        counts["subsets"] += 1
        counts["episodes"] += len(subset.episodes)
        counts["steps"] += subset.steps
    return Verification(counts, tuple(findings), release.shortfalls, release.manifest.digest, finished)


def _missing(source: Source, damaged: Collection[str]) -> list[Issue]:
    """Files that the index lists and that are not there, or have another size, as far as the place can be listed.

    Args:
      damaged: paths of what was found to be so already.
    """
    if not source.storage.lists_sizes:
        return []  # a sample was read
    try:
        there = source.storage.list()
    except StoreError:
        return []  # may be read and not listed; a sample was read
    found = []
    for file in source.index.files:
        size = there[file.path].bytes if file.path in there else -1
        text = f"{file.path} is missing or has another size"
        if size not in (None, file.bytes) and file.path not in damaged:
            found.append(Issue("files", subset_of(source.manifest, file.path), text))
    return found


def _disagreements(subset: Subset, listed: Mapping[str, FileRecord]) -> list[Issue]:
    """List where the commit records of a subset disagree with the index or the manifest.

    Args:
      listed: files of the index, by path; shards that it does not know yet were made since.
    """
    found = []
    for shard, commit in subset.commits.items():
        other = [file.path for file in commit.files if listed.get(file.path) != file]
        if other and commit_path(subset.name, shard) in listed:
            text = f"shard {shard}: its commit record and {INDEX} do not agree about {other[0]}"
            found.append(Issue("files", subset.name, text))
    whole = len(subset.commits) == shard_count(subset.record)
    if whole and subset.record.digest not in (None, subset_digest(subset.commits)):
        found.append(Issue("files", subset.name, "its commit records do not give the digest of the manifest"))
    return found
