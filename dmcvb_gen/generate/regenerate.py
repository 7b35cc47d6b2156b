"""Make the shards of a release again from its manifest alone: to check them, to repair them, or into a new folder.

`check` compares bytes and reports how far and why they differ; it writes nothing. `repair` puts files back that are
damaged or missing, if they come out with their recorded digests. `remake` writes a new release.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from dmcvb_gen.dataset.gate import Release, check_videos_shown, read_records
from dmcvb_gen.dataset.manifest import FileRecord, LayerList, ListedLayer, SubsetRecord, canonical_json, list_path
from dmcvb_gen.dataset.writer import (
    begin,
    check_agree,
    finish,
    put,
    put_back,
    write_plain_metadata,
    write_provenance,
    wrong_bytes,
)
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.generate.engine import ShardOutcome
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.inputs import local_inputs, policy_files, video_source
from dmcvb_gen.generate.paint import environment_diff
from dmcvb_gen.generate.resolve import video_files
from dmcvb_gen.generate.shipped import Shipped, record_digests
from dmcvb_gen.generate.works import Work, check_makeable, chosen_subsets, works_of
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.spec import select
from dmcvb_gen.storage.store import Store, open_store


@dataclass(frozen=True)
class Outcome:
    """The result for a release.

    Attributes:
      shards: results of all shards that were made, one a layer.
      environment: versions and devices that differ from those that made the release: name -> (there, here).
      left: shards that are not here and were not checked.
      restored: paths of other files that were put back: lists, policies, videos.
    """

    shards: tuple[ShardOutcome, ...]
    environment: dict[str, tuple[str, str]]
    left: int = 0
    restored: tuple[str, ...] = ()

    @property
    def sound(self) -> bool:
        """True if every shard is now, or was already, what the manifest promises."""
        return all(shard.equal is not False and (shard.was is None or shard.repaired) for shard in self.shards)


@dataclass(frozen=True)
class Regeneration:
    """Choose the shards of a release to make again, and how.

    Attributes:
      place: the release's folder or URL.
      only, episodes: subset patterns and (first, last + 1): the shards that hold any of them; all by default.
      backgrounds: folder of the videos, if they are not in the release.
      workers: processes, or a Ray cluster that sees the same folders.
    """

    place: str | Path
    only: Sequence[str] = ()
    episodes: tuple[int, int] | None = None
    backgrounds: str | None = None
    workers: Workers | None = None

    def check(self, progress: ProgressCallback = ignore) -> Outcome:
        """Make the shards that are here again and compare their bytes; nothing is written.

        Raises:
          DmcvbError: the shards cannot be made here (policy, videos or renderer missing).
        """
        release = Release.open(open_store(self.place))
        works = self._works(release, lambda layer, shard: shard in release.here(layer.name), "check")
        left = sum(not shard.here for shard in release.shards(release.select(self.only), self.episodes))
        return Outcome(self.run(works, progress), environment_diff(release.store), left)

    def repair(self, progress: ProgressCallback = ignore) -> Outcome:
        """Put back damaged and missing files, in place; the others are not touched.

        A file is put back only with the recorded bytes. Of a copy, what was to be copied is repaired, unless other
        shards are asked for.

        Raises: see `check`.
        """
        store = open_store(self.place)
        restored = restore_lists(store)
        release = Release.open(store)
        faulty = self._faults(release, restored)
        works = self._works(release, lambda layer, shard: (layer.name, shard) in faulty, "repair")
        restored += self._restore_inputs(release)
        outcomes = self.run(works, progress)
        if works:
            write_provenance(store, "regenerate")
        if not release.in_the_making:
            write_plain_metadata(Release.open(store))
        check_agree(release.recipes)  # nothing gives a recipe back
        return Outcome(outcomes, environment_diff(store), restored=tuple(restored))

    def remake(self, out: str | Path, progress: ProgressCallback = ignore) -> Outcome:
        """Write a new release from the recipes of this one, see `remake`."""
        store = open_store(self.place)
        release = Release.open(store)
        there = open_store(out)
        if store.place == there.place or store.folder and store.folder.resolve() == Path(there.place).resolve():
            raise StoreError(f"--out {out} is the release itself; remove --out to repair it in place")
        known = Shipped(release.manifest, release.recipes, record_digests(release))  # type: ignore[arg-type]
        made = remake(known, out, store, self, progress)
        return dataclasses.replace(made, environment=environment_diff(store))

    def _works(self, release: Release, wanted, purpose) -> tuple[Work, ...]:
        check_makeable(release.manifest, release.select(self.only))
        check_videos_shown(chosen_subsets(release, self.only), self.backgrounds)
        return works_of(release, self.only, self.episodes, wanted, backgrounds=self.backgrounds, purpose=purpose)

    def run(self, works: Sequence[Work], progress: ProgressCallback) -> tuple[ShardOutcome, ...]:
        """Run works, and tell their outcomes."""
        results = run_works(works, self.workers, progress)
        return tuple(outcome for result in results for outcome in result.outcomes)

    def _faults(self, release: Release, restored: list[str]) -> set[tuple[str, int]]:
        """(layer, shard) of those whose files are not as listed; records are put back, and added to `restored`."""
        asked, found = bool(self.only or self.episodes), set[tuple[str, int]]()
        for shard in release.shards(release.select(self.only), self.episodes):
            promised = release.copy.shards(shard.layer.name) if release.copy else ()
            if not (asked or shard.here or shard.number in promised):
                continue
            damaged = any(wrong_bytes(release.store, file) for file in shard.files)
            if damaged:
                found.add((shard.layer.name, shard.number))
            if wrong_bytes(release.store, shard.record_file) and (shard.here or not damaged):
                put_back(release.store, shard.record_file, canonical_json(shard.record))
                restored.append(shard.record_path)
        return found

    def _restore_inputs(self, release: Release) -> list[str]:
        """Put back policies and videos that are missing or damaged; their paths."""
        records = chosen_subsets(release)
        broken = [f for f in release.inputs_of([record.name for record in records]) if wrong_bytes(release.store, f)]
        if not broken:
            return []
        files = input_files(release.store, records, broken, self.backgrounds)
        for file in broken:
            put_back(release.store, file, files[file.path])
        return [file.path for file in broken]


def remake(
    known: Shipped, out: str | Path, source: Store | None, how: Regeneration, progress: ProgressCallback = ignore
) -> Outcome:
    """Write a release from its recipes, and compare its records; run again, it resumes.

    Args:
      out: folder or URL of the new release, which may have grown or been painted since.
      source: where copies of its policies and videos are, if not in the package.
      how: which shards, and how.

    Raises:
      DmcvbError: the shards cannot be made here, or `out` holds another release.
    """
    store = open_store(out)
    names = select([record.name for record in known.manifest.subsets], list(how.only))
    check_makeable(known.manifest, names)
    for recipe in known.recipes:
        begin(store, recipe, input_files(source or store, recipe.subsets, recipe.inputs, how.backgrounds))
    write_provenance(store, "regenerate")
    target = Release.in_making(store)
    works = works_of(target, names, how.episodes, backgrounds=how.backgrounds)
    fresh = {(outcome.layer, outcome.shard) for outcome in how.run(works, progress)}
    finish(store)
    outcomes = []
    for shard in Release.in_making(store).shards(names, how.episodes):
        name, number, digests = shard.layer.name, shard.number, known.records.get(shard.layer.name, ())
        if number < len(digests):
            equal = shard.record_file.sha256 == digests[number]
            if equal and (name, number) not in fresh:  # it was there before, and its files may have changed since
                equal = not any(wrong_bytes(store, file) for file in shard.files)
            outcomes.append(ShardOutcome.of(shard.layer, number, equal=equal))
    return Outcome(tuple(outcomes), {})


def input_files(
    store: Store, subsets: Iterable[SubsetRecord], inputs: Collection[FileRecord], backgrounds: str | None
) -> dict[str, Path]:
    """Path in the release -> file here, of all policies and videos of subsets.

    Args:
      inputs: those that must be there.
      backgrounds: folder of the videos, if not the release's own copies.

    Raises:
      StoreError: one is neither at the store nor in the package.
    """
    root = local_inputs(store, inputs)
    found: dict[str, Path] = {}
    for record in subsets:
        paths = policy_files(root, record)
        found |= {policy.path: Path(path) for policy, path in zip(record.policies, paths, strict=True) if policy.path}
        found |= video_files(record.backgrounds, video_source(root, record, backgrounds))
    for file in inputs:
        if file.path not in found:
            raise StoreError(f"{file.path} is neither in {store.place} nor given; give --backgrounds FOLDER")
    return found


def restore_lists(store: Store) -> list[str]:
    """Write lists of layers again that are missing or damaged, from the records that are all there; their paths."""
    release, restored = Release.open(store), []
    for name in dict.fromkeys(name for record in chosen_subsets(release) for name in record.layers):
        layer = release.layers[name]
        if not isinstance(layer, ListedLayer):
            continue
        try:
            release.records(layer.name)
        except StoreError as error:
            records = read_records(store, layer)
            text = canonical_json(LayerList(shards=tuple(records[n] for n in range(layer.shards) if n in records)))
            if sha256_bytes(text) != layer.list:
                raise StoreError(f"{error}; its records do not give it either") from None
            store.delete(list_path(layer.list))
            put(store, list_path(layer.list), text)
            restored.append(list_path(layer.list))
    return restored
