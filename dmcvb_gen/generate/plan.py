"""Plan a rollout: validate the recipe, list the jobs, create the release, and finish it. No episode is made here."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.append import merged
from dmcvb_gen.dataset.index import (
    INDEX,
    POLICIES,
    ZARR_JSON,
    metadata_files,
    metadata_paths,
    parse_index,
    refuse_altered,
    refuse_altered_folder,
    trusted_index,
)
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    FileRecord,
    Manifest,
    PolicyRecord,
    SubsetRecord,
    environment,
    subset_path,
)
from dmcvb_gen.dataset.schema import EpisodeShape, subset_specs
from dmcvb_gen.dataset.shards import chosen_shards
from dmcvb_gen.dataset.writer import (
    create_subset,
    finish_release,
    finish_together,
    fits,
    mark_created,
    start_release,
)
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, StoreError
from dmcvb_gen.files import (
    copy_file,
    folder_in_the_making,
    json_bytes,
    remove_partial,
    sha256_bytes,
    sha256_file,
    write_bytes,
)
from dmcvb_gen.generate.inputs import BUILTIN, Inputs
from dmcvb_gen.generate.jobs import Job, left_to_do, make_jobs, part_of
from dmcvb_gen.generate.recipe import Recipe, SubsetRequest, expand
from dmcvb_gen.generate.render import check_renderer, renderer_for
from dmcvb_gen.generate.target import CONNECTIONS, Target
from dmcvb_gen.parallel import ignore
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.header import OWN_CODE
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.spec import SPLITS
from dmcvb_gen.storage.base import in_parallel
from dmcvb_gen.storage.remote import local_path, storage_errors
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import as_maze, fixed_pairs
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.text import pluralize, quoted


@dataclass(frozen=True)
class Plan:
    """Everything a rollout will do.

    Attributes:
      target: place of the release.
      manifest: manifest of the release as it will be.
      inputs: of each subset, by name; None if the release's own copies serve.
      jobs: jobs that are still to do; settings that share trajectories are one job.
      done: committed shards that are there already.
      chosen: subset -> episodes that this rollout is about, whether they are there or not.
      growth: gains of the release that is there: "walker-walk/random/none" for a new subset, "walker-walk/random/none
        (40 episodes more)" for one that grows.
    """

    target: Target
    manifest: Manifest
    inputs: Mapping[str, Inputs] | None
    jobs: tuple[Job, ...]
    done: int
    chosen: Mapping[str, int]
    growth: tuple[str, ...] = ()

    @property
    def episodes(self) -> int:
        return sum(len(job.episodes) * len(job.subsets) for job in self.jobs)

    @property
    def steps(self) -> int:
        return sum(job.frames for job in self.jobs)

    @property
    def unit(self) -> str:
        """What a progress bar counts: frames, or steps if no pictures are painted."""
        return "frames" if any(record.pixels for record in self.manifest.subsets) else "steps"


def make_plan(
    recipe: Recipe | None,
    out: str | Path | Target,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    part: tuple[int, int] = (1, 1),
    pixels: bool = True,
) -> Plan:
    """Check a recipe and list its jobs.

    Args:
      recipe: None goes on with the release that is there, from its manifest alone.
      out: the release's folder or target; what is committed there already is left out of the jobs.
      only: subset patterns such as "walker-walk/*/static"; a part of the recipe is rolled out.
      episodes: (first, last + 1) of a part of each subset; the shards that hold any of them are rolled out.
      part: (K, N): of all jobs, done or not, every N-th from the K-th on.
      pixels: paint pictures; without, `generate.paint` can do it later.

    Raises:
      DmcvbError: anything that would fail later, found before any work.
    """
    target = out if isinstance(out, Target) else Target.at(local_path(out))
    there = target.manifest()
    if recipe is not None:
        manifest, inputs = describe(recipe, pixels)
    elif there is not None:
        _check_goes_on(there, target, pixels)
        manifest, inputs = there, None
    else:
        raise StoreError(f"{target.place} holds no release to go on with; give TASKs or --recipe")
    asked = {record.name for record in manifest.subsets}
    grown = manifest if there is None else merged(there, manifest, target.place)
    grown = grown.model_copy(update={"subsets": tuple(record for record in grown.subsets if record.name in asked)})
    shards = chosen_shards(grown, only, episodes)
    records = list({record.name: record for record in shards.values()}.values())
    done = target.commits(records) if there is not None else {}
    _refuse_half_painted(there, records, done, target.place)
    jobs = part_of(make_jobs(grown, shards, target, None if target.uploads else inputs), part)
    left = left_to_do(jobs, done)
    growth = _growth(there, records) if there is not None else ()
    _refuse_labels(there, left, target.place)
    chosen: Counter[str] = Counter()
    for job in jobs:
        chosen.update({record.name: len(job.episodes) for record in job.subsets})
    return Plan(target, manifest, inputs, left, _count(jobs) - _count(left), chosen, growth)


def _growth(there: Manifest, records: Iterable[SubsetRecord]) -> tuple[str, ...]:
    old = {record.name: record.episodes for record in there.subsets}
    more = {record.name: record.episodes - old.get(record.name, 0) for record in records}
    told = {name: f" ({pluralize(count, 'episodes')} more)" if name in old else "" for name, count in more.items()}
    return tuple(name + told[name] for name, count in more.items() if count)


def _refuse_half_painted(
    there: Manifest | None, records: Iterable[SubsetRecord], done: Mapping[str, Mapping[int, CommitRecord]], place: str
) -> None:
    """Raises StoreError for a subset that would grow although some of its shards have no pictures yet."""
    old = {record.name: record.episodes for record in there.subsets} if there else {}
    for record in records:
        lacking = [shard for shard, commit in done.get(record.name, {}).items() if record.pixels and not commit.painted]
        if lacking and record.episodes > old[record.name]:
            raise StoreError(
                f"{record.name} of {place} has images, but {len(lacking)} of its shards have none yet; before it "
                f"grows, paint them: dmcvb-gen paint {quoted(place)} --only {record.name}"
            )


def _refuse_labels(there: Manifest | None, jobs: Iterable[Job], place: str) -> None:
    """Raises StoreError for shards to be made in a subset with labels that a rollout does not store."""
    for record in (record for job in jobs for record in job.subsets):
        if there and (labels := there.labels_of(record.name)):
            raise StoreError(
                f"{record.name} of {place} was repainted with {' and '.join(labels)}, which rollout does not store; "
                "run that repaint again if it was stopped, or grow its source and repaint that into another --out"
            )


def _check_goes_on(there: Manifest, target: Target, pixels: bool) -> None:
    """Raises StoreError if a release that goes on from its manifest cannot be as the options want it."""
    painted = any(record.pixels for record in there.subsets)
    if not pixels and painted:
        raise StoreError(
            f"{target.place} was begun with images and keeps storing them; remove --no-pixels, or give TASKs or "
            "--recipe with another --out"
        )


def _count(jobs: Sequence[Job]) -> int:
    return sum(len(job.subsets) for job in jobs)


# -- what the release will be ---------------------------------------------------------------------


def describe(recipe: Recipe, pixels: bool = True) -> tuple[Manifest, dict[str, Inputs]]:
    """The manifest of a recipe's release, as it is before any shard, and what each subset is made from.

    The manifest names no place of this machine: policies and videos go by where the release keeps its copies.

    Raises:
      DmcvbError: a name, a policy, the videos or the renderer cannot be used.
    """
    check_renderer(recipe.renderer.backend)
    requests = expand(recipe)
    records, inputs = {}, {}
    painted: dict[tuple, dict[str, Any]] = {}
    for request in requests:
        files = request.level != "random" and resolve_policies(request.task, request.level, request.policy) or []
        record = _record(recipe, request, files)
        look = (record.task, record.distractor)
        if look not in painted:
            painted[look] = painting_facts(record, recipe.backgrounds)
        records[request.name] = record.model_copy(update=painted[look] | {"pixels": pixels})
        inputs[request.name] = Inputs(tuple(map(str, files)), recipe.backgrounds)
    manifest = Manifest(
        name=recipe.name,
        version=recipe.version,
        license=recipe.license,
        authors=recipe.authors,
        recipe=_without_local_paths(recipe, requests, records),
        subsets=tuple(records.values()),
        environments=(environment(),),
    )
    return manifest, inputs


def _record(recipe: Recipe, request: SubsetRequest, files: Sequence[Path]) -> SubsetRecord:
    """Return a subset's entry in the manifest, without the facts of its renderer."""
    task = get_task(request.task)
    per_goal = request.episodes_per_goal
    goals = per_goal and request.episodes // per_goal
    if goals:
        fixed_pairs(as_maze(task).layout, goals, recipe.seed)
    return SubsetRecord(
        name=request.name,
        task=request.task,
        level=request.level,
        setting=request.setting,
        episodes=request.episodes,
        episodes_per_shard=request.episodes_per_shard,
        size=recipe.size,
        deterministic=request.deterministic,
        policies=tuple(_policy_record(path, task) for path in files),
        renderer={"name": recipe.renderer.backend, "samples": recipe.renderer.samples},
        family=task.family,
        views=tuple(task.views),
        hidden_goal=bool(task.goal_geoms) and request.spec.hides_goal,
        max_steps=request.max_steps,
        fixed_goals=goals,
        episodes_per_goal=per_goal,
        split=recipe.split,
    )


