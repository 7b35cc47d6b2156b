"""Render the images of a release that was stored without pixels.

An image is a function of the stored physics state, the labels, the renderer, the size and the view. So a release can
be copied without its images (`without_pictures`), or be made without any, and be painted where it is used. If the
digests of its images are known, painting compares them and reports the shards that differ.

`RenderOverrides` ask for another size, some of the views or one kind of goal. The release then becomes another one:
its manifest has the new facts, another name, and the old manifest's digest in its provenance.
"""

from __future__ import annotations

import os
import queue
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.dataset import Release, open_release
from dmcvb_gen.dataset.index import INDEX, ZARR_JSON, refuse_altered_folder
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    Manifest,
    SubsetRecord,
    commit_path,
    environment,
    write_json_atomically,
)
from dmcvb_gen.dataset.pictures import Pictures, picture_of, stored_pictures
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.schema import EpisodeShape, subset_specs
from dmcvb_gen.dataset.shards import ShardKey, chosen_shards, damage, read_commit
from dmcvb_gen.dataset.writer import add_arrays, finish_release, finish_together, write_lock, write_pictures
from dmcvb_gen.distractor_state import DISTRACTOR_STATE_NAMES, DistractorState
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import copy_file, sha256_file, write_json
from dmcvb_gen.generate.jobs import background_source
from dmcvb_gen.generate.plan import painting_facts, subset_attributes
from dmcvb_gen.generate.recipe import check_size
from dmcvb_gen.generate.regenerate import environment_diff
from dmcvb_gen.generate.render import frame_count, paint, renderers
from dmcvb_gen.names import GOAL_PICTURES, HIDDEN
from dmcvb_gen.parallel import ProgressCallback, Workers, expect, ignore, open_pool
from dmcvb_gen.storage.remote import local_path, storage_errors
from dmcvb_gen.tasks import get_task

ABOUT_THE_PLACE = ("device",)
"""What a painter says of itself that decides no pixel on a CPU."""
REPAINTED = "-repainted"
"""What the name of a release ends in that is painted otherwise than it was published."""


@dataclass(frozen=True)
class RenderOverrides:
    """How pictures are to be, where not as the manifest says.

    Attributes:
      size: pixels a side.
      views: of mazes, only these.
      goal: of mazes, only the pictures with it ("visible") or without it ("hidden"), and no others.
    """

    size: int | None = None
    views: tuple[str, ...] | None = None
    goal: str | None = None

    def __post_init__(self):
        if self.size is not None:
            check_size(self.size)
        if self.goal not in (None, *GOAL_PICTURES):
            raise DmcvbError(f"goal {self.goal!r} is unknown; give one of {', '.join(GOAL_PICTURES)}")

    def of(self, record: SubsetRecord) -> SubsetRecord:
        """The record of a subset that looks so.

        Raises:
          UnknownNameError: it has no such view.
        """
        facts: dict[str, Any] = {"size": self.size or record.size}
        if self.views is not None:
            asked = Pictures(record.views).select(self.views).views
            facts["views"] = tuple(view for view in record.views if view in asked)
        if self.goal is not None and get_task(record.task).goal_geoms:
            facts |= {"hidden_goal": self.goal == HIDDEN, "only_shown": True}
        return record.model_copy(update=facts)


@dataclass(frozen=True)
class RenderConfig:
    """Who paints, and how.

    Attributes:
      look: of the pictures.
      workers: processes, or a Ray cluster that sees the same folder.
      device: "cpu" or "cuda".
      backgrounds: where the videos are now, where the release has no copies.
      tick: told how many frames were painted since the last call.
      tell: told what is other here than where the release was made, before anything is painted.
    """

    look: RenderOverrides = RenderOverrides()
    workers: Workers = 1
    device: str = "cpu"
    backgrounds: str | None = None
    tick: ProgressCallback = ignore
    tell: Callable[[str], None] = field(default=ignore)


@dataclass(frozen=True)
class PaintShard:
    """One shard to be painted in place.

    Attributes:
      subset: read from and written to.
      shard: index.
      backgrounds: "builtin" or the folder of its videos.
      device: where pictures are painted.
      known: whether its pictures should have the digests that its record knows.
    """

    subset: Subset
    shard: int
    backgrounds: str
    device: str = "cpu"
    known: bool = True


@dataclass(frozen=True)
class RenderResult:
    """What painting gave.

    Attributes:
      manifest: of the release, with its digests.
      shards: how many were painted.
      known: of these, how many had known digests.
      differing: "<subset> shard <n>" of those whose pictures are not the known ones.
      drift: what here differs from where the release was made, in words.
    """

    manifest: Manifest
    shards: int
    known: int
    differing: tuple[str, ...]
    drift: tuple[str, ...]


