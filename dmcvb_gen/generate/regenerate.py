"""Make the shards of a release again from its manifest alone: to check them, to repair them, or into a new folder.

`Regeneration.check` compares digests and reports how far and why they differ. `repair` replaces what is damaged or
missing, with shards that have the very bytes that the manifest promises and no others. `remake` writes a new release.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.dataset.index import INDEX, POLICIES, VIDEOS, ZARR_JSON, restore_index, restored_commit, trusted_index
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    Manifest,
    SubsetRecord,
    environment,
    local_manifest,
    parse_commit,
)
from dmcvb_gen.dataset.pictures import SHOWN, stored_pictures
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.dataset.schema import EpisodeShape, subset_specs
from dmcvb_gen.dataset.shards import ShardKey, chosen_shards, damage, read_commit
from dmcvb_gen.dataset.sharing import link_equal_files
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
from dmcvb_gen.generate.inputs import release_inputs
from dmcvb_gen.generate.jobs import make_jobs
from dmcvb_gen.generate.plan import copy_inputs, create_groups
from dmcvb_gen.generate.shipped import read_shard_digests, shard_digest
from dmcvb_gen.generate.target import Target
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.storage.remote import is_url, local_path, storage_errors
from dmcvb_gen.tasks import get_task


@dataclass(frozen=True)
class ArrayDifference:
    """Largest and mean absolute difference between an array of a shard and the released one."""

    array: str
    largest: float
    mean: float


@dataclass(frozen=True)
class ShardOutcome:
    """The result for one shard.

    Attributes:
      was: fault of the released files, None if there was none.
      equal: True if the new shard has the promised bytes; None if the manifest promises none.
      repaired: True if it was put into the release.
      differences: differences of the values, if the bytes differ; empty if only the compression differs.
      compared: True if both shards could be read.
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
    """The result for a release.

    Attributes:
      shards: results of all shards that were made.
      environment: versions and devices that differ from those that made the release: name -> (there, here).
      left: shards of an incomplete release that are not here and were not checked.
      restored: paths of other files that were put back: metadata, policies, videos.
    """

    shards: tuple[ShardOutcome, ...]
    environment: dict[str, tuple[str, str]]
    left: int = 0
    restored: tuple[str, ...] = ()

    @property
    def sound(self) -> bool:
        """True if every shard is now, or was already, what the manifest promises."""
        return all(shard.equal is not False and (shard.was is None or shard.repaired) for shard in self.shards)


def environment_diff(manifest: Manifest) -> dict[str, tuple[str, str]]:
    """Compare this machine with all environments that made the release: name -> (there, here)."""
    here = environment()
    return {
        name: (" or ".join(sorted({old.get(name, "unknown") for old in manifest.environments})) or "unknown", value)
        for name, value in here.items()
        if any(name in old for old in manifest.environments)
        and value not in {old.get(name) for old in manifest.environments}
    }


