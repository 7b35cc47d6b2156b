"""Pictures for a release that travelled without: its physics states and labels in, the pictures that belong to it out.

A picture is a function of the stored physics state, the labels, the renderer, the size and the view. So a release
may leave its pictures behind (`without_pictures`), or be made without any, and be painted where it arrives. Where the
digests of its pictures are known they are compared: painting gave the same bytes, or it says which shards differ.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import copy_file, write_json
from dmcvb_gen.labels import EXOGENOUS_NAMES, Exogenous
from dmcvb_gen.pool import Tick, ignore, run_all
from dmcvb_gen.release.shards import damage
from dmcvb_gen.rollout.jobs import background_source
from dmcvb_gen.rollout.painting import paint, renderers
from dmcvb_gen.rollout.plan import painting_facts, subset_attributes
from dmcvb_gen.store import open_release
from dmcvb_gen.store.index import INDEX
from dmcvb_gen.store.manifest import (
    MANIFEST,
    Manifest,
    SubsetRecord,
    commit_path,
    environment,
    write_json_atomically,
)
from dmcvb_gen.store.pictures import picture_of
from dmcvb_gen.store.reader import Subset
from dmcvb_gen.store.remote import storage_errors
from dmcvb_gen.store.schema import EpisodeShape, array_specs
from dmcvb_gen.store.shards import chosen_shards
from dmcvb_gen.store.writer import add_arrays, finish_release, only_writer, write_pictures
from dmcvb_gen.tasks import get_task

_ABOUT_THE_PLACE = ("device",)
"""What a painter says of itself that decides no pixel on a CPU."""


@dataclass(frozen=True)
class PaintShard:
    """One shard to be painted in place.

    Attributes:
      subset: read from and written to.
      shard: index.
      backgrounds: "builtin" or the folder of its videos.
      device: where pictures are painted.
    """

    subset: Subset
    shard: int
    backgrounds: str
    device: str = "cpu"


@dataclass(frozen=True)
class Painted:
    """What painting gave.

    Attributes:
      manifest: of the release, with its digests.
      shards: how many were painted.
      known: of these, how many had known digests.
      differing: "<subset> shard <n>" of those whose pictures are not the known ones.
      drift: what about the painter differs from what the manifest says, in words.
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
    workers: int = 1,
    device: str = "cpu",
    backgrounds: str | None = None,
    tick: Tick = ignore,
) -> Painted:
    """Fill in the pictures of a release; what is painted already is left alone, so run again it goes on.

    Args:
      root: the release's folder.
      only: subset patterns, all by default.
      episodes: (first, last + 1) of each subset; the shards that hold any of them are painted.
      workers: processes.
      device: "cpu" or "cuda".
      backgrounds: where the videos are now, where the release has no copies.
      tick: told how many frames were painted since the last call.

    Raises:
      DmcvbError: nothing fits, a shard is damaged, the videos are not those of the manifest, or the disk is full.
    """
    root = Path(root)
    release = open_release(root)
    if any(entry.get("kind") == "import" for entry in release.manifest.lineage):
        raise StoreError(f"{root} was imported and has no physics states to paint from")
    todo = [
        (record, shard)
        for (name, shard), record in chosen_shards(release.manifest, only, episodes).items()
        if name in release.subsets and shard in (commits := release[name].commits) and not commits[shard].painted
    ]
    records = {record.name: record for record, _ in todo}
    sources = {name: background_source(root, record, backgrounds) for name, record in records.items()}
    drift = tuple(dict.fromkeys(text for name, r in records.items() for text in _drift(r, sources[name], device)))
    manifest = _make_room(root, release.manifest, set(records)) if todo else release.manifest
    release = open_release(root)
    work = [PaintShard(release[r.name], shard, sources[r.name], device) for r, shard in todo]
    known, differing = 0, []
    for _, (name, had, same) in run_all(paint_shard, work, workers, tick=tick):
        known += had
        if had and not same:
            differing.append(name)
    if todo:
        manifest = finish_release(root, manifest)
    return Painted(manifest, len(todo), known, tuple(sorted(differing)), drift)


