"""Making a release's shards again from its manifest alone: to check them, to repair them, or beside.

`check` compares digests and says how far and why they differ; `repair` puts back what is damaged or missing and
takes only shards that came out with the very bytes that the manifest promises; `remake` writes a release beside.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import folder_in_the_making, remove_partial
from dmcvb_gen.pool import Tick, ignore
from dmcvb_gen.release.shards import ShardKey, chosen_shards, damage, make_jobs, read_commit
from dmcvb_gen.rollout.executors import run_jobs
from dmcvb_gen.rollout.plan import Job, subset_attributes
from dmcvb_gen.store.manifest import (
    MANIFEST,
    CommitRecord,
    Manifest,
    SubsetRecord,
    environment,
    parse_manifest,
    write_json_atomically,
)
from dmcvb_gen.store.schema import EpisodeShape, array_specs
from dmcvb_gen.store.writer import (
    commit_path,
    create_subset,
    find_array,
    finish_release,
    read_commits,
    shard_count,
    shard_episodes,
    start_release,
    subset_digest,
    subset_path,
)
from dmcvb_gen.tasks import get_task


@dataclass(frozen=True)
class ArrayDifference:
    """How far one array of a shard is from the released one: largest and mean absolute difference."""

    array: str
    largest: float
    mean: float


@dataclass(frozen=True)
class ShardOutcome:
    """What became of one shard.

    Attributes:
      was: what was wrong with the released files, None if nothing.
      equal: whether it came out with the promised bytes; None if the manifest promises none.
      repaired: whether it was put into the release.
      differences: where it came out otherwise and both can be read; empty if only the compression differs.
      compared: whether both could be read.
    """

    subset: str
    shard: int
    episodes: tuple[int, int]
    was: str | None
    equal: bool | None
    repaired: bool = False
    differences: tuple[ArrayDifference, ...] = ()
    compared: bool = False

    def __str__(self) -> str:
        text = f"{self.subset} shard {self.shard} (episodes {self.episodes[0]}:{self.episodes[1]}): "
        if self.was:
            text += f"{self.was}; "
        if self.equal is None:
            return text + ("made" if self.repaired else "made again, the manifest has no digest to compare with")
        if self.equal:
            return text + ("repaired" if self.repaired else "made again with the same digest")
        text += "made again, other bytes"
        if not self.compared:
            return text + " (the released ones cannot be read, so how far is unknown)"
        if not self.differences:
            return text + " but equal values: only the compression differs"
        moved = {difference.array for difference in self.differences}
        parts = [f"{name} {'differ' if name in moved else 'equal'}" for name in ("action", "state", "physics")]
        for difference in self.differences:
            unit = " grey levels" if difference.array.startswith("pixels") else ""
            parts.append(f"{difference.array}: max {difference.largest:.3g}, mean {difference.mean:.3g}{unit}")
        return text + "; " + ", ".join(parts)


@dataclass(frozen=True)
class Outcome:
    """Outcomes of all shards, and what is another version or device than when the release was made."""

    shards: tuple[ShardOutcome, ...]
    environment: dict[str, tuple[str, str]]

    @property
    def sound(self) -> bool:
        """Whether every shard is now, or was already, what the manifest promises."""
        return all(shard.equal is not False and (shard.was is None or shard.repaired) for shard in self.shards)


def environment_difference(manifest: Manifest) -> dict[str, tuple[str, str]]:
    """What of this machine is in none of the environments that made the release: name -> (there, here)."""
    here = environment()
    return {
        name: (" or ".join(sorted({old.get(name, "unknown") for old in manifest.environments})) or "unknown", value)
        for name, value in here.items()
        if any(name in old for old in manifest.environments)
        and value not in {old.get(name) for old in manifest.environments}
    }


def compare_shards(one: Path, other: Path, record: SubsetRecord, shard: int) -> tuple[ArrayDifference, ...] | None:
    """Differences of a shard's values in two releases, None where one of them cannot be read."""
    first, last = shard_episodes(record, shard)
    found = []
    try:
        groups = [
            zarr.open_group(str(root / subset_path(record.name)), mode="r", use_consolidated=False)
            for root in (one, other)
        ]
        for spec in array_specs(EpisodeShape.of(get_task(record.task)), record.size):
            a, b = (np.asarray(find_array(group, spec.name)[0][first:last]) for group in groups)
            if np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
                continue
            gap = np.abs(a.astype(np.float64) - b.astype(np.float64))
            found.append(ArrayDifference(spec.name, float(gap.max()), float(gap.mean())))
    except Exception:  # damaged bytes make codecs raise anything; all mean that there is nothing to compare with
        return None
    return tuple(found)


def load_manifest(root: str | Path) -> tuple[Path, Manifest]:
    """A local release's folder and manifest.

    Raises:
      StoreError: there is none.
    """
    root = Path(root)
    if not (root / MANIFEST).is_file():
        raise StoreError(f"{root} holds no release (no {MANIFEST}); give the folder that `rollout --out` made")
    return root, parse_manifest((root / MANIFEST).read_bytes(), str(root / MANIFEST))