def compare_shards(one: Path, other: Path, record: SubsetRecord, shard: int) -> tuple[ArrayDifference, ...] | None:
    """Differences of a shard's values in two releases, None if one of them cannot be read."""
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
    """Choose the shards of a release to make again, and how.

    Attributes:
      root: the release's folder.
      only, episodes: subset patterns and (first, last + 1): the shards that hold any of them; all by default.
      backgrounds: folder of the videos, if they are not in the release.
      workers: processes, or a Ray cluster that sees the same folders.
    """

    root: str | Path
    only: Sequence[str] = ()
    episodes: tuple[int, int] | None = None
    backgrounds: str | None = None
    workers: Workers = 1

    def check(self, progress: ProgressCallback = ignore) -> Outcome:
        """Make shards again and compare their digests with the release, which is not changed.

        If the release is not complete, the shards that are here are made.

        Raises:
          DmcvbError: the shards cannot be made here (policy, videos or renderer missing).
        """
        root, manifest = self._folder()
        chosen, digests = chosen_shards(manifest, self.only, self.episodes), _Digests(root, manifest)
        here = {k: r for k, r in chosen.items() if manifest.complete or (root / commit_path(*k)).is_file()}
        check_makeable(manifest, _unique(here.values()))
        outcomes = []
        with _staging_folder(digests, _unique(here.values())) as folder:
            for record, commit, was, equal in self._made(digests, here, folder, progress):
                outcomes.append(_outcome(root, folder, record, commit, was, equal))
                for file in commit.files:
                    (folder / file.path).unlink(missing_ok=True)  # a checked shard needs no room
        return Outcome(tuple(outcomes), environment_diff(manifest), len(chosen) - len(here))

    def repair(self, progress: ProgressCallback = ignore) -> Outcome:
        """Make damaged and missing shards again, in place; the others are not touched.

        A shard is replaced only by one that has the bytes that its commit record (or the subset's digest) promises. If
        the release was never finished, the manifest promises nothing, and the new shard is taken. If only a part of the
        release is here, only that part and what was fetched are repaired, unless other shards are asked for.

        Raises: see `check`.
        """
        root, manifest = self._folder()
        wanted, digests = self._wanted(manifest), _Digests(root, manifest)
        shards = {key: record for key, record in wanted.items() if digests.damage(record, key[1]) is not None}
        records = [record for record in _unique(wanted.values()) if not record.imported]
        check_makeable(manifest, records or _unique(wanted.values()))
        outcomes, restored = [], []
        with _staging_folder(digests, records) as folder:
            with storage_errors(root, "write to"):
                for record in records:
                    restored += digests.restore(folder, record)
            for record, commit, was, equal in self._made(digests, shards, folder, progress):
                taken = equal is not False
                if taken:
                    kept = digests.promised(record, commit.shard)
                    _replace_shard(root, folder, kept or restored_commit(root, manifest, commit))
                outcomes.append(_outcome(root, folder, record, commit, was, equal, repaired=taken))
        if not manifest.complete and any(outcome.repaired for outcome in outcomes):
            finish_together(root)
        elif manifest.complete:
            inputs = release_inputs(root, records, self.backgrounds)
            with storage_errors(root, "write to"):
                digests.remove_damaged_inputs()
            before = _input_files(root)
            copy_inputs(root, records, inputs)
            restored += sorted(_input_files(root) - before)
            commits = {record.name: read_commits(root, record) for record in manifest.subsets}
            repaired = [commits[found.subset][found.shard] for found in outcomes if found.repaired]
            link_equal_files(root, manifest, commits, {file.path for commit in repaired for file in commit.files})
            restored += [INDEX] * restore_index(root, manifest, commits)
        return Outcome(tuple(outcomes), environment_diff(manifest), restored=tuple(restored))

    def _folder(self) -> tuple[Path, Manifest]:
        """The release's folder and manifest.

        Raises:
          StoreError: it is a file, beside which anything may lie.
        """
        if not is_url(str(self.root)) and Path(self.root).is_file():
            raise StoreError(
                f"{self.root} is a file; give the folder of the release, or make a new one of a manifest alone: "
                f"dmcvb-gen regenerate --manifest {self.root} --out FOLDER"
            )
        return load_manifest(self.root)

    def _wanted(self, manifest: Manifest) -> dict[tuple[str, int], SubsetRecord]:
        """The shards that should be here."""
        chosen = chosen_shards(manifest, self.only, self.episodes)
        if self.only or self.episodes or manifest.complete:
            return chosen
        root, _ = load_manifest(self.root)
        begun = {name: _shards_with_files(root, name) for name, _ in chosen}
        wanted = {key: record for key, record in chosen.items() if key[1] in begun[key[0]]}
        for entry in (entry for entry in manifest.lineage if entry["kind"] == "fetch"):
            span = entry.get("episodes")
            with contextlib.suppress(UnknownNameError, StoreError):  # a repaint has not all, and names some otherwise
                wanted |= chosen_shards(manifest, entry.get("only", ()), tuple(span) if span else None)
        return wanted

    def remake(self, out: str | Path, progress: ProgressCallback = ignore) -> Outcome:
        """Write a new release from the manifest of `root`; run again, it resumes.

        Args:
          out: folder of the new release, which may have grown or been painted since.

        Raises: see `check`; `out` holds another release.
        """
        root, manifest = load_manifest(self.root)
        out = local_path(out)
        if out.resolve() == root.resolve():
            raise StoreError(f"--out {out} is the release itself; remove --out to repair it in place")
        shards = chosen_shards(manifest, self.only, self.episodes)
        records = _unique(shards.values())
        check_makeable(manifest, records)
        _check_out(out, manifest)
        fresh = start_release(out, _unfinished(manifest))
        there = {record.name: record for record in fresh.subsets}
        create_groups(out, fresh, [there[record.name] for record in records])
        digests = _Digests(root, manifest)
        done = {record.name: read_commits(out, record) for record in records}
        for record in records:
            if not done[record.name] and _same_arrays(there[record.name], record):
                digests.copy_metadata(out, record)
        todo = {key: record for key, record in shards.items() if key[1] not in done[key[0]]}
        commits = [commit for name in done for commit in done[name].values() if (name, commit.shard) in shards]
        commits += self._make(manifest, todo, out, progress, copy=True)
        finished = {record.name: record.digest for record in finish_release(out, fresh).subsets}
        outcomes = []
        for commit in commits:
            record = shards[commit.subset, commit.shard]
            equal = digests.equal(record, commit)
            if equal is None and record.digest and finished[record.name]:
                equal = finished[record.name] == record.digest
            outcomes.append(_outcome(root, out, record, commit, None, equal))
        return Outcome(tuple(outcomes), environment_diff(manifest))

    def _made(
        self, digests: _Digests, shards: Mapping[ShardKey, SubsetRecord], folder: Path, progress: ProgressCallback
    ) -> Iterator[tuple[SubsetRecord, CommitRecord, str | None, bool | None]]:
        """Make shards in `folder`: (subset, commit record, what was wrong, whether the bytes are the promised ones).

        Shards whose record and index are lost come last: with the others, they must give their subset's digest.
        """
        made: dict[ShardKey, CommitRecord] = {}
        undecided = []
        for commit in self._make(digests.manifest, shards, folder, progress):
            record = shards[commit.subset, commit.shard]
            made[commit.subset, commit.shard] = commit
            was, equal = digests.damage(record, commit.shard), digests.equal(record, commit)
            if equal is None and record.digest is not None:
                undecided.append((record, commit, was))
            else:
                yield record, commit, was, equal
        verdicts = {record.name: digests.subset_equal(record, made) for record, _, _ in undecided}
        for record, commit, was in undecided:
            yield record, commit, was, verdicts[record.name]

    def _make(self, manifest, shards, folder, progress, copy=False) -> Iterator[CommitRecord]:
        """Make shards in `folder`; `copy` puts the policies and videos that they are made from there, too."""
        root, _ = load_manifest(self.root)
        records = _unique(shards.values())
        check_makeable(manifest, records)
        inputs = release_inputs(root, records, self.backgrounds)
        if copy:
            copy_inputs(folder, records, inputs)
        jobs = make_jobs(manifest, shards, Target.at(folder), inputs)
        for result in run_jobs(jobs, self.workers, progress):
            yield from result.commits