def _policy_record(path: Path, task: Task) -> PolicyRecord:
    policy = load_policy(path, task)
    header = policy.header.without_local_paths().model_dump(mode="json")
    header["training"].pop("curve", None)  # long, and in the policy's file
    if policy.header.algorithm == OWN_CODE:
        return PolicyRecord(name=str(path), digest=policy.digest, header=header)
    copy = f"{POLICIES}{policy.digest[:16]}.safetensors"
    return PolicyRecord(name=path.stem, digest=policy.digest, path=copy, header=header)


def painting_facts(record: SubsetRecord, backgrounds: str) -> dict[str, Any]:
    """`renderer` and `backgrounds` of a subset's record, from a painter that was started for it.

    Raises:
      DmcvbError: the videos or the renderer cannot be used.
    """
    renderer, videos = renderer_for(record, backgrounds)
    facts = renderer.describe()
    renderer.close()
    shown = None
    if videos:
        source = BUILTIN if backgrounds == BUILTIN else f"backgrounds/{videos.digest[:16]}"
        shown = {"source": source, "split": record.split, "digest": videos.digest}
    return {"renderer": record.renderer | facts, "backgrounds": shown}


def _without_local_paths(
    recipe: Recipe, requests: Sequence[SubsetRequest], records: Mapping[str, SubsetRecord]
) -> dict:
    """The recipe for the manifest: files and folders of this machine go by the release's copies."""
    copies: dict[str, dict[str, None]] = {}
    for request in requests:
        if request.policy:
            found = copies.setdefault(request.policy, {})
            found |= dict.fromkeys(policy.path or policy.name for policy in records[request.name].policies)
    data = recipe.model_dump(mode="json")
    for pattern in data["subsets"]:
        pattern["policies"] = {level: ",".join(copies[given]) for level, given in pattern["policies"].items()}
    shown = {record.backgrounds["source"] for record in records.values() if record.backgrounds}
    data["backgrounds"] = shown.pop() if shown else BUILTIN
    return data


