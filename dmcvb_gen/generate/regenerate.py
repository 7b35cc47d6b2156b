"""Making a release's shards again from its manifest alone: to check them, to repair them, or beside.

`Regeneration.check` compares digests and says how far and why they differ; `repair` puts back what is damaged or
missing and takes only shards that came out with the very bytes that the manifest promises; `remake` writes a release
beside.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.dataset.index import ZARR_JSON, restore_index, restored_commit, trusted_index
from dmcvb_gen.dataset.manifest import CommitRecord, Manifest, SubsetRecord, environment
from dmcvb_gen.dataset.pictures import SHOWN
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.dataset.schema import EpisodeShape, subset_specs
from dmcvb_gen.dataset.shards import chosen_shards, damage, read_commit
from dmcvb_gen.dataset.writer import (
    CREATED,
    commit_path,
    find_array,
    finish_release,
    finish_together,
    mark_created,
    read_commits,
    shard_count,
    shard_episodes,
    start_release,
    subset_digest,
    subset_path,
)
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import (
    copy_file,
    folder_in_the_making,
    parse_json,
    remove_partial,
    sha256_bytes,
    sha256_file,
    write_json,
)
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.jobs import make_jobs, release_inputs
from dmcvb_gen.generate.plan import copy_inputs, create_groups
from dmcvb_gen.generate.site import FolderSite
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.storage.remote import local_path, storage_errors
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
    """What became of a release.

    Attributes:
      shards: outcomes of all that were made.
      environment: what is another version or device than when the release was made.
      left: shards of a release that is not complete which are not here, and were not looked at.
    """

    shards: tuple[ShardOutcome, ...]
    environment: dict[str, tuple[str, str]]
    left: int = 0

    @property
    def sound(self) -> bool:
        """Whether every shard is now, or was already, what the manifest promises."""
        return all(shard.equal is not False and (shard.was is None or shard.repaired) for shard in self.shards)


def environment_diff(manifest: Manifest) -> dict[str, tuple[str, str]]:
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
        for spec in subset_specs(EpisodeShape.of(get_task(record.task)), record):
            a, b = (np.asarray(find_array(group, spec.name)[0][first:last]) for group in groups)
            if np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
                continue
            gap = np.abs(a.astype(np.float64) - b.astype(np.float64))
            found.append(ArrayDifference(spec.name, float(gap.max()), float(gap.mean())))
    except Exception:  # damaged bytes make codecs raise anything; all mean that there is nothing to compare with
        return None
    return tuple(found)


@dataclass(frozen=True)
class Regeneration:
    """Which shards of a release to make again, and how.

    Attributes:
      root: the release's folder.
      only, episodes: subset patterns and (first, last + 1): the shards that hold any of them; all by default.
      backgrounds: where the videos are now, if they moved.
      device: paint there instead of where the manifest says.
      workers: processes, or a Ray cluster that sees the same folders.
    """

    root: str | Path
    only: Sequence[str] = ()
    episodes: tuple[int, int] | None = None
    backgrounds: str | None = None
    device: str | None = None
    workers: Workers = 1

    def check(self, tick: ProgressCallback = ignore) -> Outcome:
        """Make shards again and compare their digests with the release; the release is not changed.

        Of a part that was fetched, or a rollout that is not finished, the shards that are here are made.

        Raises:
          DmcvbError: the shards cannot be made here (policy, backgrounds or renderer missing).
        """
        root, manifest = load_manifest(self.root)
        chosen, known = chosen_shards(manifest, self.only, self.episodes), _Known(root, manifest)
        here = {k: r for k, r in chosen.items() if manifest.complete or (root / commit_path(*k)).is_file()}
        outcomes, held, shards = [], Held(known), here
        with _Workshop(known, _unique(shards.values())) as folder:
            for commit in self._make(manifest, shards, folder, tick):
                record = shards[commit.subset, commit.shard]
                promised = known.commit(record, commit.shard)
                held.add(commit)
                equal = known.agrees(commit) if promised is None else _agree(promised, commit)
                was = known.damage(record, commit.shard)
                outcomes.append(_outcome(root, folder, record, commit, was, equal))
                for file in commit.files:
                    (folder / file.path).unlink(missing_ok=True)  # a checked shard needs no room
        outcomes = [
            replace(outcome, equal=held.equal(shards[outcome.subset, outcome.shard]))
            if outcome.equal is None
            else outcome
            for outcome in outcomes
        ]
        return Outcome(tuple(outcomes), environment_diff(manifest), len(chosen) - len(here))

    def repair(self, tick: ProgressCallback = ignore) -> Outcome:
        """Make damaged and missing shards again, in place; sound ones are not touched.

        A shard is taken only if it has the bytes that its commit record (or the subset's digest) promises; where the
        manifest promises nothing yet, because the release was never finished, it is taken as it is. Of a part that was
        fetched, what was fetched is repaired, unless other shards are asked for.

        Raises: see `check`.
        """
        root, manifest = load_manifest(self.root)
        wanted, known = self._wanted(manifest), _Known(root, manifest)
        shards = {key: record for key, record in wanted.items() if known.damage(record, key[1]) is not None}
        records = _unique(wanted.values())
        with _Workshop(known, records) as folder:
            with storage_errors(root, "write to"):
                for record in records:
                    known.restore(folder, record)
            outcomes = self._repair(known, shards, folder, tick)
        if not manifest.complete and any(outcome.repaired for outcome in outcomes):
            finish_together(root)
        elif manifest.complete:
            copy_inputs(root, records, release_inputs(root, records, self.backgrounds))
            restore_index(root, manifest, {record.name: read_commits(root, record) for record in manifest.subsets})
        return Outcome(tuple(outcomes), environment_diff(manifest))

    def _wanted(self, manifest: Manifest) -> dict[tuple[str, int], SubsetRecord]:
        """The shards that should be here."""
        chosen = chosen_shards(manifest, self.only, self.episodes)
        fetched = [entry for entry in manifest.lineage if entry["kind"] == "fetch"]
        if self.only or self.episodes or manifest.complete or not fetched:
            return chosen
        root, _ = load_manifest(self.root)
        wanted = {key: record for key, record in chosen.items() if (root / commit_path(*key)).is_file()}
        for entry in fetched:
            span = entry.get("episodes")
            with contextlib.suppress(UnknownNameError, StoreError):  # a repaint has not all, and names some otherwise
                wanted |= chosen_shards(manifest, entry.get("only", ()), tuple(span) if span else None)
        return wanted

    def _repair(self, known: _Known, shards, folder, tick) -> list[ShardOutcome]:
        root, manifest = known.root, known.manifest
        outcomes, held = [], Held(known)
        waiting: list[tuple[SubsetRecord, CommitRecord, str | None]] = []

        def settle(record, commit, was, equal):
            taken = equal is not False
            if taken:
                kept = known.commit(record, commit.shard)
                _move_in(root, folder, kept or restored_commit(root, manifest, commit))
            outcomes.append(_outcome(root, folder, record, commit, was, equal, repaired=taken))

        for commit in self._make(manifest, shards, folder, tick):
            record = shards[commit.subset, commit.shard]
            was, promised = known.damage(record, commit.shard), known.commit(record, commit.shard)
            equal = known.agrees(commit) if promised is None else _agree(promised, commit)
            if equal is None and record.digest is not None:  # the subset's digest decides, once all are there
                held.add(commit)
                waiting.append((record, commit, was))
            else:
                settle(record, commit, was, equal)
        verdicts = {record.name: held.equal(record) for record, _, _ in waiting}
        for record, commit, was in waiting:
            settle(record, commit, was, verdicts[record.name])
        return outcomes

    def remake(self, out: str | Path, tick: ProgressCallback = ignore) -> Outcome:
        """Write a release beside, from the manifest of `root`; run again, it goes on where it stopped.

        Args:
          out: folder of the new release.

        Raises: see `check`.
        """
        root, manifest = load_manifest(self.root)
        out = local_path(out)
        if out.resolve() == root.resolve():
            raise StoreError(f"--out {out} is the release itself; leave --out away to repair it in place")
        shards = chosen_shards(manifest, self.only, self.episodes)
        records = _unique(shards.values())
        fresh = start_release(out, _unfinished(manifest))
        create_groups(out, fresh, records)
        known = _Known(root, manifest)
        for record in records:
            known.take(out, record)
        done = {record.name: read_commits(out, record) for record in records}
        todo = {key: record for key, record in shards.items() if key[1] not in done[key[0]]}
        commits = [commit for name in done for commit in done[name].values() if (name, commit.shard) in shards]
        commits += self._make(manifest, todo, out, tick, copy=True)
        finished = finish_release(out, fresh)
        digests = {record.name: record.digest for record in finished.subsets}
        outcomes = []
        for commit in commits:
            record = shards[commit.subset, commit.shard]
            promised = known.commit(record, commit.shard)
            equal = known.agrees(commit) if promised is None else _agree(promised, commit)
            if equal is None and record.digest and digests[record.name]:
                equal = digests[record.name] == record.digest
            outcomes.append(_outcome(root, out, record, commit, None, equal))
        return Outcome(tuple(outcomes), environment_diff(manifest))

    def _make(self, manifest, shards, folder, tick, copy=False) -> Iterator[CommitRecord]:
        """Make shards in `folder` (with the policies and videos that they come from, if they are to be copied)."""
        check_makeable(manifest)
        root, _ = load_manifest(self.root)
        records = _unique(shards.values())
        inputs = release_inputs(root, records, self.backgrounds)
        if copy:
            copy_inputs(folder, records, inputs)
        for result in run_jobs(
            make_jobs(manifest, shards, FolderSite(folder), inputs, self.device), self.workers, tick
        ):
            yield from result.commits


def _agree(promised: CommitRecord, made: CommitRecord) -> bool:
    """Whether a shard has the bytes that it should have; pictures that only one of both knows do not count."""
    files = [{file.path: file for file in (*commit.pictures, *commit.files)} for commit in (promised, made)]
    start = len(subset_path(made.subset)) + 1
    alone = {path[start:].split("/c/")[0] for path in files[0].keys() ^ files[1].keys()}
    bare = {"files": (), "pictures": (), "painted": True}
    rest = [commit.model_copy(update=bare) for commit in (promised, made)]
    return (
        rest[0].same_data(rest[1])
        and all(name.startswith(SHOWN) for name in alone)  # all kinds of pictures do
        and all(files[0][path] == files[1][path] for path in files[0].keys() & files[1].keys())
    )


def check_makeable(manifest: Manifest) -> None:
    """Raises StoreError for a release whose shards cannot be made from its manifest."""
    if manifest.imported:
        raise StoreError(f"{manifest.name} was imported, so there is nothing to make it from; import it again")
    for entry in manifest.lineage:
        if entry.get("labels"):
            raise StoreError(
                f"{manifest.name} was repainted with {' and '.join(entry['labels'])} from {entry['from']}; "
                "repaint that release again instead of regenerating this one"
            )


def _unfinished(manifest: Manifest) -> Manifest:
    """The manifest as it was before any shard."""
    subsets = tuple(record.model_copy(update={"digest": None}) for record in manifest.subsets)
    begun = {"subsets": subsets, "environments": (environment(),), "complete": False, "digest": None}
    return manifest.model_copy(update=begun)


class Held:
    """Shards made again whose record and index are lost: with the others, they must give their subset's digest."""

    def __init__(self, known: _Known):
        self._known = known
        self._commits: dict[tuple[str, int], CommitRecord] = {}

    def add(self, commit: CommitRecord) -> None:
        self._commits[commit.subset, commit.shard] = commit

    def equal(self, record: SubsetRecord) -> bool | None:
        """Whether the subset has its digest; None where it has none, or another shard is missing too."""
        if record.digest is None:
            return None
        commits = {}
        for shard in range(shard_count(record)):
            commit = self._known.commit(record, shard) or self._commits.get((record.name, shard))
            if commit is None:
                return None
            commits[shard] = commit
        return subset_digest(commits) == record.digest


def _outcome(root, folder, record, commit, was, equal, repaired=False) -> ShardOutcome:
    differences = compare_shards(root, folder, record, commit.shard) if equal is False else None
    return ShardOutcome(
        record.name, commit.shard, commit.episodes, was, equal, repaired, differences or (), differences is not None
    )


# -- files ----------------------------------------------------------------------------------------


class _Known:
    """Which files of a release are what they were: by its index; where that cannot be trusted, those that are JSON."""

    def __init__(self, root: Path, manifest: Manifest):
        self.root, self.manifest, index = root, manifest, trusted_index(root, manifest)
        self._digests = {file.path: file.sha256 for file in index.files} if index else {}

    def commit(self, record: SubsetRecord, shard: int) -> CommitRecord | None:
        """A shard's record, None where it is missing, damaged or not what it was."""
        return read_commit(self.root, record, shard, self._digests)

    def agrees(self, commit: CommitRecord) -> bool | None:
        """Whether a shard made again, whose record is lost, has the bytes that the index lists; None if it lists none.

        Pictures that a light release leaves out are not listed, and do not count.
        """
        made = [file for file in (*commit.files, *commit.pictures) if file.path in self._digests]
        return all(file.sha256 == self._digests[file.path] for file in made) if made else None

    def damage(self, record: SubsetRecord, shard: int) -> str | None:
        """What is wrong with a shard, in words; None where every byte is as committed."""
        return damage(self.root, record, shard, self._digests)

    def sound(self, path: str) -> bool:
        """Whether a file (a path in the release) can be used."""
        try:
            data = (self.root / path).read_bytes()
            parse_json(data)
        except (OSError, ValueError):
            return False
        return path not in self._digests or sha256_bytes(data) == self._digests[path]

    def take(self, folder: Path, record: SubsetRecord) -> None:
        """Use the release's own array metadata in `folder`: codecs of today's code may not be the release's."""
        group = folder / subset_path(record.name)
        for target in sorted(group.rglob(ZARR_JSON), key=lambda file: len(file.parts)):
            path = target.relative_to(folder).as_posix()
            if source := self._source(path):
                copy_file(source, target)
        if not self._source(f"{subset_path(record.name)}/{ZARR_JSON}"):
            (group / CREATED).unlink(missing_ok=True)  # which Zarr would warn of
            zarr.consolidate_metadata(str(group))  # with what its arrays were given
            mark_created(folder, record)

    def restore(self, folder: Path, record: SubsetRecord) -> None:
        """Put back what is missing or damaged, from `folder`, where it was made or taken."""
        for source in sorted((folder / subset_path(record.name)).rglob(ZARR_JSON)):
            path = source.relative_to(folder).as_posix()
            if self.sound(path):
                continue
            if path in self._digests and sha256_file(source) != self._digests[path]:
                raise StoreError(f"{self.root / path} is damaged, and this version makes another; fetch it again")
            copy_file(source, self.root / path)
        mark_created(self.root, record)

    def _source(self, path: str) -> Path | None:
        """The file itself, or one of another subset with its digest."""
        if self.sound(path):
            return self.root / path
        twins = [twin for twin, digest in self._digests.items() if digest == self._digests.get(path)]
        return next((self.root / twin for twin in twins if self.sound(twin)), None)


def _unique(records) -> list[SubsetRecord]:
    return list({record.name: record for record in records}.values())


class _Workshop:
    """A folder beside the data (same file system, so that files can be moved in) where shards are made."""

    def __init__(self, known: _Known, records: Sequence[SubsetRecord]):
        self._known, self._records = known, records

    def __enter__(self) -> Path:
        root = self._known.root
        with contextlib.ExitStack() as stack:
            try:
                remove_partial(root, below=False)  # the workshop of a run that was killed
                folder = stack.enter_context(folder_in_the_making(root, "regenerate"))
            except OSError as error:
                raise StoreError(f"cannot write to {root}: {error.strerror or error}; give --out") from None
            create_groups(folder, self._known.manifest, self._records)
            with storage_errors(self._known.root, "write to"):
                for record in self._records:
                    self._known.take(folder, record)
            self._stack = stack.pop_all()
        return folder

    def __exit__(self, *_):
        self._stack.close()


def _move_in(root: Path, folder: Path, commit: CommitRecord) -> None:
    """Replace a shard's files, then its record: at no moment does a record stand for files that are not there."""
    record = root / commit_path(commit.subset, commit.shard)
    try:
        record.unlink(missing_ok=True)
        for file in commit.files:
            target = root / file.path
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / file.path, target)
        write_json(record, commit)
    except OSError as error:
        raise StoreError(
            f"cannot put shard {commit.shard} of {commit.subset} into {root}: {error.strerror or error}; "
            "make room and run the same command again"
        ) from None