def _agree(promised: CommitRecord, made: CommitRecord) -> bool:
    """Return True if a shard has its promised bytes; pictures that only one of the two records are ignored."""
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


def check_makeable(manifest: Manifest, records: Sequence[SubsetRecord]) -> None:
    """Raises StoreError for subsets whose shards cannot be made from the manifest."""
    for record in records:
        if record.imported:
            raise StoreError(
                f"{record.name} was imported, so there is nothing to make it from; import it again, or choose other "
                "subsets with --only"
            )
        if labels := manifest.labels_of(record.name):
            source = next(entry["from"] for entry in manifest.lineage[::-1] if entry["kind"] == "repaint")
            raise StoreError(
                f"{manifest.name} was repainted with {' and '.join(labels)} from {source}; repaint that release again "
                "instead of regenerating this one"
            )


def _check_out(out: Path, manifest: Manifest) -> None:
    """Refuse a folder that holds any release but the one that is made again, or what that has grown into."""
    if not (out / MANIFEST).exists():
        return
    there = local_manifest(out)
    same = there.recipe == manifest.recipe
    for name in ("additions", "lineage"):
        before, now = getattr(manifest, name), getattr(there, name)
        same &= now[: len(before)] == before
    if not same:
        raise StoreError(
            f"{out} holds {there.name} {there.version}, which was not made from {manifest.name} {manifest.version}; "
            "give another --out"
        )