def paint_release(
    root: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    painter: RenderConfig | None = None,
) -> RenderResult:
    """Fill in the pictures of a release; what is painted already is left alone, so run again it goes on.

    Args:
      root: the release's folder.
      only: subset patterns, all by default.
      episodes: (first, last + 1) of each subset; the shards that hold any of them are painted.
      painter: who paints, and how.

    Raises:
      DmcvbError: nothing fits, a shard is damaged, the videos are not those of the manifest, pictures of another look
        are there already, or the disk is full.
    """
    root, painter = Path(root), painter or RenderConfig()
    open_release(root)  # or says what is wrong with it
    with storage_errors(root, "write to"), write_lock(root, wait=60):
        release = open_release(root)
        shards = [key for key in chosen_shards(release.manifest, only, episodes) if key[0] in release.subsets]
        todo = [key for key in shards if (c := release[key[0]].commits.get(key[1])) and not c.painted]
        studio = RenderSession.open(release, {name for name, _ in shards}, painter, needed={name for name, _ in todo})
        studio.expect([release[name].commits[shard] for name, shard in todo])
    waiting: queue.SimpleQueue = queue.SimpleQueue()
    for key in [*todo, None]:
        waiting.put(key)
    found = tuple(studio.paint(waiting))
    unfinished = todo or studio.manifest.digest is None  # or one who painted it all was stopped before the end
    manifest = finish_together(root) if unfinished else studio.manifest
    return studio.report(manifest, found)


@dataclass(frozen=True)
class RenderSession:
    """A release's folder that is ready to be painted in: its manifest says which pictures, and its arrays are there.

    Attributes:
      root, manifest: of the release.
      backgrounds: of each subset to paint, "builtin" or the folder of its videos.
      known: subsets whose pictures should have the digests that are known.
      drift: see `RenderResult`.
    """

    root: Path
    manifest: Manifest
    painter: RenderConfig
    backgrounds: Mapping[str, str]
    known: frozenset[str]
    drift: tuple[str, ...]

    @classmethod
    def open(
        cls, release: Release, names: set[str], painter: RenderConfig, needed: set[str], painted: set[str] | None = None
    ) -> RenderSession:
        """Make a release ready; its folder must be locked.

        Args:
          names: subsets that are asked for.
          needed: of these, the ones that have (or will have) shards to paint.
          painted: of these, the ones that have (or will have) shards with pictures; by default those here that have.

        Raises:
          DmcvbError: see `paint_release`.
        """
        root, manifest, look = release.path, release.manifest, painter.look
        if manifest.imported:
            raise StoreError(f"{root} was imported and has no physics states to paint from")
        old = {record.name: record for record in manifest.subsets}
        asked = [record for name, record in old.items() if name in names]
        if look.goal and not any(get_task(record.task).goal_geoms for record in asked):
            raise DmcvbError("--goal is for ant-maze tasks, and none of them is asked for; leave it away")
        new = {record.name: look.of(record) for record in asked}
        changed = {name for name, record in new.items() if record != old[name]}
        if painted is None:
            painted = {n for n, s in release.subsets.items() if any(c.painted for c in s.commits.values())}
        for name in sorted(changed & painted):
            raise _has_others(old[name])
        sources = {name: background_source(root, new[name], painter.backgrounds) for name in sorted(needed)}
        told = drift(manifest, [new[name] for name in sorted(needed)], sources, painter.device)
        for text in told:
            painter.tell(text)
        known = frozenset(name for name, record in new.items() if record.size == old[name].size) - _resized(manifest)
        if needed:
            manifest = _make_room(root, manifest, {name: new[name] for name in changed | needed}, changed, look)
        return cls(root, manifest, painter, sources, known, told)

    def expect(self, commits: Iterable[CommitRecord]) -> None:
        """Tell the painter's tick how many frames the shards of some commit records have."""
        records = {record.name: record for record in self.manifest.subsets}
        frames = (frame_count(records[c.subset], c.steps, c.episode_count) for c in commits)
        expect(self.painter.tick, sum(frames))

    def paint(self, arriving: queue.SimpleQueue) -> Iterator[tuple[str, bool, bool]]:
        """Paint shards as they come; what `paint_shard` gives of each.

        Args:
          arriving: (subset, shard) of committed shards, an exception to raise, or None at the end; what somebody else
            has painted meanwhile is left alone.
        """
        with open_pool(self.painter.workers, tick=self.painter.tick) as pool:
            ended, at_work = False, 0
            results: Iterator[tuple[Any, Any]] = iter(())
            while True:
                while not ended:
                    try:
                        key = arriving.get(block=not at_work)  # there is nothing else to wait for
                    except queue.Empty:
                        break
                    if isinstance(key, BaseException):
                        raise key
                    ended = key is None
                    work = None if key is None else self._work(key)
                    if work and not work.subset.commits[work.shard].painted:
                        pool.submit(key, paint_shard, work)
                        at_work += 1
                if ended and not at_work:
                    return
                done = next(results, None)
                if done is None:
                    results = pool.results()
                    continue
                at_work -= 1
                yield done[1]

    def _work(self, key: ShardKey) -> PaintShard:
        name, shard = key
        record = next(record for record in self.manifest.subsets if record.name == name)
        commit = read_commit(self.root, record, shard)
        if commit is None:
            raise StoreError(f"{name} shard {shard} has no commit record; run `dmcvb-gen regenerate {self.root}`")
        subset = Subset(str(self.root), record, {shard: commit}, {})
        return PaintShard(subset, shard, self.backgrounds[name], self.painter.device, name in self.known)

    def report(self, manifest: Manifest, found: Iterable[tuple[str, bool, bool]]) -> RenderResult:
        """What came of it."""
        found = list(found)
        differing = tuple(sorted(name for name, had, same in found if had and not same))
        return RenderResult(manifest, len(found), sum(had for _, had, _ in found), differing, self.drift)