# -- the release's folder or bucket ---------------------------------------------------------------


def prepare(plan: Plan, other_versions: bool = False, shared: bool = False) -> Plan:
    """Create the release: its manifest, policies, videos and empty arrays; a plan whose manifest is the one there.

    Args:
      other_versions: go on although packages have other versions here than where the release was begun.
      shared: other machines write to the folder too, so the manifest is written by the first of all alone.

    Raises:
      StoreError: what is there contradicts this recipe or was begun with other versions, or it cannot be written.
    """
    there = plan.target.manifest()
    if there is not None:
        if not other_versions:
            check_versions(there)
    if plan.target.folder:
        manifest = _prepare_folder(plan, plan.target.folder, there, shared)
    elif there is None:
        manifest = _prepare_bucket(plan, plan.target)
    else:
        manifest = _grow_bucket(plan, plan.target, there)
    return replace(plan, manifest=manifest)


def check_versions(manifest: Manifest) -> None:
    """Raises StoreError if a package has another version here than where a release was begun."""
    begun, here = manifest.environments[0] if manifest.environments else {}, environment()
    for name, version in here.items():
        if name not in ("system", "cpu") and begun.get(name, version) != version:
            raise StoreError(
                f"the release was begun with {name} {begun[name]} and this is {name} {version}, which may change bits; "
                f"install {name} {begun[name]}, or give --other-versions"
            )