def _shards_with_files(root: Path, subset: str) -> set[int]:
    """The shards of a subset of which there is a commit record or any file."""
    paths = [*(root / "commits" / subset).glob("*.json"), *(root / subset_path(subset)).glob("**/c/*")]
    return {int(path.stem) for path in paths if path.stem.isdecimal()}


def _same_arrays(one: SubsetRecord, other: SubsetRecord) -> bool:
    """Return True if one metadata of arrays serves both: neither has grown or been painted since."""
    return (one.episodes, one.pixels) == (other.episodes, other.pixels)


def _unfinished(manifest: Manifest) -> Manifest:
    """The manifest as it was before any shard."""
    subsets = tuple(record.model_copy(update={"digest": None}) for record in manifest.subsets)
    begun = {"subsets": subsets, "environments": (environment(),), "complete": False, "digest": None}
    return manifest.model_copy(update=begun)


def _outcome(root, folder, record, commit, was, equal, repaired=False) -> ShardOutcome:
    differences = compare_shards(root, folder, record, commit.shard) if equal is False else None
    return ShardOutcome(
        record.name, commit.shard, commit.episodes, was, equal, repaired, differences or (), differences is not None
    )


# -- files ----------------------------------------------------------------------------------------


class _Digests:
    """The digests that a release promises: by its index or, if that cannot be trusted, by the commit records.

    A manifest of the package has a list of shards' digests instead of both.
    """

    def __init__(self, root: Path, manifest: Manifest):
        self.root, self.manifest, index = root, manifest, trusted_index(root, manifest)
        self._digests = {file.path: file.sha256 for file in index.files} if index else {}
        self._shards = read_shard_digests(root)

    def promised(self, record: SubsetRecord, shard: int) -> CommitRecord | None:
        """A shard's record; None if it is missing, damaged, not what it was, or of pictures that cannot be read."""
        commit = read_commit(self.root, record, shard, self._digests)
        return None if commit and self._wrong_pictures(record, commit) else commit

    def equal(self, record: SubsetRecord, commit: CommitRecord) -> bool | None:
        """True if a regenerated shard has the promised bytes; None if the manifest promises none.

        Without its record, the index decides; it lists no pictures of a light release.
        """
        promised = self.promised(record, commit.shard)
        if promised is not None:
            return _agree(promised, commit)
        if shards := self._shards.get(record.name):
            return shard_digest(commit.files) == shards[commit.shard]
        made = [file for file in (*commit.files, *commit.pictures) if file.path in self._digests]
        return all(file.sha256 == self._digests[file.path] for file in made) if made else None

    def subset_equal(self, record: SubsetRecord, made: Mapping[ShardKey, CommitRecord]) -> bool | None:
        """True if the shards here and the regenerated ones give the subset's digest; None if others are missing."""
        commits = {}
        for shard in range(shard_count(record)):
            commit = self.promised(record, shard) or made.get((record.name, shard))
            if commit is None:
                return None
            commits[shard] = commit
        return subset_digest(commits) == record.digest

    def damage(self, record: SubsetRecord, shard: int) -> str | None:
        """Say what is wrong with a shard; None if every byte is as committed and its pictures can be read."""
        wrong = damage(self.root, record, shard, self._digests)
        commit = None if wrong else read_commit(self.root, record, shard)
        return wrong or (self._wrong_pictures(record, commit) if commit else None)

    def _wrong_pictures(self, record: SubsetRecord, commit: CommitRecord) -> str | None:
        """Which pictures of a shard do not fit their array, e.g. because they have another size."""
        first, folder = commit.episodes[0], subset_path(record.name)
        for name in stored_pictures(record, bool(get_task(record.task).goal_geoms)) if commit.painted else ():
            try:
                group = zarr.open_group(str(self.root / folder), mode="r", use_consolidated=False)
                array, path = find_array(group, name)
            except Exception:  # damaged metadata are put back, they are no fault of the shard
                continue
            if not any(file.path.startswith(f"{folder}/{path}/c/") for file in commit.files):
                continue  # black, or missing, which its digest tells
            try:
                array[first, :1]
            except Exception:  # codecs raise anything
                if self.sound(f"{folder}/{path}/{ZARR_JSON}"):
                    return f"{folder}/{path} has images that do not fit their array"
        return None

    def sound(self, path: str) -> bool:
        """Return True if a file (a path in the release) can be used."""
        try:
            data = (self.root / path).read_bytes()
            parse_json(data)
        except (OSError, ValueError):
            return False
        return path not in self._digests or sha256_bytes(data) == self._digests[path]

    def copy_metadata(self, folder: Path, record: SubsetRecord) -> None:
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

    def restore(self, folder: Path, record: SubsetRecord) -> list[str]:
        """Put back metadata that are missing or damaged from `folder`; their paths in the release."""
        restored = []
        for source in sorted((folder / subset_path(record.name)).rglob(ZARR_JSON)):
            path = source.relative_to(folder).as_posix()
            if self.sound(path):
                continue
            if path in self._digests and sha256_file(source) != self._digests[path]:
                raise StoreError(f"{self.root / path} is damaged, and this version makes another; fetch it again")
            copy_file(source, self.root / path)
            restored.append(path)
        mark_created(self.root, record)
        return restored

    def remove_damaged_inputs(self) -> None:
        """Remove policies and videos that do not have their digests, so that they are copied again."""
        for path in _input_files(self.root) & self._digests.keys():
            if sha256_file(self.root / path) != self._digests[path]:
                (self.root / path).unlink()

    def _source(self, path: str) -> Path | None:
        """The file itself, or one of another subset with its digest."""
        if self.sound(path):
            return self.root / path
        twins = [twin for twin, digest in self._digests.items() if digest == self._digests.get(path)]
        return next((self.root / twin for twin in twins if self.sound(twin)), None)


