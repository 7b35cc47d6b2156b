"""Render the images of a release that was stored without pixels.

An image is a function of the stored physics state, the labels, the renderer, the size and the view. So a release can
be copied without its images (`without_pictures`), or be made without any, and be painted where it is used. If the
digests of its images are known, painting compares them and reports the shards that differ.

`RenderOverrides` ask for another size, some of the views or one kind of goal. The release then becomes another one:
its manifest has the new facts, another name, and the old manifest's digest in its provenance.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset import Release, open_release
from dmcvb_gen.dataset.index import INDEX, ZARR_JSON, refuse_altered_folder
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    Manifest,
    SubsetRecord,
    commit_path,
    write_json_atomically,
)
from dmcvb_gen.dataset.pictures import Pictures, picture_of, stored_pictures
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.schema import EpisodeShape, subset_specs
from dmcvb_gen.dataset.shards import ShardKey, chosen_shards, read_commit
from dmcvb_gen.dataset.writer import add_arrays, finish_release, finish_together, write_lock
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import copy_file, link_or_copy, sha256_file, write_json
from dmcvb_gen.generate.executors import run_arriving
from dmcvb_gen.generate.inputs import Inputs, background_source
from dmcvb_gen.generate.jobs import Job, Stored
from dmcvb_gen.generate.plan import painting_facts, subset_attributes
from dmcvb_gen.generate.regenerate import environment_diff
from dmcvb_gen.generate.render import frame_count
from dmcvb_gen.generate.target import Target
from dmcvb_gen.parallel import ProgressCallback, Workers, expect, ignore, open_pool
from dmcvb_gen.rendering.base import check_size
from dmcvb_gen.spec import GOAL_PICTURES, HIDDEN
from dmcvb_gen.storage.remote import local_path, storage_errors
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import quoted

REPAINTED = "-repainted"
"""What the name of a release ends in that is painted otherwise than it was published."""


@dataclass(frozen=True)
class RenderOverrides:
    """Ask for other pictures than the manifest describes; None keeps what the manifest says.

    Attributes:
      size: pixels a side.
      views: of mazes, only these.
      goal: of mazes, only the pictures with the goal ("visible") or without it ("hidden").

    Raises:
      DmcvbError: a size that no renderer takes, no view at all, or an unknown kind of goal.
    """

    size: int | None = None
    views: tuple[str, ...] | None = None
    goal: str | None = None

    def __post_init__(self):
        if self.size is not None:
            check_size(self.size)
        if self.views is not None and not self.views:
            raise DmcvbError("views names no view; leave it out to have them all")
        if self.goal not in (None, *GOAL_PICTURES):
            raise DmcvbError(f"goal {self.goal!r} is unknown; give one of {', '.join(GOAL_PICTURES)}")

    def of(self, record: SubsetRecord) -> SubsetRecord:
        """The record of a subset with these pictures.

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
    """Settings by which pictures are rendered.

    Attributes:
      overrides: pictures other than the manifest's.
      workers: processes, or a Ray cluster that sees the same folder.
      backgrounds: folder of the videos, if the release has no copies.
      progress: called with the number of frames rendered since the last call.
      notify: called with a line for each difference to the environment that made the release, before rendering.
    """

    overrides: RenderOverrides = RenderOverrides()
    workers: Workers = 1
    backgrounds: str | None = None
    progress: ProgressCallback = ignore
    notify: Callable[[str], None] = field(default=ignore)