def create_groups(root: Path, manifest: Manifest, records: Sequence[SubsetRecord]) -> None:
    """Create the (empty) Zarr groups of subsets."""
    for record in records:
        task = get_task(record.task)
        create_subset(
            root,
            record,
            array_specs(EpisodeShape.of(task), record.size),
            task.max_steps + 1,
            subset_attributes(record, manifest),
        )


def _is_json(path: Path) -> bool:
    try:
        json.loads(path.read_bytes())
    except (OSError, ValueError):
        return False
    return True


def _take_metadata(root: Path, folder: Path, record: SubsetRecord) -> None:
    """Use the release's own array metadata where it can be read: codecs of today's code may not be the release's."""
    for target in sorted((folder / subset_path(record.name)).rglob("zarr.json")):
        source = root / target.relative_to(folder)
        if _is_json(source):
            shutil.copyfile(source, target)


def _unique(records) -> list[SubsetRecord]:
    return list({record.name: record for record in records}.values())


class _Workshop:
    """A folder beside the data (same file system, so that files can be moved in) where shards are made."""

    def __init__(self, root: Path, manifest: Manifest, records: Sequence[SubsetRecord]):
        self._root, self._manifest, self._records = root, manifest, records

    def __enter__(self) -> Path:
        with contextlib.ExitStack() as stack:
            try:
                remove_partial(self._root, below=False)  # the workshop of a run that was killed
                folder = stack.enter_context(folder_in_the_making(self._root, "regenerate"))
            except OSError as error:
                raise StoreError(f"cannot write to {self._root}: {error.strerror or error}; give --out") from None
            create_groups(folder, self._manifest, self._records)
            for record in self._records:
                _take_metadata(self._root, folder, record)
            self._stack = stack.pop_all()
        return folder

    def __exit__(self, *_):
        self._stack.close()


def _run(jobs: Sequence[Job], workers: int, tick: Tick) -> Iterator[CommitRecord]:
    for result in run_jobs(jobs, workers, tick):
        yield from result.commits


def check(
    root: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    backgrounds: str | None = None,
    device: str | None = None,
    workers: int = 1,
    tick: Tick = ignore,
) -> Outcome:
    """Make shards again and compare their digests with the release; the release is not changed.

    Args:
      only, episodes: which shards (those that hold any of the episodes).
      backgrounds: where the videos are now, if they moved.
      device: paint there instead of where the manifest says.

    Raises:
      DmcvbError: the shards cannot be made here (policy, backgrounds or renderer missing).
    """
    root, manifest = load_manifest(root)
    shards = chosen_shards(manifest, only, episodes)
    outcomes = []
    with _Workshop(root, manifest, _unique(shards.values())) as folder:
        jobs = make_jobs(manifest, root, shards, folder, backgrounds=backgrounds, device=device)
        held: dict[str, dict[int, CommitRecord]] = {}
        for commit in _run(jobs, workers, tick):
            record = shards[commit.subset, commit.shard]
            promised = read_commit(root, record, commit.shard)
            held.setdefault(record.name, {})[commit.shard] = commit
            equal = None if promised is None else promised.same_data(commit)
            outcomes.append(_outcome(root, folder, record, commit, damage(root, record, commit.shard), equal=equal))
            for file in commit.files:
                (folder / file.path).unlink(missing_ok=True)  # a checked shard needs no room
    outcomes = [
        outcome
        if outcome.equal is not None
        else replace(outcome, equal=_subset_equal(root, shards[outcome.subset, outcome.shard], held))
        for outcome in outcomes
    ]
    return Outcome(tuple(outcomes), environment_difference(manifest))


def _subset_equal(root: Path, record: SubsetRecord, held: dict[str, dict[int, CommitRecord]]) -> bool | None:
    """Whether shards without a commit record, beside those that have one, give the subset's digest."""
    if record.digest is None:
        return None
    commits = {}
    for shard in range(shard_count(record)):
        commit = read_commit(root, record, shard) or held[record.name].get(shard)
        if commit is None:
            return None  # another shard is missing too: not all was asked for
        commits[shard] = commit
    return subset_digest(commits) == record.digest


def _outcome(root, folder, record, commit, was, *, equal, repaired=False) -> ShardOutcome:
    differences = None
    if equal is False:
        differences = compare_shards(root, folder, record, commit.shard)
    return ShardOutcome(
        record.name,
        commit.shard,
        commit.episodes,
        was,
        equal,
        repaired,
        differences or (),
        differences is not None,
    )