def _prepare_folder(plan: Plan, root: Path, there: Manifest | None, shared: bool) -> Manifest:
    kept = there is not None and merged(there, plan.manifest, str(root)) is there
    if there is not None and kept and (shared or _is_done(there, plan)):
        manifest = there
    else:
        manifest = start_release(root, plan.manifest)
    wanted = {record.name for job in plan.jobs for record in job.subsets}
    records = [
        record
        for record in manifest.subsets
        if shared
        or record.name in wanted
        or ((root / subset_path(record.name) / ZARR_JSON).is_file() and not record.imported)  # which may grow
    ]
    if plan.inputs is not None:
        copy_inputs(root, [record for record in records if record.name in plan.inputs], plan.inputs)
    create_groups(root, manifest, records)
    return manifest


def _prepare_bucket(plan: Plan, target: Target) -> Manifest:
    """Put everything but shards into a bucket, the manifest last; the manifest of whoever was first."""
    with _temporary_folder(target) as folder:
        begun = _begun(folder, plan, plan.manifest, plan.manifest.subsets)
        with target.lock() as lock:  # of two who begin at once, the second changes nothing before it has looked
            first = target.manifest()
            if first is None:
                _refuse_other_files(target, begun)
                _send(target, begun, begun, lock.keep)
                lock.check()
                target.storage.write(MANIFEST, json_bytes(plan.manifest))
                return plan.manifest
    return _grow_bucket(plan, target, first)


def _refuse_other_files(target: Target, begun: Iterable[str]) -> None:
    """Raises StoreError if a bucket without a release holds other files than those with which it begins."""
    strange = set(target.storage.list()) - set(begun)
    if strange:
        raise StoreError(
            f"{target.place} holds no release but other files ({min(strange)}); choose an empty place for --out"
        )


def _send(target: Target, made: Mapping[str, Path], names: Iterable[str], tick: Callable = ignore) -> None:
    """Put files that were made here into a bucket, under their names."""
    in_parallel(lambda name: target.storage.write(name, made[name].read_bytes()), names, CONNECTIONS, tick)


@contextlib.contextmanager
def _temporary_folder(target: Target) -> Iterator[Path]:
    """A temporary folder in a target's scratch; a full disk is an error of one line."""
    remove_partial(target.scratch, below=False)  # what a killed rollout left
    with storage_errors(target.scratch, "write to"), folder_in_the_making(target.scratch, "metadata") as folder:
        yield folder


def _begun(root: Path, plan: Plan, manifest: Manifest, records: Sequence[SubsetRecord]) -> dict[str, Path]:
    """Everything of subsets but shards, made in a folder: path in the release -> file."""
    if plan.inputs is not None:
        copy_inputs(root, records, plan.inputs)
    create_groups(root, manifest, records, exact=True)
    made = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    return {name: path for name, path in made.items() if not Path(name).name.startswith(".")}


