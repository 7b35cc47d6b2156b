"""Write a release with the episodes of another one and new pictures: another distractor, size or renderer.

Nothing is simulated: actions, rewards, states and physics are copied. If the distractor or split of a subset changes,
its labels are drawn from the same random streams as a rollout's. With shared trajectories, the repainted subset then
has the very bytes that rolling it out would give.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset import Release, open_release
from dmcvb_gen.dataset.manifest import MANIFEST, Manifest, SubsetRecord, VersionEntry, environment
from dmcvb_gen.dataset.pictures import view_arrays
from dmcvb_gen.dataset.reader import Subset, load_manifest
from dmcvb_gen.dataset.schema import ArraySpec, EpisodeShape, subset_specs
from dmcvb_gen.dataset.writer import create_subset, finish_together, read_commits, start_release
from dmcvb_gen.errors import RecipeError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.inputs import BUILTIN, Inputs, policy_files, video_source
from dmcvb_gen.generate.jobs import Stored, make_jobs, recipe_of, stream_names
from dmcvb_gen.generate.modalities import get_modality
from dmcvb_gen.generate.plan import copy_inputs, painting_facts, subset_attributes
from dmcvb_gen.generate.recipe import Recipe, make_recipe
from dmcvb_gen.generate.render import (
    check_renderer,
)
from dmcvb_gen.generate.target import Target
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.rendering.base import check_size
from dmcvb_gen.spec import DistractorSetting, is_maze, select
from dmcvb_gen.storage.remote import local_path
from dmcvb_gen.tasks import get_task


@dataclass(frozen=True)
class Repainting:
    """Describe a new release with another one's episodes; None keeps what each subset has.

    Attributes:
      root, out: folders of the source and of the new release.
      only: subset patterns, all by default.
      distractor, difficulty: the new setting.
      size: pixels a side.
      renderer, samples: see `rollout`.
      backgrounds: "builtin" or a folder of videos.
      split: "train" or "val": the videos of locomotion, the styles of mazes.
      labels: "depth", "segmentation" and "flow", stored beside the pixels.
      name: name of the new release.
    """

    root: str | Path
    out: str | Path
    only: Sequence[str] = ()
    distractor: str | None = None
    difficulty: str | None = None
    size: int | None = None
    renderer: str | None = None
    samples: int | None = None
    backgrounds: str | None = None
    split: str | None = None
    labels: Sequence[str] = ()
    name: str | None = None


@dataclass(frozen=True)
class Repainted:
    """A subset to read from, the record of the one to write, and its policies and videos."""

    source: Subset
    record: SubsetRecord
    inputs: Inputs

    @property
    def keeps_labels(self) -> bool:
        """True if the distractor, the videos and the styles are those of the source."""
        old, new = self.source.record, self.record
        videos = [(record.backgrounds or {}).get("digest") for record in (old, new)]
        styles = [record.split if record.goal_mode is not None else "" for record in (old, new)]
        return old.setting == new.setting and videos[0] == videos[1] and styles[0] == styles[1]


def label_specs(views: Sequence[str], size: int, labels: Sequence[str]) -> tuple[ArraySpec, ...]:
    """Specs of modalities of a subset's views: "depth", or "depth/<view>" if its task has several."""
    specs = []
    for modality in map(get_modality, labels):
        shape, dims = (size, size, *modality.shape), ("height", "width", "direction")
        specs += [
            ArraySpec(name, modality.dtype, shape, dims[: len(shape)]) for name in view_arrays(modality.name, views)
        ]
    return tuple(specs)