def repair(
    root: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    backgrounds: str | None = None,
    device: str | None = None,
    workers: int = 1,
    tick: Tick = ignore,
) -> Outcome:
    """Make damaged and missing shards again, in place; sound ones are not touched.

    A shard is taken only if it has the bytes that its commit record (or the subset's digest) promises; where the
    manifest promises nothing yet, because the release was never finished, it is taken as it is.

    Args, raises: see `check`.
    """
    root, manifest = load_manifest(root)
    shards = {
        key: record
        for key, record in chosen_shards(manifest, only, episodes).items()
        if damage(root, record, key[1]) is not None
    }
    records = _unique(chosen_shards(manifest, only).values())
    outcomes: list[ShardOutcome] = []
    with _Workshop(root, manifest, records) as folder:
        for record in records:
            _restore_metadata(root, folder, record)
        jobs = make_jobs(manifest, root, shards, folder, backgrounds=backgrounds, device=device)
        held: dict[str, dict[int, CommitRecord]] = {}
        reasons: dict[ShardKey, str | None] = {}
        for commit in _run(jobs, workers, tick):
            record = shards[commit.subset, commit.shard]
            was, promised = damage(root, record, commit.shard), read_commit(root, record, commit.shard)
            if promised is None and record.digest is not None:
                held.setdefault(record.name, {})[commit.shard] = commit
                reasons[record.name, commit.shard] = was
                continue
            equal = None if promised is None else promised.same_data(commit)
            if equal is not False:
                _move_in(root, folder, commit)
            outcomes.append(_outcome(root, folder, record, commit, was, equal=equal, repaired=equal is not False))
        for record in records:
            if record.name not in held:
                continue
            equal = _subset_equal(root, record, held)
            for commit in held[record.name].values():
                if equal is not False:
                    _move_in(root, folder, commit)
                was = reasons[record.name, commit.shard]
                outcomes.append(_outcome(root, folder, record, commit, was, equal=equal, repaired=equal is not False))
    if not manifest.complete and any(outcome.repaired for outcome in outcomes):
        here = environment()
        if here not in manifest.environments:
            manifest = manifest.model_copy(update={"environments": (*manifest.environments, here)})
        finish_release(root, manifest)
    return Outcome(tuple(outcomes), environment_difference(manifest))


def _restore_metadata(root: Path, folder: Path, record: SubsetRecord) -> None:
    """Put back Zarr metadata that is missing or no JSON; what can be read stays."""
    for source in sorted((folder / subset_path(record.name)).rglob("zarr.json")):
        target = root / source.relative_to(folder)
        if not _is_json(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
    (root / subset_path(record.name) / ".created").touch()


def _move_in(root: Path, folder: Path, commit: CommitRecord) -> None:
    """Replace a shard's files, then its record: at no moment does a record stand for files that are not there."""
    record = root / commit_path(commit.subset, commit.shard)
    try:
        record.unlink(missing_ok=True)
        for file in commit.files:
            target = root / file.path
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / file.path, target)
        write_json_atomically(record, commit)
    except OSError as error:
        raise StoreError(
            f"cannot put shard {commit.shard} of {commit.subset} into {root}: {error.strerror or error}; "
            "make room and run the same command again"
        ) from None


def remake(
    root: str | Path,
    out: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    backgrounds: str | None = None,
    device: str | None = None,
    workers: int = 1,
    tick: Tick = ignore,
) -> Outcome:
    """Write a release beside, from the manifest of `root`; run again, it goes on where it stopped.

    Args:
      out: folder of the new release.

    Args, raises: see `check`.
    """
    root, manifest = load_manifest(root)
    out = Path(out)
    if out.resolve() == root.resolve():
        raise StoreError(f"--out {out} is the release itself; leave --out away to repair it in place")
    shards = chosen_shards(manifest, only, episodes)
    fresh = manifest.model_copy(
        update={
            "subsets": tuple(record.model_copy(update={"digest": None}) for record in manifest.subsets),
            "environments": (environment(),),
            "complete": False,
        }
    )
    fresh = start_release(out, fresh)
    create_groups(out, fresh, _unique(shards.values()))
    for record in _unique(shards.values()):
        _take_metadata(root, out, record)
    done = {record.name: read_commits(out, record) for record in _unique(shards.values())}
    todo = {key: record for key, record in shards.items() if key[1] not in done[key[0]]}
    jobs = make_jobs(manifest, root, todo, out, backgrounds=backgrounds, device=device)
    copy_policies(root, out, _unique(shards.values()), jobs)
    commits = [commit for name in done for commit in done[name].values() if (name, commit.shard) in shards]
    commits += _run(jobs, workers, tick)
    finished = finish_release(out, fresh)
    digests = {record.name: record.digest for record in finished.subsets}
    outcomes = []
    for commit in commits:
        record = shards[commit.subset, commit.shard]
        promised = read_commit(root, record, commit.shard)
        equal = promised.same_data(commit) if promised else None
        if promised is None and record.digest and digests[record.name]:
            equal = digests[record.name] == record.digest
        outcomes.append(_outcome(root, out, record, commit, None, equal=equal))
    return Outcome(tuple(outcomes), environment_difference(manifest))


def copy_policies(root: Path, out: Path, records: Sequence[SubsetRecord], jobs: Sequence[Job]) -> None:
    """Copy the policies of subsets into another release."""
    found = {record.name: job.policies for job in jobs for record in job.subsets}
    for record in records:
        for policy, source in zip(record.policies, found.get(record.name, ()), strict=False):
            target = out / policy.path
            if policy.path and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
