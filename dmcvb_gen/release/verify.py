"""Check that a release is what it says: bytes, shapes, values, physics, pixels and returns.

Every finding names subset, episode and step. Digests and values are checked everywhere; a sample of steps is
simulated again and a sample of frames painted again.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dmcvb_gen.dataset import Subset, open_release
from dmcvb_gen.dataset.index import INDEX, Index, is_card, read_index, root_digest
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.dataset.shards import wrong_bytes
from dmcvb_gen.dataset.writer import subset_digest
from dmcvb_gen.errors import BackgroundError, DmcvbError, RenderingError, StoreError, UnknownNameError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.parallel import Pool, ProgressCallback, Workers, expect, ignore, in_order, open_pool
from dmcvb_gen.release.issue import NOT_PART, UNCHECKED, Issue
from dmcvb_gen.storage.remote import storage_errors

SHARDS = 8
"""Shards whose bytes are checked as one piece of work."""
PREVIEWS = "preview/"
"""Folder that `dmcvb-gen preview` writes to; no part of a release."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Verification:
    """Result of a verification: what was checked, and the issues.

    Attributes:
      checked: number of subsets, episodes and steps.
      findings: faults that were found.
      incomplete: subsets that are sound but not all here -> (episodes here, episodes that belong to them).
      digest: the release's root digest, None while it is made (and of version 1).
      finished: True if its digests were written once everything was there.
      unchecked: what could not be looked at on this machine, and why; nothing is known to be damaged there.
    """

    checked: dict[str, int]
    findings: tuple[Issue, ...]
    incomplete: dict[str, tuple[int, int]] = field(default_factory=dict)
    digest: str | None = None
    finished: bool = True
    unchecked: tuple[Issue, ...] = ()

    @property
    def sound(self) -> bool:
        """True if everything that is here is as it was made."""
        return not self.findings

    @property
    def complete(self) -> bool:
        """True if everything that belongs to the release is here, and was checked."""
        return self.finished and not self.incomplete and not self.unchecked


# -- bytes ----------------------------------------------------------------------------------------


def check_files(root: Path, workers: Workers | Pool = 1, tick: ProgressCallback = ignore) -> Iterator[Issue]:
    """Every file of a local release has its digest and every shard of a complete one is there; see `dataset.index`.

    Args:
      workers: processes, a Ray cluster that sees the folder, or an open pool.
      tick: told the subset's name for each few shards; expects one more for each subset, whose values may follow.
    """
    try:
        with storage_errors(root / MANIFEST):
            manifest = parse_manifest((root / MANIFEST).read_bytes(), MANIFEST)
    except StoreError as error:
        yield Issue("files", MANIFEST, f"is damaged: {error}")
        return
    try:
        index = read_index(root)
    except StoreError as error:
        yield Issue("files", INDEX, f"is damaged: {error}")
        index = None
    else:
        if index is None and manifest.digest is not None:
            yield Issue("files", INDEX, "is missing; `dmcvb-gen regenerate` writes it again")
    works, checked = _works(root, manifest), set()
    expect(tick, len(works) + len(manifest.subsets))
    found = in_order(_check_shards, works, workers, tick)
    for record in manifest.subsets:
        commits: dict[int, CommitRecord] = {}
        for work, part in zip(works, found, strict=True):
            if work.record is record:
                yield from part.findings
                checked |= set(part.files)
                commits |= part.commits
        yield from _check_digest(record, commits)
    if index is not None:
        yield from _check_index(root, manifest, index, checked)
        if manifest.complete:
            yield from _check_extra(root, manifest, index)


def _check_index(root: Path, manifest: Manifest, index: Index, checked: set[str]) -> Iterator[Issue]:
    for file in index.files:
        if file.path not in checked:
            yield from _check_file(root, file, subset_of(manifest, file.path))
    if sha256_file(root / MANIFEST) != index.manifest_sha256:
        yield Issue("files", MANIFEST, f"does not have the digest that {INDEX} says")
    elif manifest.digest is not None and root_digest(index.files, manifest) != manifest.digest:
        yield Issue("files", MANIFEST, f"its root digest does not fit the files in {INDEX}")


def _check_extra(root: Path, manifest: Manifest, index: Index) -> Iterator[Issue]:
    """Files of a finished release that no digest speaks of, and that readers may yet take for data."""
    listed = {file.path for file in index.files} | {MANIFEST, INDEX}
    with storage_errors(root):
        for path in sorted(root.rglob("*")):
            name = path.relative_to(root).as_posix()
            ours = name.startswith(PREVIEWS) or any(part.startswith(".") for part in name.split("/"))
            if not ours and name not in listed and path.is_file():
                place = subset_of(manifest, name)
                told = NOT_PART if place == name else f"{name} {NOT_PART}"
                cure = "run `dmcvb-gen card` again" if is_card(name) else "move it elsewhere"
                yield Issue("files", place, f"{told}; {cure}")


def subset_of(manifest: Manifest, path: str) -> str:
    """The subset that a file belongs to; the file itself if it belongs to none."""
    for record in manifest.subsets:
        if path.startswith((f"{subset_path(record.name)}/", f"commits/{record.name}/")):
            return record.name
    return path


def _check_file(root: Path, file: FileRecord, where: str, what: str = "") -> Iterator[Issue]:
    if wrong := wrong_bytes(root, file):
        yield Issue("files", where, wrong if where == file.path else f"{file.path}{what} {wrong}")