def repaint(request: Repainting, workers: Workers = 1, progress: ProgressCallback = ignore) -> Manifest:
    """Write a release with new pictures of the episodes of another one. Run again, it resumes.

    Args:
      workers: processes, or a Ray cluster that sees the same folders.
      progress: called with the number of frames rendered since the last call.

    Returns:
      The finished manifest.

    Raises:
      DmcvbError: nothing fits, two subsets would become one, a source shard is damaged, or `out` cannot be used.
    """
    out = local_path(request.out)
    release, target = _source(request), Target.at(out)
    pairs: dict[str, Repainted] = {}
    names = select(list(release.subsets), list(request.only))
    for name in [name for name in names if not release[name].record.imported]:
        pair = _pair(release, release[name], request)
        taken = pairs.setdefault(pair.record.name, pair)
        if taken is not pair:
            raise RecipeError(
                f"{taken.source.name} and {name} would both become {pair.record.name}; "
                f"choose one with --only, e.g. '*/*/{pair.source.setting}'"
            )
    if not pairs:
        raise StoreError(f"{request.root} was imported and has no physics states to paint from")
    _check_options_used(request, [pair.record for pair in pairs.values()])
    new = _new_manifest(release, pairs, request)
    _check_out(out, new, request.name)
    manifest = start_release(out, new)
    todo: dict[tuple[str, int], SubsetRecord] = {}
    for pair in pairs.values():
        record, shape = pair.record, EpisodeShape.of(get_task(pair.record.task))
        specs = subset_specs(shape, record) + label_specs(record.views, record.size, request.labels)
        create_subset(out, record, specs, record.max_steps + 1, subset_attributes(record, manifest))
        missing = sorted(set(pair.source.commits) - set(read_commits(out, record)))
        todo |= {(record.name, shard): record for shard in missing}
    inputs = {name: pair.inputs for name, pair in pairs.items()}
    copy_inputs(out, [pair.record for pair in pairs.values()], inputs)
    sources = {name: Stored(pair.source, new_labels=not pair.keeps_labels) for name, pair in pairs.items()}
    jobs = make_jobs(manifest, todo, target, inputs, sources, tuple(request.labels))
    for _ in run_jobs(jobs, workers, progress):
        pass
    return finish_together(out)


def _check_options_used(request: Repainting, records: Sequence[SubsetRecord]) -> None:
    """Refuse options of distractors that none of the new subsets has."""
    varied = any(record.distractor.kind != "none" for record in records)
    videos = any(record.distractor.shows_videos for record in records)
    heard = {
        "difficulty": (varied, "have no distractors"),
        "backgrounds": (videos, "show no videos"),
        "split": (videos or any(is_maze(record.task) for record in records), "show no videos"),
    }
    for name, (has_effect, why) in heard.items():
        if getattr(request, name) and not has_effect:
            raise RecipeError(f"--{name} has no effect here: these subsets {why}; remove it")
    if request.difficulty and "_" in (request.distractor or ""):
        raise RecipeError(
            f"{request.distractor} names its strength itself: remove --difficulty, or give the kind alone"
        )


def _check_out(out: Path, new: Manifest, name: str | None) -> None:
    """Refuse a folder that holds any release but this very repaint, begun before."""
    if not (out / MANIFEST).exists():
        return
    _, there = load_manifest(out)
    if list(there.lineage) != json.loads(new.model_dump_json())["lineage"]:
        raise StoreError(f"{out} holds {there.name} {there.version}, which is not this repaint; give another --out")
    if name and there.name != name:
        raise StoreError(f"{out} holds this repaint by the name {there.name}; remove --name, or give another --out")


def _source(request: Repainting) -> Release:
    """The release to repaint, once all that can be wrong with the request as a whole has been looked at."""
    release = open_release(request.root)
    if Path(request.out).resolve() == release.path.resolve():
        raise StoreError(f"--out {request.out} is the release itself; give another folder")
    for label in request.labels:
        get_modality(label)
    if not release.subsets:
        raise StoreError(f"{request.root} has no committed episodes yet; run the rollout first")
    if request.size is not None:
        check_size(request.size)
    if request.renderer:
        check_renderer(request.renderer)
    return release


def _pair(release: Release, subset: Subset, request: Repainting) -> Repainted:
    old = subset.record
    setting = _new_setting(subset, request.distractor, request.difficulty)
    backend, samples = request.renderer or old.renderer["name"], request.samples
    if samples is None and backend == old.renderer["name"]:
        samples = old.renderer.get("samples")
    record = old.model_copy(
        update={
            "name": f"{old.name.rsplit('/', 1)[0]}/{setting}",
            "setting": setting,
            "size": request.size or old.size,
            "split": request.split or old.split,
            "renderer": {"name": backend, "samples": samples},
            "backgrounds": None,
            "pixels": True,
            "digest": None,
        }
    )
    source = request.backgrounds or _old_backgrounds(release, old)
    record = record.model_copy(update=painting_facts(record, source))
    return Repainted(subset, record, Inputs(policy_files(release.path, old), source))