def _resized(manifest: Manifest) -> frozenset[str]:
    """Subsets whose pictures have another size than those whose digests are known."""
    return frozenset(name for entry in manifest.lineage for name in entry.get("resized", ()))


def _has_others(record: SubsetRecord) -> StoreError:
    """The error where a subset has pictures of another look than is asked for."""
    views = "" if record.views == ("pixels",) else f", views {', '.join(record.views)}"
    return StoreError(
        f"{record.name} has pictures already, and others than asked for: {record.size} pixels a side{views}; leave "
        "--size, --views and --goal away to go on with those, or paint others beside with `dmcvb-gen repaint`"
    )


def drift(
    manifest: Manifest, records: Iterable[SubsetRecord], backgrounds: Mapping[str, str], device: str = "cpu"
) -> tuple[str, ...]:
    """What here may paint other bits than where a release was made, in words: versions, processor, the painter.

    Args:
      records: of the subsets to paint.
      backgrounds: of each, by name.
    """
    found: dict[str, None] = {}
    records = list(records)
    for record in records:
        here = painting_facts(record, backgrounds[record.name], device)["renderer"]
        for name in sorted(set(here) | set(record.renderer)):
            was, now = record.renderer.get(name, "nothing"), here.get(name, "nothing")
            if name not in ABOUT_THE_PLACE and was != now:
                found[f"{record.renderer['name']}'s {name} is {now} here, {was} in the manifest"] = None
    for name, (there, now) in environment_diff(manifest).items() if records else ():
        if name not in ABOUT_THE_PLACE:
            found[f"{name} is {now} here, {there} where the release was made"] = None
    return tuple(found)


def _make_room(
    root: Path, manifest: Manifest, new: Mapping[str, SubsetRecord], changed: set[str], look: RenderOverrides
) -> Manifest:
    """Say that subsets have pictures, and which, and give them the (empty) arrays for them."""
    subsets = tuple(
        new[record.name].model_copy(update={"pixels": True, "digest": None}) if record.name in new else record
        for record in manifest.subsets
    )
    facts: dict[str, Any] = {"subsets": subsets, "digest": None}
    if changed:
        facts |= _derived(root, manifest, subsets, changed, look)
    with storage_errors(root, "write to"):
        refuse_altered_folder(root, manifest)
        manifest = manifest.model_copy(update=facts)
        (root / INDEX).unlink(missing_ok=True)  # written again at the end
        for record in subsets:
            if record.name in new:
                specs = subset_specs(EpisodeShape.of(get_task(record.task)), record)
                add_arrays(root, record, specs, record.max_steps + 1, subset_attributes(record, manifest))
        write_json_atomically(root / MANIFEST, manifest)
    return manifest


def _derived(
    root: Path, old: Manifest, subsets: Sequence[SubsetRecord], changed: set[str], look: RenderOverrides
) -> dict[str, Any]:
    """Name and lineage of a release that is painted otherwise than it was."""
    sizes = {record.name: record.size for record in old.subsets}
    published = [entry["manifest_sha256"] for entry in old.lineage if entry.get("kind") == "fetch"]
    entry = {
        "kind": "repaint",
        "from": f"{old.name} {old.version}",
        "manifest_sha256": published[0] if published else sha256_file(root / MANIFEST),
        "subsets": {name: name for name in sorted(changed)},
        "resized": sorted(record.name for record in subsets if record.size != sizes[record.name]),
        "size": look.size,
        "views": None if look.views is None else list(look.views),
        "goal": look.goal,
    }
    name = old.name if old.name.endswith(REPAINTED) else f"{old.name[:80]}{REPAINTED}"
    return {"name": name, "lineage": (*old.lineage, entry)}


