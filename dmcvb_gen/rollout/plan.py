"""From a recipe to work: checks everything that can be wrong, then lists the jobs; no episode is made here.

A job is one shard of one trajectory: the fixed run of episodes is simulated once and painted for every
setting that shares it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dmcvb_gen.behaviours.policies.actor import Policy, random_policy
from dmcvb_gen.behaviours.policies.bundled import resolve_policies
from dmcvb_gen.behaviours.policies.policy_file import load_policy
from dmcvb_gen.distractors import floor_alpha_for, load_backgrounds
from dmcvb_gen.errors import RecipeError, RenderingError, StoreError, UnknownNameError
from dmcvb_gen.rendering import available_renderers, make_renderer
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.rollout.recipe import Recipe, SubsetRequest, distractor_of, expand, is_maze, select
from dmcvb_gen.store.manifest import Manifest, PolicyRecord, SubsetRecord, environment
from dmcvb_gen.store.schema import EpisodeShape, array_specs
from dmcvb_gen.store.writer import (
    create_subset,
    finish_release,
    read_commits,
    sha256_file,
    shard_count,
    shard_episodes,
    start_release,
)
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from dmcvb_gen.tasks.base import Task


@dataclass(frozen=True)
class Job:
    """One shard of subsets that share a trajectory, to be simulated once and painted for each of them.

    Attributes:
      root: the release's folder.
      subsets: the records of the subsets to write, one or more settings of a task and level.
      shard: index of the shard.
      policies: files of the behaviour policies; empty for uniform random actions.
      seed, names: the streams of the simulation.
      backgrounds, split, device: where pictures come from and where they are painted.
    """

    root: str
    subsets: tuple[SubsetRecord, ...]
    shard: int
    policies: tuple[str, ...]
    seed: int
    names: tuple[str, ...]
    backgrounds: str = "builtin"
    split: str = "train"
    device: str = "cpu"
    episodes_per_goal: int | None = None
    fixed_goals: int | None = None

    @property
    def episodes(self) -> range:
        return range(*shard_episodes(self.subsets[0], self.shard))

    @property
    def frames(self) -> int:
        """Steps to make, counted once for each setting (at most: mazes may end early)."""
        return len(self.episodes) * get_task(self.subsets[0].task).max_steps * len(self.subsets)


@dataclass(frozen=True)
class Plan:
    """Everything a rollout will do.

    Attributes:
      manifest: of the release as it will be.
      jobs: what is still to do, settings that share trajectories together.
      done: committed shards that are there already.
    """

    root: Path
    manifest: Manifest
    jobs: tuple[Job, ...]
    done: int

    @property
    def episodes(self) -> int:
        return sum(len(job.episodes) * len(job.subsets) for job in self.jobs)

    @property
    def steps(self) -> int:
        return sum(job.frames for job in self.jobs)


def release_policies(request: SubsetRequest) -> list[Path]:
    """Policy files of a subset: none for random, else bundled ones or the user's, in their order."""
    return [] if request.level == "random" else resolve_policies(request.task, request.level, request.policy)


def load_policies(task_id: str, files: Sequence[str | Path]) -> list[Policy]:
    """The behaviour policies of a subset (uniform random actions where there is no file)."""
    task = get_task(task_id)
    return [load_policy(path, task) for path in files] if files else [random_policy(task)]


def renderer_for(
    record: SubsetRecord, backgrounds: str, split: str, device: str = "cpu", **overrides: Any
) -> tuple[Renderer, Any]:
    """The renderer of a subset (and its backgrounds, None where the setting shows none)."""
    task, setting = get_task(record.task), distractor_of(record.task, record.setting)
    videos = None if setting.kind == "none" else load_backgrounds(backgrounds, split)
    choice = {"name": record.renderer["name"], "samples": record.renderer.get("samples")} | overrides
    name = choice.pop("name")
    renderer = make_renderer(
        name,
        task,
        record.size,
        backgrounds=videos,
        floor_alpha=floor_alpha_for(task, setting),
        device=device,
        **choice,
    )
    return renderer, videos


