"""Write a release with the episodes of another one and new images: another distractor, size, renderer or modality.

Nothing is simulated: the trajectories' files are copied. Labels are copied too if the distractor stays; else they are
drawn from the same random streams as a rollout's. So a repainted subset has the very bytes that rolling it out would
give.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from dmcvb_gen.dataset.gate import Release, read_recipes
from dmcvb_gen.dataset.manifest import VIDEOS, Layer, Resolved, SubsetRecord
from dmcvb_gen.dataset.writer import begin, finish, put, put_record, read_checked, write_provenance, wrong_bytes
from dmcvb_gen.errors import RecipeError, StoreError
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.inputs import background_source, local_inputs, policy_files, whose_videos
from dmcvb_gen.generate.paint import bare, not_imported, recipe_after
from dmcvb_gen.generate.resolve import (
    all_pictures,
    file_records,
    image_layers,
    labels_layer,
    modality_layers,
    rendering_facts,
    video_files,
)
from dmcvb_gen.generate.works import can_be_rendered, chosen_subsets, works_of
from dmcvb_gen.options import refuse
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.spec import DistractorSetting, is_maze
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.text import quoted


@dataclass(frozen=True)
class Repainting:
    """Describe a new release with another one's episodes; None keeps what each subset has.

    Attributes:
      root, out: folders of the source and of the new release.
      only: subset patterns, all by default.
      distractor: the new setting, e.g. "dynamic_hard".
      size: pixels a side.
      renderer, samples: see `rollout`.
      backgrounds: "builtin" or a folder of videos.
      split: "train" or "val": the videos of locomotion, the styles of mazes.
      labels: modalities, stored beside the images: "depth", "segmentation", "parts", "flow" or one's own.
      name: name of the new release.
    """

    root: str | Path
    out: str | Path
    only: Sequence[str] = ()
    distractor: str | None = None
    size: int | None = None
    renderer: str | None = None
    samples: int | None = None
    backgrounds: str | None = None
    split: str | None = None
    labels: Sequence[str] = ()
    name: str | None = None


def repaint(request: Repainting, workers: Workers | None = None, progress: ProgressCallback = ignore) -> Release:
    """Write a release with new images of the episodes of another one. Run again, it resumes.

    Args:
      workers: processes, or a Ray cluster that sees the same folders.
      progress: called with the number of frames rendered since the last call.

    Raises:
      DmcvbError: nothing fits, two subsets would become one, a source shard is damaged, or `out` cannot be used.
    """
    store, release = open_store(local_path(request.out)), _source(request)
    chosen = not_imported(release, chosen_subsets(release, request.only))
    files: dict[str, Path] = {}
    layers: dict[str, Layer] = {}
    records: dict[str, SubsetRecord] = {}
    for source in chosen:
        record, made = _repainted(release, source, request, files)
        if record.name in records:
            raise RecipeError(
                f"two subsets would become {record.name}; choose one with --only, e.g. '*/*/{source.setting}'"
            )
        layers |= {layer.name: layer for layer in made}
        records[record.name] = record.model_copy(update={"layers": tuple(layer.name for layer in made)})
    _check_options_used(request, records.values())
    old = release.manifest
    resolved = recipe_after(
        release,
        layers.values(),
        records.values(),
        name=request.name or f"{old.name[:80]}-repainted",
        description=f"Repainted from {old.name} {old.version}. {old.description}".strip(),
        inputs=file_records(files),
        derived={"kind": "repaint", "name": old.name, "version": old.version, "digest": release.digest},
    )
    _check_out(store, resolved)
    begin(store, resolved, files)
    write_provenance(store, "repaint")
    for shard in release.shards([record.name for record in chosen], images=False):
        if shard.here and layers.get(shard.layer.name) == bare(shard.layer):
            for file in shard.files:
                put(store, file.path, read_checked(release.store, file))
            put_record(store, shard.layer, shard.number, shard.record)
    target = Release.in_making(store)
    for _ in run_works(works_of(target, wanted=functools.partial(can_be_rendered, target)), workers, progress):
        pass
    return finish(store)


def _source(request: Repainting) -> Release:
    """The release to repaint, once all that can be wrong with the request as a whole was looked at."""
    release = Release.open(open_store(request.root))
    if Path(request.out).resolve() == Path(release.place).resolve():
        raise StoreError(f"--out {request.out} is the release itself; give another folder")
    if not release.subsets:
        raise StoreError(f"{request.root} has no finished episodes yet; run the rollout first")
    return release


def _repainted(
    release: Release, old: SubsetRecord, request: Repainting, files: dict[str, Path]
) -> tuple[SubsetRecord, list[Layer]]:
    """The record and layers of a repainted subset; its policies and videos are added to `files`."""
    trajectories = bare(release.layers[old.layers[0]])
    setting = _new_setting(old, request.distractor)
    shown = whose_videos(release, old)
    root = local_inputs(release.store, release.inputs_of([old.name, shown.name]))
    source = request.backgrounds or _own_videos(release, root, shown)
    backend, samples = request.renderer or old.renderer["name"], request.samples
    if samples is None and backend == old.renderer["name"]:
        samples = cast("int | None", old.renderer.get("samples"))
    changes: dict[str, Any] = {
        "name": f"{old.name.rpartition('/')[0]}/{setting}",
        "setting": setting,
        "size": old.size if request.size is None else request.size,
        "split": request.split or old.split,
        "renderer": {"name": backend, "samples": samples},
    }
    record = old.model_copy(update=changes)
    record = record.model_copy(update=rendering_facts(record, source))
    paths = policy_files(root, old)
    files |= {policy.path: Path(path) for policy, path in zip(old.policies, paths, strict=True) if policy.path}
    files |= video_files(record.backgrounds, source)
    labels = labels_layer(record, trajectories)
    images = image_layers(record, labels, all_pictures(record))
    return record, [trajectories, labels, *images, *modality_layers(record, labels, dict.fromkeys(request.labels))]


def _own_videos(release: Release, root: Path, old: SubsetRecord) -> str:
    """The videos that a subset shows, once those of both splits were compared with their digests."""
    source = background_source(root, old)
    for file in release.inputs_of([old.name]):
        if file.path.startswith(VIDEOS) and (wrong := wrong_bytes(release.store, file)):
            raise StoreError(f"{release.place}/{file.path} {wrong}; run `dmcvb-gen regenerate {quoted(release.place)}`")
    return source


def _new_setting(old: SubsetRecord, distractor: str | None) -> str:
    if distractor is None:
        return old.setting
    if is_maze(old.task):
        raise RecipeError(f"{old.name} varies in style, not by distractor; remove --distractor or use --only")
    return DistractorSetting.parse(distractor).name


def _check_options_used(request: Repainting, records: Iterable[SubsetRecord]) -> None:
    """Refuse options of videos if none of the new subsets shows any."""
    videos = any(record.distractor.shows_videos for record in records)
    heard = {"backgrounds": videos, "split": videos or any(is_maze(record.task) for record in records)}
    idle = {name: getattr(request, name) and not has_effect for name, has_effect in heard.items()}
    refuse("these subsets show no videos", **idle)


def _check_out(store: Store, resolved: Resolved) -> None:
    """Refuse a folder that holds any release but this very repaint, begun before."""
    there = read_recipes(store)
    if there and all(recipe.sha256 != resolved.sha256 for recipe in there):
        raise StoreError(
            f"{store.place} holds {there[0].name} {there[0].version}, not this repaint; give another --out"
        )