def _unique(records) -> list[SubsetRecord]:
    return list({record.name: record for record in records}.values())


@contextlib.contextmanager
def _staging_folder(digests: _Digests, records: Sequence[SubsetRecord]) -> Iterator[Path]:
    """A folder inside the release (on the same file system, so that files can be moved) to make shards in."""
    root = digests.root
    with contextlib.ExitStack() as stack:
        try:
            remove_partial(root, below=False)  # the folder of a run that was killed
            folder = stack.enter_context(folder_in_the_making(root, "regenerate"))
        except OSError as error:
            raise StoreError(f"cannot write to {root}: {error.strerror or error}; give --out") from None
        create_groups(folder, digests.manifest, records)
        with storage_errors(root, "write to"):
            for record in records:
                digests.copy_metadata(folder, record)
        yield folder


def _input_files(root: Path) -> set[str]:
    """Paths of the policies and videos that a release has."""
    folders = (root / POLICIES, root / VIDEOS)
    return {path.relative_to(root).as_posix() for folder in folders for path in folder.rglob("*") if path.is_file()}


def _stands_for(record: Path, commit: CommitRecord) -> bool:
    """Return True if a record file promises the bytes of a commit."""
    try:
        return parse_commit(record.read_bytes()).same_data(commit)
    except (OSError, StoreError):
        return False


def _replace_shard(root: Path, folder: Path, commit: CommitRecord) -> None:
    """Replace a shard's files, then its record: at no moment does a record stand for other files than it promises.

    A record of the same bytes stays in its place, so that a repair that is interrupted does not lose it.
    """
    record = root / commit_path(commit.subset, commit.shard)
    try:
        if not _stands_for(record, commit):
            record.unlink(missing_ok=True)
        for file in commit.files:
            target = root / file.path
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / file.path, target)
        write_json(record, commit)
    except OSError as error:
        raise StoreError(
            f"cannot put shard {commit.shard} of {commit.subset} into {root}: {error.strerror or error}; "
            "make room and rerun the same command"
        ) from None