def _grow_bucket(plan: Plan, target: Target, there: Manifest) -> Manifest:
    """The manifest of a bucket once it holds all that is asked for; what is new is put there first, the manifest last.

    Arrays' metadata are written under the lock, for the manifest that is there then: a grower that comes too late
    changes nothing. The index goes first, so that what a killed grower left is no damage for the next one.

    Raises:
      StoreError: what is there contradicts what is asked for, or its manifest vanished.
    """
    manifest = merged(there, plan.manifest, target.place)
    if manifest is there:
        return there
    old = {record.name: record for record in there.subsets}
    changed = [record for record in manifest.subsets if record != old.get(record.name)]
    with _temporary_folder(target) as root:
        listed = target.storage.list()
        for record in changed:
            if record.name in old:  # its arrays are there, and get room for more episodes
                _bring_metadata(target, record, listed, root)
        begun = _begun(root, plan, manifest, changed)
        _refuse_altered_bucket(target, there, begun)
        metadata = {name for name in begun if name.endswith(f"/{ZARR_JSON}")}
        _send(target, begun, begun.keys() - metadata - listed.keys())
        with target.lock() as lock:
            now = target.manifest()
            if now == there:
                target.storage.remove(INDEX)  # written again when the release is finished
                _send(target, begun, metadata, lock.keep)
                lock.check()
                target.storage.write(MANIFEST, json_bytes(manifest))
                return manifest
    if now is None:
        raise StoreError(f"the manifest of {target.place} vanished; rerun the same command")
    return _grow_bucket(plan, target, now)  # another process changed it meanwhile


def _refuse_altered_bucket(target: Target, there: Manifest, begun: Mapping[str, Path]) -> None:
    """See `refuse_altered`; what is as it is to become was put there when growing was interrupted."""
    text = target.storage.read(INDEX) if there.digest else None
    if text is None:
        return
    listed = metadata_files(parse_index(text, f"{target.place}/{INDEX}"))

    def digest(file: FileRecord) -> str | None:
        data = target.storage.read(file.path)
        return None if data is None else sha256_bytes(data)

    found = dict(zip([file.path for file in listed], in_parallel(digest, listed, CONNECTIONS, ignore), strict=True))
    left = [f for f in listed if f.path not in begun or found[f.path] != sha256_file(begun[f.path])]
    refuse_altered(left, found.get, target.place)


def _bring_metadata(target: Target, record: SubsetRecord, listed: Iterable[str], root: Path) -> None:
    """A subset's zarr.json files as the bucket has them, to the byte."""
    folder = f"{subset_path(record.name)}/"
    names = [name for name in listed if name.startswith(folder) and name.endswith("/zarr.json")]
    for name, text in zip(names, in_parallel(target.storage.read, names, CONNECTIONS, ignore), strict=True):
        write_bytes(root / name, text or b"")
    mark_created(root, record)


def copy_inputs(root: Path, records: Iterable[SubsetRecord], inputs: Mapping[str, Inputs]) -> None:
    """Give a release its copies of the subsets' policies, and of videos that the package does not bring.

    Raises:
      StoreError: the folder cannot be written.
    """
    try:
        for record in records:
            for policy, source in zip(record.policies, inputs[record.name].policies, strict=True):
                if policy.path and not (root / policy.path).exists():
                    copy_file(source, root / policy.path)
            videos = (record.backgrounds or {}).get("source", BUILTIN)
            if videos != BUILTIN and not Path(videos).is_absolute():  # absolute: releases of version 1 hold no copies
                _copy_videos(inputs[record.name].backgrounds, root / videos)
    except OSError as error:
        raise StoreError(f"cannot write to {root}: {error.strerror or error}; choose a writable --out") from None


def _copy_videos(source: str, target: Path) -> None:
    """Copy a source's videos under numbers for names, which keep their order; those for evaluation too."""
    for split in SPLITS:
        try:
            videos = load_backgrounds(source, split).files
        except BackgroundError:
            continue  # the split that pictures show was opened before; another may not be there
        for video, files in enumerate(videos):
            for frame, file in enumerate(files):
                name = f"{video:05d}" if len(files) == 1 else f"{video:05d}/{frame:05d}"
                copy = target / split / f"{name}{file.suffix.lower()}"
                if not copy.exists():
                    copy_file(file, copy)


