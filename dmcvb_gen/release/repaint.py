"""New pixels for a release: its physics states in, a release with another distractor, size or renderer out.

Nothing is simulated: actions, rewards, states and physics are copied. A subset whose distractor changes draws its
labels from the same random streams as a rollout would, so that with shared trajectories the repainted subset has
the very bytes that rolling it out would have given.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.errors import DmcvbError, RecipeError, StoreError
from dmcvb_gen.labels import EXOGENOUS_NAMES, Exogenous
from dmcvb_gen.names import ANT_MAZE, DistractorSetting, family_of, select
from dmcvb_gen.pool import Tick, ignore, run_all
from dmcvb_gen.release.regenerate import copy_policies
from dmcvb_gen.release.shards import damage, policy_files, recipe_of, stream_names
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.rollout.plan import Job, check_renderer, renderer_for, subset_attributes
from dmcvb_gen.rollout.recipe import check_size, make_recipe
from dmcvb_gen.rollout.worker import exogenous_of, label_arrays, len_rows, paint
from dmcvb_gen.store import open_release
from dmcvb_gen.store.manifest import MANIFEST, CommitRecord, Manifest, SubsetRecord, environment
from dmcvb_gen.store.reader import Subset
from dmcvb_gen.store.schema import ArraySpec, EpisodeShape, array_specs
from dmcvb_gen.store.writer import create_subset, finish_release, read_commits, sha256_file, start_release, write_shard
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import Task

LABELS = {"depth": "float32", "segmentation": "int16"}
"""Pictures beside the colors -> dtype: depth in meters (0: sky), segmentation by geom id (-1: sky)."""
COPIED = ("state", "action", "reward", "discount", "physics")
COPIED_PER_EPISODE = ("length", "terminated", "return", "seed", "behaviour", "goal_pair")
LABEL_FRAMES = 512


@dataclass(frozen=True)
class PaintJob:
    """One shard to paint: read from `source`, written as `record` under `job.root`."""

    source: Subset
    record: SubsetRecord
    job: Job
    keep_labels: bool
    labels: tuple[str, ...]


def label_specs(task: Task, size: int, labels: Sequence[str]) -> tuple[ArraySpec, ...]:
    """Specs of depth and segmentation: "depth", or "depth/<view>" where a task has several views."""
    names = [(label, label if task.views == ("pixels",) else f"{label}/{v}") for label in labels for v in task.views]
    return tuple(ArraySpec(name, LABELS[label], (size, size), ("height", "width")) for label, name in names)


def repaint(
    root: str | Path,
    out: str | Path,
    only: Sequence[str] = (),
    *,
    distractor: str | None = None,
    difficulty: str | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: int | None = None,
    backgrounds: str | None = None,
    split: str | None = None,
    device: str = "cpu",
    labels: Sequence[str] = (),
    name: str | None = None,
    workers: int = 1,
    tick: Tick = ignore,
) -> Manifest:
    """Write a release with new pictures of the episodes of another; run again, it goes on where it stopped.

    Args:
      out: folder of the new release.
      only: subset patterns, all by default.
      distractor, difficulty: the new setting; by default each subset keeps its own (and its labels).
      size: pixels a side; renderer, samples: as for a rollout; each by default as it was.
      backgrounds, split: videos, by default those of the source's recipe.
      labels: "depth" and "segmentation", stored beside the pixels.
      name: of the new release.

    Returns:
      The finished manifest.

    Raises:
      DmcvbError: nothing fits, two subsets would become one, a source shard is damaged, or `out` cannot be used.
    """
    release, out = open_release(root), Path(out)
    if out.resolve() == release.path.resolve():
        raise StoreError(f"--out {out} is the release itself; give another folder")
    unknown = [label for label in labels if label not in LABELS]
    if unknown:
        raise DmcvbError(f"unknown label {unknown[0]!r}; known: {', '.join(LABELS)}")
    if not release.subsets:
        raise StoreError(f"{root} has no committed episodes yet; run the rollout first")
    if any(entry.get("kind") == "import" for entry in release.manifest.lineage):
        raise StoreError(f"{root} was imported and has no physics states to paint from")
    chosen = [release[found] for found in select(list(release.subsets), list(only))]
    recipe, requests = recipe_of(release.manifest)
    source, split = backgrounds or recipe.backgrounds, split or recipe.split
    if size is not None:
        check_size(size)
    pairs: dict[str, tuple[Subset, SubsetRecord, bool]] = {}
    for subset in chosen:
        setting = _new_setting(subset, distractor, difficulty)
        record = _new_record(subset.record, setting, size, renderer, samples, source, split, device)
        if record.name in pairs:
            raise RecipeError(
                f"{pairs[record.name][0].name} and {subset.name} would both become {record.name}; "
                f"choose one with --only, e.g. '*/*/{subset.setting}'"
            )
        pairs[record.name] = subset, record, _same_labels(subset.record, record)
    manifest = _new_manifest(release, pairs, requests, recipe, name, source, split, labels)
    manifest = start_release(out, manifest)
    files = {record.name: policy_files(release.path, record, requests.get(s.name)) for s, record, _ in pairs.values()}
    jobs = []
    for subset, record, keep in pairs.values():
        task = get_task(record.task)
        specs = array_specs(EpisodeShape.of(task), record.size) + label_specs(task, record.size, labels)
        create_subset(out, record, specs, task.max_steps + 1, subset_attributes(record, manifest))
        done = read_commits(out, record)
        for shard in sorted(set(subset.commits) - set(done)):
            names = stream_names(release.manifest, subset.record)
            job = Job(str(out), (record,), shard, files[record.name], recipe.seed, names, source, split, device)
            jobs.append(PaintJob(subset, record, job, keep, tuple(labels)))
    copy_policies(release.path, out, [record for _, record, _ in pairs.values()], [job.job for job in jobs])
    for _ in run_all(paint_shard, jobs, workers, tick=tick):
        pass
    return finish_release(out, manifest)


def _new_setting(subset: Subset, distractor: str | None, difficulty: str | None) -> str:
    if distractor is None and difficulty is None:
        return subset.setting
    if family_of(subset.task) == ANT_MAZE:
        raise RecipeError(f"{subset.name} varies in style, not by distractor; leave --distractor away or use --only")
    old = DistractorSetting.parse(subset.setting)
    given = DistractorSetting.parse(distractor) if distractor else old
    return DistractorSetting(given.kind, difficulty or given.difficulty).name


def _new_record(old, setting, size, renderer, samples, source, split, device) -> SubsetRecord:
    backend = renderer or old.renderer["name"]
    check_renderer(backend)
    if samples is None and backend == old.renderer["name"]:
        samples = old.renderer.get("samples")
    record = old.model_copy(
        update={
            "name": f"{old.name.rsplit('/', 1)[0]}/{setting}",
            "setting": setting,
            "size": size or old.size,
            "split": split,
            "renderer": {"name": backend, "samples": samples},
            "backgrounds": None,
            "digest": None,
        }
    )
    made, videos = renderer_for(record, source, split, device)
    facts = made.describe()
    made.close()
    return record.model_copy(
        update={
            "renderer": record.renderer | facts,
            "backgrounds": {"source": source, "split": split, "digest": videos.digest} if videos else None,
        }
    )


def _same_labels(old: SubsetRecord, new: SubsetRecord) -> bool:
    """Whether the stored labels stand: the setting and the videos are what they were."""
    digests = [(record.backgrounds or {}).get("digest") for record in (old, new)]
    return old.setting == new.setting and digests[0] == digests[1]


def _new_manifest(release, pairs, requests, recipe, name, source, split, labels) -> Manifest:
    old = release.manifest
    patterns = []
    for subset, record, _ in pairs.values():
        request = requests.get(subset.name)
        pattern: dict[str, Any] = {
            "tasks": [record.task],
            "levels": [record.level],
            "settings": [record.setting],
            "episodes": record.episodes,
            "episodes_per_shard": record.episodes_per_shard,
            "deterministic": record.deterministic,
        }
        if request and request.policy:
            pattern["policies"] = {record.level: request.policy}
        if request and request.episodes_per_goal:
            per_goal = request.episodes_per_goal
            pattern |= {"fixed_goals": record.episodes // per_goal, "episodes_per_goal": per_goal, "episodes": None}
        patterns.append(pattern)
    first = next(iter(pairs.values()))[1]
    made = make_recipe(
        recipe.model_dump(mode="json")
        | {
            "name": name or f"{old.name[:80]}-repainted",
            "description": f"Repainted from {old.name} {old.version}. {recipe.description}".strip(),
            "size": first.size,
            "renderer": {"backend": first.renderer["name"], "samples": first.renderer.get("samples")},
            "backgrounds": source,
            "split": split,
            "subsets": patterns,
        },
        "the repainted release's recipe",
    )
    lineage = {
        "kind": "repaint",
        "from": f"{old.name} {old.version}",
        "manifest_sha256": sha256_file(release.path / MANIFEST),
        "subsets": {record.name: subset.name for subset, record, _ in pairs.values()},
        "streams": {record.name: list(stream_names(old, subset.record)) for subset, record, _ in pairs.values()},
        "labels": list(labels),
    }
    return Manifest(
        name=made.name,
        version=made.version,
        license=old.license,
        authors=old.authors,
        recipe=made.model_dump(mode="json"),
        subsets=tuple(record for _, record, _ in pairs.values()),
        environments=(environment(),),
        lineage=(*old.lineage, lineage),
    )


# -- painting -------------------------------------------------------------------------------------


_renderers: dict[str, tuple[Renderer, Any]] = {}


def _renderer(record: SubsetRecord, job: Job) -> tuple[Renderer, Any]:
    """The renderer of a subset, kept between its shards."""
    key = f"{record.model_dump_json(exclude={'name', 'level', 'policies'})} {job.backgrounds} {job.split} {job.device}"
    if key not in _renderers:
        for made, _ in _renderers.values():
            made.close()
        _renderers.clear()
        _renderers[key] = renderer_for(record, job.backgrounds, job.split, job.device)
    return _renderers[key]


def paint_shard(job: PaintJob, tick: Tick = ignore) -> CommitRecord:
    """Paint and commit one shard.

    Raises:
      StoreError: the source shard is damaged, or the target cannot be written.
    """
    source, record, task = job.source, job.record, get_task(job.record.task)
    broken = damage(Path(source.root), source.record, job.job.shard)
    if broken:
        raise StoreError(f"{source.name} shard {job.job.shard}: {broken}; run `dmcvb-gen regenerate {source.root}`")
    episodes = np.asarray(job.job.episodes)
    values = {name: source.read(name, episodes) for name in COPIED + COPIED_PER_EPISODE}
    length, rows = values["length"], task.max_steps + 1

    def arrays() -> Iterator[tuple[str, np.ndarray]]:
        renderer, videos = _renderer(record, job.job)
        if job.keep_labels:
            used = int(length.max()) + 1
            stored = {name: source.read(f"exogenous/{name}", episodes)[:, :used] for name in EXOGENOUS_NAMES}
            exogenous = Exogenous(**stored)
        else:
            exogenous = exogenous_of(job.job, record, episodes, values["physics"], length, videos)
        physics = values["physics"][:, : len_rows(exogenous)]
        yield from paint(task, renderer, physics, exogenous, length, rows, tick)
        yield from label_arrays(exogenous, length, rows)
        yield from values.items()
        for label in job.labels:
            yield from _label_pictures(task, renderer, physics, exogenous, length, rows, label)

    return write_shard(Path(job.job.root), record, job.job.shard, arrays(), length)


def _label_pictures(task, renderer, physics, exogenous, length, rows, label) -> Iterator[tuple[str, np.ndarray]]:
    """(name, (episode, rows, size, size)) of depth or segmentation, a view each."""
    episode, row = np.nonzero(np.arange(physics.shape[1])[None] <= length[:, None])
    for view in task.views:
        out = np.zeros((len(physics), rows, renderer.size, renderer.size), LABELS[label])
        for first in range(0, len(episode), LABEL_FRAMES):
            e, r = episode[first : first + LABEL_FRAMES], row[first : first + LABEL_FRAMES]
            out[e, r] = renderer.render_labels(physics[e, r], exogenous[e, r], [view])[label][:, 0]
        yield (label if task.views == ("pixels",) else f"{label}/{view}"), out