@dataclass(frozen=True)
class RenderResult:
    """The result of painting.

    Attributes:
      manifest: manifest of the release, with its digests.
      shards: number of painted shards.
      known: number of these whose digests were known.
      differing: "<subset> shard <n>" of those whose pictures do not have the known digests.
      drift: differences between this machine and the one that made the release, in words.
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
    config: RenderConfig | None = None,
) -> RenderResult:
    """Render the missing pictures of a release. Shards that have pictures stay as they are.

    Args:
      root: the release's folder.
      only: subset patterns, all by default.
      episodes: (first, last + 1) of each subset; the shards that hold any of them are painted.
      config: settings of the rendering.

    Raises:
      DmcvbError: nothing matches, a shard is damaged, the videos are not those of the manifest, the release has (or
        another process is rendering) pictures of another size or views, or the disk is full.
    """
    root, config = Path(root), config or RenderConfig()
    open_release(root)  # or says what is wrong with it
    with storage_errors(root, "write to"), write_lock(root, wait=60):
        release = open_release(root)
        shards = [key for key in chosen_shards(release.manifest, only, episodes) if key[0] in release.subsets]
        todo = [key for key in shards if (c := release[key[0]].commits.get(key[1])) and not c.painted]
        session = RenderSession.open(release, {name for name, _ in shards}, config, needed={name for name, _ in todo})
        session.expect([release[name].commits[shard] for name, shard in todo])
    waiting: queue.SimpleQueue = queue.SimpleQueue()
    for key in [*todo, None]:
        waiting.put(key)
    found = tuple(session.paint(waiting))
    unfinished = todo or session.manifest.digest is None  # or a painter of all of it was stopped before the end
    manifest = finish_together(root) if unfinished and not _is_being_made(root, release.manifest) else session.manifest
    return session.report(manifest, found)


def _is_being_made(root: Path, manifest: Manifest) -> bool:
    """Return True if a rollout is not done with a release: it has no digests, and was not made from another one."""
    return not (manifest.complete or manifest.digest or manifest.lineage or (root / INDEX).exists())


@dataclass(frozen=True)
class RenderSession:
    """A release that is ready to be painted: its manifest says which pictures it has, and the arrays exist.

    Attributes:
      root, manifest: folder and manifest of the release.
      backgrounds: videos of each subset to paint: "builtin" or their folder.
      known: subsets whose pictures must have the digests that are known.
      drift: see `RenderResult`.
    """

    root: Path
    manifest: Manifest
    config: RenderConfig
    backgrounds: Mapping[str, str]
    known: frozenset[str]
    drift: tuple[str, ...]

    @classmethod
    def open(
        cls,
        release: Release,
        names: set[str],
        config: RenderConfig,
        needed: set[str],
        painted: Collection[str] = (),
    ) -> RenderSession:
        """Claim the pictures of a release, whose folder must be locked, and create the arrays for them.

        A subset's pictures are decided by the first who paints any of it: then its record says `pixels`, and nobody
        can ask for others.

        Args:
          names: subsets that are asked for.
          needed: those of them that have (or will have) shards to paint.
          painted: those of them that will have shards with pictures, besides the ones that have some here.

        Raises:
          DmcvbError: see `paint_release`.
        """
        root, manifest, overrides = release.path, release.manifest, config.overrides
        old = {record.name: record for record in manifest.subsets}
        asked = [record for name, record in old.items() if name in names and not record.imported]
        if names and not asked:
            raise StoreError(f"{root} was imported and has no physics states to paint from")
        if overrides.goal and not any(get_task(record.task).goal_geoms for record in asked):
            raise DmcvbError("--goal is for ant-maze tasks, and none of them is selected; remove it")
        new = {record.name: overrides.of(record) for record in asked}
        changed = {name for name, record in new.items() if record != old[name]}
        for name in sorted(changed):
            if old[name].pixels or name in painted:
                raise _has_others(old[name])
        sources = {name: background_source(root, new[name], config.backgrounds) for name in sorted(needed)}
        differences = render_differences(manifest, [new[name] for name in sorted(needed)], sources)
        for text in differences:
            config.notify(text)
        known = frozenset(name for name, record in new.items() if record.size == old[name].size) - _resized(manifest)
        if needed:
            manifest = _make_room(root, manifest, {name: new[name] for name in changed | needed}, changed, overrides)
        return cls(root, manifest, config, sources, known, differences)

    def expect(self, commits: Iterable[CommitRecord]) -> None:
        """Tell the progress callback how many frames the shards of some commit records have."""
        records = {record.name: record for record in self.manifest.subsets}
        frames = (frame_count(records[c.subset], c.steps, c.episode_count) for c in commits)
        expect(self.config.progress, sum(frames))

    def paint(self, arriving: queue.SimpleQueue) -> Iterator[tuple[str, bool, bool]]:
        """Paint shards as they come.

        Args:
          arriving: (subset, shard) of committed shards, an exception to raise, or None at the end. Shards that
            another process has painted in the meantime are left alone.

        Yields:
          The shard's name; whether digests of its pictures were known; whether the pictures have them.
        """
        with open_pool(self.config.workers, tick=self.config.progress) as pool:
            for job, result in run_arriving(arriving, pool, self._job):
                yield self._compared(job, result.commits[0])

    def _job(self, key: ShardKey) -> Job | None:
        """The job that paints a shard, None if it is painted."""
        name, shard = key
        record = next(record for record in self.manifest.subsets if record.name == name)
        commit = read_commit(self.root, record, shard)
        if commit is None:
            raise StoreError(
                f"{name} shard {shard} has no commit record; run `dmcvb-gen regenerate {quoted(self.root)}`"
            )
        if commit.painted:
            return None
        source = Stored(Subset(str(self.root), record, {shard: commit}, {}), in_place=True)
        inputs = Inputs(backgrounds=self.backgrounds[name])
        return Job(Target.at(self.root), (record,), shard, inputs, 0, (), source)

    def _compared(self, job: Job, painted: CommitRecord) -> tuple[str, bool, bool]:
        assert job.stored
        subset, record = job.stored.subset, job.subsets[0]
        name = f"{subset.name} shard {job.shard}"
        if subset.name not in self.known:
            return name, False, True
        stored = {file.path: file for file in painted.files}
        pictures = stored_pictures(record, bool(get_task(record.task).goal_geoms))
        folders = {f"{subset.name}.zarr/{subset.paths[picture]}" for picture in pictures}
        known = [file for file in subset.commits[job.shard].pictures if file.path.split("/c/")[0] in folders]
        return name, bool(known), all(stored.get(file.path) == file for file in known)

    def report(self, manifest: Manifest, found: Iterable[tuple[str, bool, bool]]) -> RenderResult:
        """The result, from what `paint` yielded."""
        found = list(found)
        differing = tuple(sorted(name for name, had, same in found if had and not same))
        return RenderResult(manifest, len(found), sum(had for _, had, _ in found), differing, self.drift)


def _resized(manifest: Manifest) -> frozenset[str]:
    """Subsets whose pictures have another size than those whose digests are known."""
    return frozenset(name for entry in manifest.lineage for name in entry.get("resized", ()))


def _has_others(record: SubsetRecord) -> StoreError:
    """The error if a subset has other pictures than are asked for, or another process is painting them."""
    views = "" if record.views == ("pixels",) else f", views {', '.join(record.views)}"
    return StoreError(
        f"{record.name} has images already (or is being painted), and others than asked for: {record.size} pixels a "
        f"side{views}; remove --size, --views and --goal to go on with those, or write a second release with "
        "`dmcvb-gen repaint`"
    )


def render_differences(
    manifest: Manifest, records: Iterable[SubsetRecord], backgrounds: Mapping[str, str]
) -> tuple[str, ...]:
    """List what may change pixels here compared with the release's origin: versions, processor, renderer.

    Args:
      records: records of the subsets to paint.
      backgrounds: videos of each, by name.
    """
    found: dict[str, None] = {}
    records = list(records)
    for record in records:
        here = painting_facts(record, backgrounds[record.name])["renderer"]
        for name in sorted(set(here) | set(record.renderer)):
            was, now = record.renderer.get(name, "nothing"), here.get(name, "nothing")
            if was != now:
                found[f"{record.renderer['name']}'s {name} is {now} here, {was} in the manifest"] = None
    for name, (there, now) in environment_diff(manifest).items() if records else ():
        found[f"{name} is {now} here, {there} where the release was made"] = None
    return tuple(found)


def _make_room(
    root: Path, manifest: Manifest, new: Mapping[str, SubsetRecord], changed: set[str], overrides: RenderOverrides
) -> Manifest:
    """Say that subsets have pictures, and which, and give them the (empty) arrays for them."""
    subsets = tuple(
        new[record.name].model_copy(update={"pixels": True, "digest": None}) if record.name in new else record
        for record in manifest.subsets
    )
    facts: dict[str, Any] = {"subsets": subsets, "digest": None}
    if changed:
        facts |= _derived(root, manifest, subsets, changed, overrides)
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
    root: Path, old: Manifest, subsets: Sequence[SubsetRecord], changed: set[str], overrides: RenderOverrides
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
        "size": overrides.size,
        "views": None if overrides.views is None else list(overrides.views),
        "goal": overrides.goal,
    }
    name = old.name if old.name.endswith(REPAINTED) else f"{old.name[:80]}{REPAINTED}"
    return {"name": name, "lineage": (*old.lineage, entry)}


# -- releases without pictures --------------------------------------------------------------------


def without_pictures(root: str | Path, out: str | Path) -> Manifest:
    """A copy of a release that leaves its pictures behind, but keeps their digests; files are linked if they can be.

    Args:
      out: an empty or new folder.

    Raises:
      StoreError: `out` is in use, or cannot be written; the release was imported, and nobody could paint it again.
    """
    release, out = open_release(root), local_path(out)
    if release.manifest.imported:
        raise StoreError(
            f"{root} was imported and has no physics states, so images that it leaves behind could not be painted "
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
                    link_or_copy(path, out / path.relative_to(release.path))
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
            link_or_copy(root / file.path, out / file.path)
        facts = {"files": tuple(kept), "painted": False, "pictures": tuple(left) or commit.pictures}
        write_json(out / commit_path(subset.name, shard), commit.model_copy(update=facts))