def paint_shard(work: PaintShard, tick: ProgressCallback = ignore) -> tuple[str, bool, bool]:
    """Paint one shard in place.

    Returns:
      Its name; whether digests of its pictures were known; whether they have them.

    Raises:
      StoreError: the shard is damaged, or cannot be written.
    """
    subset, record, root = work.subset, work.subset.record, Path(work.subset.root)
    broken = damage(root, record, work.shard)
    if broken:
        raise StoreError(f"{subset.name} shard {work.shard}: {broken}; run `dmcvb-gen regenerate {root}`")
    commit = subset.commits[work.shard]
    pictures = shard_pictures(subset, np.arange(*commit.episodes), work.backgrounds, work.device, tick)
    painted = write_pictures(root, record, commit, pictures, environment(work.device))
    stored = {file.path: file for file in painted.files}
    folders = {f"{subset.name}.zarr/{subset.paths[name]}" for name in _stored(record)}
    known = [file for file in commit.pictures if work.known and file.path.split("/c/")[0] in folders]
    same = all(stored.get(file.path) == file for file in known)
    return f"{subset.name} shard {work.shard}", bool(known), same


def shard_pictures(
    subset: Subset, episodes: np.ndarray, backgrounds: str, device: str = "cpu", tick: ProgressCallback = ignore
) -> Iterator[tuple[str, np.ndarray]]:
    """Picture arrays of episodes, painted from what is stored of them, see `rollout.painting.paint`."""
    record, task = subset.record, get_task(subset.task)
    length = subset.read("length", episodes)
    used = int(length.max()) + 1
    physics = subset.read("physics", episodes)[:, :used]
    exogenous = DistractorState(
        **{name: subset.read(f"exogenous/{name}", episodes)[:, :used] for name in DISTRACTOR_STATE_NAMES}
    )
    renderer, _ = renderers.get(record, backgrounds, device)
    yield from paint(task, renderer, physics, exogenous, length, record.max_steps + 1, tick, _stored(record))


def _stored(record: SubsetRecord) -> tuple[str, ...]:
    return stored_pictures(record, bool(get_task(record.task).goal_geoms))


# -- leaving them behind --------------------------------------------------------------------------


def without_pictures(root: str | Path, out: str | Path) -> Manifest:
    """A copy of a release that leaves its pictures behind, but keeps their digests; files are linked where they can be.

    Args:
      out: an empty or new folder.

    Raises:
      StoreError: `out` is in use, or cannot be written; the release was imported, and nobody could paint it again.
    """
    release, out = open_release(root), local_path(out)
    if release.manifest.imported:
        raise StoreError(
            f"{root} was imported and has no physics states, so pictures that it leaves behind could not be painted "
            "again; publish it with them, without --no-pixels"
        )
    if out.exists() and any(out.iterdir()):
        raise StoreError(f"{out} is not empty; choose an empty or new folder")
    with storage_errors(out, "write to"):
        for subset in release.subsets.values():
            _strip(release.path, subset, out)
        for folder in ("policies", "backgrounds"):
            for path in (release.path / folder).rglob("*"):
                if path.is_file():
                    _link(path, out / path.relative_to(release.path))
    bare = tuple(replace_pixels(record) for record in release.manifest.subsets)
    manifest = release.manifest.model_copy(update={"subsets": bare, "digest": None})
    for record in bare:
        if record.name in release.subsets:
            specs = subset_specs(EpisodeShape.of(get_task(record.task)), record)
            add_arrays(out, record, specs, record.max_steps + 1, subset_attributes(record, manifest))
    write_json_atomically(out / MANIFEST, manifest)
    return finish_release(out, manifest)


def replace_pixels(record: SubsetRecord) -> SubsetRecord:
    """The record of the same subset without pictures."""
    return record.model_copy(update={"pixels": False, "digest": None})


def _strip(root: Path, subset: Subset, out: Path) -> None:
    """Link a subset's files but its pictures, and write records that know the digests of those."""
    start = f"{subset.name}.zarr/"
    folders = {subset.paths[name] for name in subset.arrays if picture_of(name) is not None}
    for path in set(subset.paths.values()) - folders:
        name = f"{start}{path}/{ZARR_JSON}"
        copy_file(root / name, out / name)
    for shard, commit in subset.commits.items():
        left = [file for file in commit.files if file.path.removeprefix(start).split("/c/")[0] in folders]
        kept = [file for file in commit.files if file not in left]
        for file in kept:
            _link(root / file.path, out / file.path)
        facts = {"files": tuple(kept), "painted": False, "pictures": tuple(left) or commit.pictures}
        write_json(out / commit_path(subset.name, shard), commit.model_copy(update=facts))


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another disk, or none that links
        copy_file(source, target)