def _drift(record: SubsetRecord, backgrounds: str, device: str) -> Iterator[str]:
    """What the painter here says of itself that is not what the manifest says of it."""
    here = painting_facts(record, backgrounds, device)["renderer"]
    for name in sorted(set(here) | set(record.renderer)):
        if name not in _ABOUT_THE_PLACE and here.get(name) != record.renderer.get(name):
            was, now = record.renderer.get(name, "nothing"), here.get(name, "nothing")
            yield f"{record.renderer['name']}'s {name} is {now} here, {was} in the manifest"


def _make_room(root: Path, manifest: Manifest, names: set[str]) -> Manifest:
    """Say that subsets have pictures, and give them the (empty) arrays for them."""
    subsets = tuple(
        record.model_copy(update={"pixels": True, "digest": None}) if record.name in names else record
        for record in manifest.subsets
    )
    manifest = manifest.model_copy(update={"subsets": subsets, "digest": None})
    with only_writer(root, wait=60), storage_errors(root, "write to"):
        (root / INDEX).unlink(missing_ok=True)  # written again at the end
        for record in subsets:
            if record.name in names:
                specs = array_specs(EpisodeShape.of(get_task(record.task)), record.size)
                add_arrays(root, record, specs, record.max_steps + 1, subset_attributes(record, manifest))
        write_json_atomically(root / MANIFEST, manifest)
    return manifest


def paint_shard(work: PaintShard, tick: Tick = ignore) -> tuple[str, bool, bool]:
    """Paint one shard in place.

    Returns:
      Its name; whether the digests of its pictures were known; whether they have them.

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
    same = all(stored.get(file.path) == file for file in commit.pictures)
    return f"{subset.name} shard {work.shard}", bool(commit.pictures), same


def shard_pictures(
    subset: Subset, episodes: np.ndarray, backgrounds: str, device: str = "cpu", tick: Tick = ignore
) -> Iterator[tuple[str, np.ndarray]]:
    """Picture arrays of episodes, painted from what is stored of them, see `rollout.painting.paint`."""
    record, task = subset.record, get_task(subset.task)
    length = subset.read("length", episodes)
    used = int(length.max()) + 1
    physics = subset.read("physics", episodes)[:, :used]
    exogenous = Exogenous(**{name: subset.read(f"exogenous/{name}", episodes)[:, :used] for name in EXOGENOUS_NAMES})
    renderer, _ = renderers.get(record, backgrounds, device)
    yield from paint(task, renderer, physics, exogenous, length, record.max_steps + 1, tick)


# -- leaving them behind --------------------------------------------------------------------------


def without_pictures(root: str | Path, out: str | Path) -> Manifest:
    """A copy of a release that leaves its pictures behind, but keeps their digests; files are linked where they can be.

    Args:
      out: an empty or new folder.

    Raises:
      StoreError: `out` is in use, or cannot be written.
    """
    release, out = open_release(root), Path(out)
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
            specs = array_specs(EpisodeShape.of(get_task(record.task)), record.size, pixels=False)
            add_arrays(out, record, specs, record.max_steps + 1, subset_attributes(record, manifest))
    write_json_atomically(out / MANIFEST, manifest)
    return finish_release(out, manifest)


def replace_pixels(record: SubsetRecord) -> SubsetRecord:
    """The record of the same subset without pictures."""
    return record.model_copy(update={"pixels": False, "digest": None})


def _strip(root: Path, subset: Subset, out: Path) -> None:
    """Link a subset's files but its pictures, and write records that know the digests of those."""
    folders = {subset.paths[name] for name in subset.arrays if picture_of(name) is not None}
    start = f"{subset.name}.zarr/"
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