def create_groups(root: Path, manifest: Manifest, records: Iterable[SubsetRecord], exact: bool = False) -> None:
    """Create the (empty) Zarr groups of subsets, if they are not there already.

    Args:
      exact: see `create_subset`.

    Raises:
      StoreError: the folder cannot be written.
    """
    for record in records:
        specs = subset_specs(EpisodeShape.of(get_task(record.task)), record)
        create_subset(root, record, specs, record.max_steps + 1, subset_attributes(record, manifest), exact)


def subset_attributes(record: SubsetRecord, manifest: Manifest) -> dict[str, Any]:
    """Return the attributes of a subset's Zarr group, for readers that have nothing else."""
    task = get_task(record.task)
    version, generator = manifest.origin(record.name)
    return {
        "task": record.task,
        "level": record.level,
        "setting": record.setting,
        "release": f"{manifest.name} {version}",
        "schema_version": manifest.schema_version,
        "generator": generator,
        "state_fields": {name: [part.start, part.stop] for name, part in task.state_slices.items()},
        "views": list(task.views),
        "seconds_per_step": 2 * task.control_timestep,
        "policies": [policy.name for policy in record.policies] or ["random"],
        "layout": "row t: observation t, action t, reward of action t; row `length`: the last observation alone",
    }


def finish(plan: Plan) -> Manifest:
    """Write the digests of what is whole into the manifest, when all workers are through."""
    stopped = plan.target.uploads and plan.target.storage.size(INDEX) is None  # by a killed grower
    return plan.manifest if _is_done(plan.manifest, plan) and not stopped else finish_target(plan.target)


def _is_done(manifest: Manifest, plan: Plan) -> bool:
    """Return True if a release has its digests and nothing had to be made: its digests are then kept."""
    return manifest.complete and manifest.digest is not None and not plan.jobs


def finish_target(target: Target) -> Manifest:
    """Write a release's digests: of every file, of the subsets that are whole, and of all; those it has, it keeps.

    Raises:
      StoreError: nothing was begun there, a file is missing or not what it was, or the place cannot be written.
    """
    manifest = target.manifest()
    if manifest is None:
        raise StoreError(f"{target.place} holds no release; begin it with --init")
    if target.folder:
        whole = manifest.complete and manifest.digest and trusted_index(target.folder, manifest)
        if not whole:
            return finish_together(target.folder)
        refuse_altered_folder(target.folder, manifest)
        return manifest
    return _finish_bucket(target, manifest)


def _fit_arrays(root: Path, manifest: Manifest) -> list[str]:
    """Take away the room that a killed grower left in arrays; paths of the metadata that were changed."""
    records = [record for record in manifest.subsets if not fits(root, record)]
    for record in records:
        mark_created(root, record)
    create_groups(root, manifest, records, exact=True)
    return [path for record in records for path in metadata_paths(root, record)]


def _finish_bucket(target: Target, there: Manifest) -> Manifest:
    """See `finish_target`. If another process changes the manifest meanwhile, it is read again and nothing is lost."""
    _refuse_altered_bucket(target, there, {})
    if there.complete and there.digest and target.storage.read(INDEX):
        return there
    commits = target.commits(there.subsets)
    with _temporary_folder(target) as mirror:
        shards = {file.path for found in commits.values() for commit in found.values() for file in commit.files}
        small = [path for path in target.storage.list() if path not in shards | {MANIFEST, INDEX}]

        def bring(path: str) -> None:
            data = target.storage.read(path)
            if data is not None:
                write_bytes(mirror / path, data)

        in_parallel(bring, small, CONNECTIONS, ignore)
        mended = _fit_arrays(mirror, there)
        manifest = finish_release(mirror, there, commits)
        with target.lock() as lock:
            now = target.manifest()
            if now == there:
                lock.check()
                for name in (*mended, INDEX, MANIFEST):
                    target.storage.write(name, (mirror / name).read_bytes())
                return manifest
    if now is None:
        raise StoreError(f"the manifest of {target.place} vanished; rerun the same command")
    return _finish_bucket(target, now)
