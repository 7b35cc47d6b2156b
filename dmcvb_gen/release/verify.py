"""Is a release what it says? A folder in, findings out: bytes, shapes, values, physics, pixels, returns.

Every finding names subset, episode and step. Digests and values are checked everywhere; a sample of steps is
simulated again and a sample of frames painted again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.release.finding import Finding
from dmcvb_gen.store import Subset, open_release
from dmcvb_gen.store.index import INDEX, Index, read_index, root_digest
from dmcvb_gen.store.manifest import (
    MANIFEST,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.store.remote import storage_errors
from dmcvb_gen.store.writer import subset_digest

PREVIEWS = "preview/"
"""Folder that `dmcvb-gen preview` writes to; no part of a release."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Verification:
    """What was looked at, and what was found wrong.

    Attributes:
      checked: how many subsets, episodes and steps.
      findings: what is wrong.
      incomplete: subsets that are sound but not all here -> (episodes here, episodes that belong to them).
      digest: the release's root digest, None while it is made (and of version 1).
    """

    checked: dict[str, int]
    findings: tuple[Finding, ...]
    incomplete: dict[str, tuple[int, int]] = field(default_factory=dict)
    digest: str | None = None

    @property
    def sound(self) -> bool:
        """Whether everything that is here is as it was made."""
        return not self.findings

    @property
    def complete(self) -> bool:
        """Whether everything that belongs to the release is here."""
        return not self.incomplete


# -- bytes ----------------------------------------------------------------------------------------


def check_files(root: Path) -> Iterator[Finding]:
    """Every file of a local release has its digest and every shard of a complete one is there; see `store.index`."""
    try:
        manifest = parse_manifest((root / MANIFEST).read_bytes(), MANIFEST)
    except StoreError as error:
        yield Finding("files", MANIFEST, f"is damaged: {error}")
        return
    try:
        index = read_index(root)
    except StoreError as error:
        yield Finding("files", INDEX, f"is damaged: {error}")
        index = None
    else:
        if index is None and manifest.digest is not None:
            yield Finding("files", INDEX, "is missing; fetch it again")
    checked: set[str] = set()
    for record in manifest.subsets:
        yield from _check_shards(root, manifest, record, checked)
    if index is not None:
        yield from _check_index(root, manifest, index, checked)
        if manifest.complete:
            yield from _check_extra(root, manifest, index)


def _check_index(root: Path, manifest: Manifest, index: Index, checked: set[str]) -> Iterator[Finding]:
    for file in index.files:
        if file.path not in checked:
            yield from _check_file(root, file, subset_of(manifest, file.path))
    if sha256_file(root / MANIFEST) != index.manifest_sha256:
        yield Finding("files", MANIFEST, f"does not have the digest that {INDEX} says")
    elif manifest.digest is not None and root_digest(index.files, manifest) != manifest.digest:
        yield Finding("files", MANIFEST, f"its root digest is not that of the files in {INDEX}")


def _check_extra(root: Path, manifest: Manifest, index: Index) -> Iterator[Finding]:
    """Files of a finished release that no digest speaks of, and that readers may yet take for data."""
    listed = {file.path for file in index.files} | {MANIFEST, INDEX}
    with storage_errors(root):
        for path in sorted(root.rglob("*")):
            name = path.relative_to(root).as_posix()
            ours = name.startswith(PREVIEWS) or any(part.startswith(".") for part in name.split("/"))
            if not ours and name not in listed and path.is_file():
                text = f"{name} is listed nowhere: no part of the release; move it elsewhere"
                yield Finding("files", subset_of(manifest, name), text)


def subset_of(manifest: Manifest, path: str) -> str:
    """The subset that a file belongs to; the file itself where it belongs to none."""
    for record in manifest.subsets:
        if path.startswith((f"{subset_path(record.name)}/", f"commits/{record.name}/")):
            return record.name
    return path


def _check_file(root: Path, file: FileRecord, where: str, what: str = "") -> Iterator[Finding]:
    path, name = root / file.path, file.path + what
    with storage_errors(path):
        if not path.is_file():
            yield Finding("files", where, f"{name} is missing")
        elif path.stat().st_size != file.bytes:
            yield Finding("files", where, f"{name} has {path.stat().st_size} bytes instead of {file.bytes}")
        elif sha256_file(path) != file.sha256:
            yield Finding("files", where, f"{name} does not have its digest")


def _check_shards(root: Path, manifest: Manifest, record: SubsetRecord, checked: set[str]) -> Iterator[Finding]:
    """Commit records and their files, which are put into `checked`."""
    commits = {}
    for shard in range(shard_count(record)):
        path = commit_path(record.name, shard)
        if not (root / path).is_file():
            if manifest.complete:
                yield Finding("files", record.name, f"shard {shard} is missing: no {path}")
            continue
        try:
            commit = commits[shard] = checked_commit((root / path).read_bytes(), path, record, shard)
        except StoreError as error:
            yield Finding("files", record.name, f"{path} is damaged: {error}")
            continue
        for file in commit.files:
            checked.add(file.path)
            yield from _check_file(root, file, record.name, f" of shard {shard}")
    if record.digest and len(commits) == shard_count(record) and subset_digest(commits) != record.digest:
        yield Finding("files", record.name, "its commit records do not give the digest of the manifest")


def verify(
    path: str | Path, backgrounds: str | None = None, tick: Callable[[str], None] = lambda subset: None
) -> Verification:
    """Check a release.

    Args:
      backgrounds: where the manifest's videos are now, if they moved.

    Raises:
      DmcvbError: there is no release, or nothing is committed.
    """
    root = Path(path)
    if not (root / MANIFEST).is_file():
        open_release(path)  # says what is the matter
    findings = list(check_files(root))
    damaged = {finding.subset for finding in findings}
    counts = {"subsets": 0, "episodes": 0, "steps": 0}
    if damaged & {MANIFEST, INDEX}:
        return Verification(counts, tuple(findings))  # nothing says what the rest should be
    release = open_release(path, skip=damaged)
    if not release.subsets and not findings:
        raise DmcvbError(f"{path} has no committed episodes yet; run the rollout first")
    for name, subset in release.subsets.items():
        tick(name)
        counts["subsets"] += 1
        counts["episodes"] += len(subset.episodes)
        counts["steps"] += subset.steps
        findings += _check_subset(subset, backgrounds)
    incomplete = {name: count for name, count in release.shortfalls.items() if name not in damaged}
    return Verification(counts, tuple(findings), incomplete, release.manifest.digest)


def _check_subset(subset: Subset, backgrounds: str | None) -> list[Finding]:
    try:
        from dmcvb_gen.release import contents
    except ModuleNotFoundError as error:
        # Whoever only reads has no simulator; bytes are checked all the same, and this says what was not.
        log.warning("values, physics and pictures of %s were not checked: %s is not installed", subset.name, error.name)
        return []
    try:
        return list(contents.check_contents(subset, backgrounds))
    except StoreError as error:
        return [Finding("files", subset.name, str(error))]