def make_plan(
    recipe: Recipe,
    out: str | Path,
    only: Sequence[str] = (),
    device: str = "cpu",
    episodes: tuple[int, int] | None = None,
) -> Plan:
    """Check a recipe and list its jobs.

    Args:
      out: the release's folder; what is committed there already is left out of the jobs.
      only: subset patterns such as "walker-walk/*/static"; a part of the recipe is rolled out.
      episodes: (first, last + 1) of a part of each subset; the shards that hold any of them are rolled out.

    Raises:
      DmcvbError: anything that would fail later, found before any work.
    """
    requests = expand(recipe)
    wanted = set(select([request.name for request in requests], list(only)))
    check_renderer(recipe.renderer.backend)
    root = Path(out)
    records, policy_files, described = [], {}, {}
    for request in requests:
        files = release_policies(request)
        task = get_task(request.task)
        if request.episodes_per_goal:
            fixed_pairs(task.layout, request.episodes // request.episodes_per_goal, recipe.seed)
        policy_files[request.name] = tuple(str(path) for path in files)
        policies = [load_policy(path, task) for path in files]
        setting = distractor_of(request.task, request.setting)
        record = SubsetRecord(
            name=request.name,
            task=request.task,
            level=request.level,
            setting=request.setting,
            episodes=request.episodes,
            episodes_per_shard=request.episodes_per_shard,
            size=recipe.size,
            deterministic=request.deterministic,
            **subset_facts(task, request, recipe.split),
            policies=tuple(
                PolicyRecord(
                    name=path.stem,
                    digest=policy.digest,
                    path=f"policies/{sha256_file(path)[:16]}.safetensors",
                    header=policy.header if isinstance(policy.header, dict) else policy.header.model_dump(mode="json"),
                )
                for path, policy in zip(files, policies, strict=True)
            ),
            renderer={"name": recipe.renderer.backend, "samples": recipe.renderer.samples},
        )
        key = (request.task, setting.name)
        if key not in described:
            renderer, videos = renderer_for(record, recipe.backgrounds, recipe.split, device)
            described[key] = (
                renderer.describe(),
                videos and {"source": recipe.backgrounds, "split": recipe.split, "digest": videos.digest},
            )
            renderer.close()
        renderer_facts, background_facts = described[key]
        records.append(
            record.model_copy(
                update={"renderer": record.renderer | renderer_facts, "backgrounds": background_facts or None}
            )
        )
    manifest = Manifest(
        name=recipe.name,
        version=recipe.version,
        license=recipe.license,
        authors=recipe.authors,
        recipe=recipe.model_dump(mode="json"),
        subsets=tuple(records),
        environments=(environment(),),
    )
    return _plan_jobs(recipe, requests, manifest, root, wanted, policy_files, device, episodes)


def subset_facts(task: Task, request: SubsetRequest, split: str) -> dict[str, Any]:
    """What a `SubsetRecord` says of a subset for readers that know no tasks."""
    per_goal = request.episodes_per_goal
    return {
        "family": "ant-maze" if is_maze(task.id) else "locomotion",
        "views": tuple(task.views),
        "hidden_goal": bool(task.goal_geoms) and request.setting in ("hidden", "fixed"),
        "max_steps": task.max_steps,
        "fixed_goals": per_goal and request.episodes // per_goal,
        "episodes_per_goal": per_goal,
        "split": split,
    }


def _plan_jobs(recipe, requests, manifest, root, wanted, policy_files, device, episodes) -> Plan:
    groups: dict[tuple, list[SubsetRecord]] = {}
    facts: dict[tuple, dict] = {}
    done = 0
    for request, record in zip(requests, manifest.subsets, strict=True):
        if record.name not in wanted:
            continue
        commits = read_commits(root, record) if (root / "manifest.json").exists() else {}
        done += len(commits)
        names = trajectory_names(recipe.trajectories, record)
        for shard in range(shard_count(record)):
            first, last = shard_episodes(record, shard)
            if shard in commits or (episodes and not (first < episodes[1] and episodes[0] < last)):
                continue
            key = (names, shard, record.episodes, record.episodes_per_shard, record.deterministic)
            key += (tuple(policy.digest for policy in record.policies),)
            groups.setdefault(key, []).append(record)
            facts[key] = dict(
                shard=shard,
                policies=policy_files[record.name],
                names=names,
                episodes_per_goal=request.episodes_per_goal,
                fixed_goals=request.episodes_per_goal and record.episodes // request.episodes_per_goal,
            )
    jobs = tuple(
        Job(
            root=str(root),
            subsets=tuple(subsets),
            seed=recipe.seed,
            backgrounds=recipe.backgrounds,
            split=recipe.split,
            device=device,
            **facts[key],
        )
        for key, subsets in groups.items()
    )
    return Plan(root, manifest, jobs, done)


def trajectory_names(trajectories: str, record: SubsetRecord) -> tuple[str, ...]:
    """Names of the random streams of a subset's episodes; subsets of the same names share their trajectories.

    Args:
      trajectories: the recipe's "shared" or "independent".
    """
    shared = trajectories == "shared" and not is_maze(record.task)  # every maze subset has both pictures
    return (record.task, record.level) if shared else (record.task, record.level, record.setting)


def check_renderer(name: str) -> None:
    """Raises an error when a renderer is unknown or cannot start here."""
    available = available_renderers()
    if name not in available:
        raise UnknownNameError("renderer", name, available)
    if available[name]:
        raise RenderingError(f"renderer {name!r} cannot start here: {available[name]}")


def prepare(plan: Plan, expected_bytes: float = 0) -> Plan:
    """Create the release's folder, manifest, policies and empty arrays; a plan whose manifest is the folder's.

    Raises:
      StoreError: the folder holds another recipe's release, cannot be written, or the disk lacks the room.
    """
    root = plan.root
    manifest = start_release(root, plan.manifest)
    free = os.statvfs(root)
    if expected_bytes > free.f_bavail * free.f_frsize:
        raise StoreError(
            f"about {expected_bytes / 1e9:.1f} GB are needed and {free.f_bavail * free.f_frsize / 1e9:.1f} GB are free "
            f"at {root}; make room, choose another --out or fewer --episodes"
        )
    wanted = {subset.name: job for job in plan.jobs for subset in job.subsets}
    try:
        for record in manifest.subsets:
            if record.name not in wanted:
                continue
            for policy, source in zip(record.policies, wanted[record.name].policies, strict=True):
                target = root / policy.path
                if not target.exists():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    temporary = target.with_suffix(".partial")
                    temporary.write_bytes(Path(source).read_bytes())
                    temporary.replace(target)
            task = get_task(record.task)
            create_subset(
                root,
                record,
                array_specs(EpisodeShape.of(task), record.size),
                task.max_steps + 1,
                subset_attributes(record, manifest),
            )
    except OSError as error:
        raise StoreError(f"cannot write to {root}: {error.strerror or error}; choose a writable --out") from None
    return replace(plan, manifest=manifest)


def subset_attributes(record: SubsetRecord, manifest: Manifest) -> dict[str, Any]:
    """What a subset's Zarr group says of itself to someone who has nothing else."""
    task = get_task(record.task)
    return {
        "task": record.task,
        "level": record.level,
        "setting": record.setting,
        "release": f"{manifest.name} {manifest.version}",
        "schema_version": manifest.schema_version,
        "generator": manifest.generator,
        "state_fields": {name: [part.start, part.stop] for name, part in task.state_slices.items()},
        "views": list(task.views),
        "seconds_per_step": 2 * task.control_timestep,
        "policies": [policy.name for policy in record.policies] or ["random"],
        "layout": "row t: observation t, action t, reward of action t; row `length`: the last observation alone",
    }


def finish(plan: Plan) -> Manifest:
    """Write the digests of what is whole into the manifest."""
    return finish_release(plan.root, plan.manifest)


def single_recipe(
    tasks: Sequence[str],
    levels: Sequence[str],
    settings: Sequence[str] | None,
    *,
    name: str,
    episodes: int | None,
    steps: int | None,
    episodes_per_shard: int | None,
    behaviour: str | None,
    deterministic: bool,
    fixed_goals: int | None = None,
    episodes_per_goal: int = 10,
    **fields: Any,
) -> Recipe:
    """The recipe of a command line without --recipe: every task x level x setting.

    Raises:
      RecipeError: --behaviour with several tasks or levels, or with random.
    """
    from dmcvb_gen.rollout.recipe import make_recipe

    if behaviour and (len(tasks) != 1 or len(levels) != 1 or levels[0] == "random"):
        raise RecipeError("--behaviour needs one task and one --level of expert, medium or mixed")
    patterns = []
    for maze in (False, True):
        chosen = [task for task in tasks if is_maze(task) == maze]
        if not chosen:
            continue
        default = (("fixed",) if fixed_goals else ("visible",)) if maze else ("none",)
        pattern: dict[str, Any] = {
            "tasks": chosen,
            "levels": list(levels),
            "settings": list(settings or default),
            "episodes": episodes,
            "steps": steps,
            "episodes_per_shard": episodes_per_shard,
            "deterministic": deterministic,
        }
        if behaviour:
            pattern["policies"] = {levels[0]: behaviour}
        if fixed_goals:
            pattern |= {"fixed_goals": fixed_goals, "episodes_per_goal": episodes_per_goal}
        patterns.append(pattern)
    return make_recipe({"name": name, "subsets": patterns, **fields}, "command line")