def _old_backgrounds(release: Release, old: SubsetRecord) -> str:
    """Find the videos of a release: the subset's own, or those of its recipe."""
    recipe = {"source": release.manifest.recipe_of(old.name).get("backgrounds", BUILTIN)}
    return video_source(release.path, old.model_copy(update={"backgrounds": old.backgrounds or recipe}))


def _new_setting(subset: Subset, distractor: str | None, difficulty: str | None) -> str:
    if distractor is None and difficulty is None:
        return subset.setting
    if is_maze(subset.task):
        raise RecipeError(f"{subset.name} varies in style, not by distractor; remove --distractor or use --only")
    old = DistractorSetting.parse(subset.setting)
    given = DistractorSetting.parse(distractor) if distractor else old
    return DistractorSetting(given.kind, difficulty or given.difficulty).name


def _new_manifest(release: Release, pairs: Mapping[str, Repainted], request: Repainting) -> Manifest:
    """The manifest of the new release; subsets that another recipe added there are additions here, too."""
    old = release.manifest
    groups: list[tuple[Recipe, list[SubsetRecord]]] = []
    for pair in pairs.values():
        recipe = recipe_of(old, pair.source.name)
        group = next((records for known, records in groups if known == recipe), None)
        if group is None:
            groups.append((recipe, group := []))
        group.append(pair.record)
    first, *others = [(_new_recipe(old, recipe, records, request), records) for recipe, records in groups]
    lineage = {
        "kind": "repaint",
        "from": f"{old.name} {old.version}",
        "manifest_sha256": sha256_file(release.path / MANIFEST),
        "subsets": {name: pair.source.name for name, pair in pairs.items()},
        "streams": {name: list(stream_names(old, pair.source.record)) for name, pair in pairs.items()},
        "new_labels": [name for name, pair in pairs.items() if not pair.keeps_labels],
        "labels": list(request.labels),
    }
    manifest = Manifest(
        name=first[0].name,
        version=first[0].version,
        license=old.license,
        authors=old.authors,
        recipe=first[0].model_dump(mode="json"),
        subsets=tuple(pair.record for pair in pairs.values()),
        environments=(environment(),),
        lineage=(*old.lineage, lineage),
    )
    additions = tuple(
        VersionEntry(
            version=manifest.version,
            recipe=recipe.model_dump(mode="json"),
            generator=manifest.generator,
            subsets={record.name: (0, record.episodes) for record in records},
        )
        for recipe, records in others
    )
    return manifest.model_copy(update={"additions": additions})


def _new_recipe(old: Manifest, recipe: Recipe, records: Sequence[SubsetRecord], request: Repainting) -> Recipe:
    """The recipe that asks for repainted subsets of one recipe."""
    first, splits = records[0], {record.split for record in records}
    shown = {record.backgrounds["source"] for record in records if record.backgrounds}
    return make_recipe(
        recipe.model_dump(mode="json")
        | {
            "name": request.name or f"{old.name[:80]}-repainted",
            "description": f"Repainted from {old.name} {old.version}. {recipe.description}".strip(),
            "size": first.size,
            "renderer": {"backend": first.renderer["name"], "samples": first.renderer.get("samples")},
            "backgrounds": shown.pop() if shown else BUILTIN,
            "split": splits.pop(),
            "subsets": [_pattern(record) for record in records],
        },
        "the repainted release's recipe",
    )


def _pattern(record: SubsetRecord) -> dict[str, Any]:
    """The recipe's entry for one subset."""
    pattern: dict[str, Any] = {
        "tasks": [record.task],
        "levels": [record.level],
        "settings": [record.setting],
        "episodes": record.episodes,
        "episodes_per_shard": record.episodes_per_shard,
        "deterministic": record.deterministic,
        "max_steps": record.max_steps,
    }
    if record.fixed_goals:
        goals = {"fixed_goals": record.fixed_goals, "episodes_per_goal": record.episodes_per_goal}
        pattern |= goals | {"episodes": None}
    return pattern