@dataclass(frozen=True)
class _Shards:
    """Some shards of a subset, whose bytes are to be checked; travels to a worker."""

    root: Path
    record: SubsetRecord
    shards: range
    wanted: bool
    """Whether each must be there."""


@dataclass(frozen=True)
class _Checked:
    """Result of checking some shards' bytes: issues, files that were checked, and readable records."""

    findings: tuple[Issue, ...]
    files: tuple[str, ...]
    commits: Mapping[int, CommitRecord]


def _works(root: Path, manifest: Manifest) -> list[_Shards]:
    return [
        _Shards(root, record, range(first, min(first + SHARDS, shard_count(record))), manifest.complete)
        for record in manifest.subsets
        for first in range(0, shard_count(record), SHARDS)
    ]


def _check_shards(work: _Shards, tick: ProgressCallback = ignore) -> _Checked:
    """Commit records and their files."""
    root, record, commits, checked, findings = work.root, work.record, {}, [], []
    tick(record.name)
    for shard in work.shards:
        path = commit_path(record.name, shard)
        if not (root / path).is_file():
            if work.wanted:
                findings.append(Issue("files", record.name, f"shard {shard} is missing: no {path}"))
            continue
        try:
            with storage_errors(root / path):
                commit = commits[shard] = checked_commit((root / path).read_bytes(), path, record, shard)
        except StoreError as error:
            findings.append(Issue("files", record.name, f"{path} is damaged: {error}"))
            continue
        for file in commit.files:
            checked.append(file.path)
            findings += _check_file(root, file, record.name, f" of shard {shard}")
    return _Checked(tuple(findings), tuple(checked), commits)


def _check_digest(record: SubsetRecord, commits: Mapping[int, CommitRecord]) -> Iterator[Issue]:
    if record.digest and len(commits) == shard_count(record) and subset_digest(commits) != record.digest:
        yield Issue("files", record.name, "its commit records do not give the digest of the manifest")


def verify(
    path: str | Path,
    backgrounds: str | None = None,
    tick: ProgressCallback = ignore,
    workers: Workers | Pool = 1,
    names: Collection[str] | None = None,
) -> Verification:
    """Check a release.

    Args:
      backgrounds: present place of the manifest's videos, if they moved.
      names: the subsets whose values are looked at; all by default. Bytes are checked everywhere.
      tick: told the subset's name for each few shards whose bytes, and each subset whose values, are looked at.
      workers: processes, a Ray cluster that sees the folder, or an open pool (whose tick is told): bytes are checked a
        few shards at a time, values a subset.

    Raises:
      DmcvbError: there is no release, or nothing is committed.
    """
    root = Path(path)
    with storage_errors(root / MANIFEST):
        there = (root / MANIFEST).is_file()
    if not there:
        open_release(path)  # says what is the matter
    if not isinstance(workers, Pool):
        with open_pool(workers, tick=tick) as pool:  # one for bytes and values: its workers are slow to start
            return verify(path, backgrounds, tick, pool, names)
    findings = list(check_files(root, workers, tick))
    damaged = {finding.subset for finding in findings}
    counts = {"subsets": 0, "episodes": 0, "steps": 0}
    if damaged & {MANIFEST, INDEX}:
        return Verification(counts, tuple(findings))  # nothing says what the rest should be
    release = open_release(path, skip=damaged)
    if not release.subsets and not findings:
        raise DmcvbError(f"{path} has no committed episodes yet; run the rollout first")
    chosen = [subset for name, subset in release.subsets.items() if names is None or name in names]
    for subset in chosen:
        counts["subsets"] += 1
        counts["episodes"] += len(subset.episodes)
        counts["steps"] += subset.steps
    works = [(subset, release.manifest, backgrounds) for subset in chosen]
    for found in in_order(_check_subset, works, workers, tick):
        findings += found
    incomplete = {name: count for name, count in release.shortfalls.items() if name not in damaged}
    manifest = release.manifest
    finished = manifest.complete and (manifest.digest is not None or manifest.schema_version == 1)
    unchecked = tuple(finding for finding in findings if finding.check == UNCHECKED)
    faults = tuple(finding for finding in findings if finding.check != UNCHECKED)
    return Verification(counts, faults, incomplete, release.manifest.digest, finished, unchecked)


def _check_subset(work: tuple[Subset, Manifest, str | None], tick: ProgressCallback) -> list[Issue]:
    subset, manifest, backgrounds = work
    tick(subset.name)
    try:
        from dmcvb_gen.distractors.registry import distractors_of
        from dmcvb_gen.generate.jobs import streams_of
        from dmcvb_gen.release import contents
        from dmcvb_gen.tasks import get_task
    except ModuleNotFoundError as error:
        # Whoever only reads has no simulator; bytes are checked all the same, and this says what was not.
        log.warning("values, physics and images of %s were not checked: %s is not installed", subset.name, error.name)
        return []
    try:
        get_task(subset.task)
        distractors_of(subset.record.distractor)
    except DmcvbError as error:  # code of somebody else, which is not here or does not run here
        return [Issue(UNCHECKED, subset.name, f"values, physics and images cannot be checked here: {error}")]
    try:
        return list(contents.check_contents(subset, streams_of(manifest, subset.record), backgrounds))
    except (RenderingError, BackgroundError, UnknownNameError, ImportError) as error:  # what this machine lacks
        return [Issue(UNCHECKED, subset.name, f"values, physics or images cannot be checked here: {error}")]
    except DmcvbError as error:
        return [Issue("files", subset.name, str(error))]
