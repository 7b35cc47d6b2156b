"""Shards of a release that exists: which are damaged, and the jobs that make them again from the manifest alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dmcvb_gen.behaviours.policies.bundled import resolve_policies
from dmcvb_gen.behaviours.policies.policy_file import load_policy
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import DmcvbError, RecipeError, StoreError
from dmcvb_gen.rollout.plan import Job, trajectory_names
from dmcvb_gen.rollout.recipe import Recipe, SubsetRequest, expand, make_recipe, select
from dmcvb_gen.store.manifest import CommitRecord, Manifest, SubsetRecord, parse_commit
from dmcvb_gen.store.writer import commit_path, sha256_file, shard_count, shard_episodes
from dmcvb_gen.tasks import get_task

ShardKey = tuple[str, int]
"""(subset, shard)."""


def chosen_shards(
    manifest: Manifest, only: Sequence[str] = (), episodes: tuple[int, int] | None = None
) -> dict[ShardKey, SubsetRecord]:
    """The shards that hold any of the chosen episodes.

    Args:
      only: subset patterns, all subsets by default.
      episodes: (first, last + 1), all by default.

    Raises:
      UnknownNameError: a pattern that fits nothing.
      StoreError: no subset has such episodes.
    """
    names = set(select([record.name for record in manifest.subsets], list(only)))
    chosen = {}
    for record in manifest.subsets:
        for shard in range(shard_count(record)) if record.name in names else ():
            first, last = shard_episodes(record, shard)
            if episodes is None or (first < episodes[1] and episodes[0] < last):
                chosen[record.name, shard] = record
    if not chosen:
        most = max(record.episodes for record in manifest.subsets)
        raise StoreError(f"no subset has episodes {episodes[0]}:{episodes[1]}; the longest has 0:{most}")
    return chosen


def read_commit(root: Path, record: SubsetRecord, shard: int) -> CommitRecord | None:
    """The shard's commit record, None where it is missing, unreadable or another shard's."""
    path = root / commit_path(record.name, shard)
    try:
        commit = parse_commit(path.read_bytes(), str(path))
    except (OSError, StoreError):
        return None
    mine = (commit.subset, commit.shard, commit.episodes) == (record.name, shard, shard_episodes(record, shard))
    return commit if mine else None


def damage(root: Path, record: SubsetRecord, shard: int) -> str | None:
    """What is wrong with a shard's files, in words; None where every byte is as committed."""
    commit = read_commit(root, record, shard)
    if commit is None:
        return "has no commit record"
    for file in commit.files:
        path = root / file.path
        if not path.is_file():
            return f"{file.path} is missing"
        if path.stat().st_size != file.bytes:
            return f"{file.path} has {path.stat().st_size} bytes instead of {file.bytes}"
        if sha256_file(path) != file.sha256:
            return f"{file.path} does not have its digest"
    return None


def stream_names(manifest: Manifest, record: SubsetRecord) -> tuple[str, ...]:
    """Names of the random streams of a subset's episodes (a repainted one keeps those of its source)."""
    for entry in reversed(manifest.lineage):
        if record.name in entry.get("streams", {}):
            return tuple(entry["streams"][record.name])
    return trajectory_names(manifest.recipe.get("trajectories", "shared"), record)


def recipe_of(manifest: Manifest) -> tuple[Recipe, dict[str, SubsetRequest]]:
    """The manifest's recipe, and its subsets by name."""
    recipe = make_recipe(manifest.recipe, "the manifest's recipe")
    return recipe, {request.name: request for request in expand(recipe)}


def policy_files(root: Path, record: SubsetRecord, request: SubsetRequest | None) -> tuple[str, ...]:
    """Files of a subset's policies: the release's own copies, else the bundled ones, by digest.

    Raises:
      StoreError: neither is there.
    """
    task, found = get_task(record.task), []
    for policy in record.policies:
        candidates = [root / policy.path] if policy.path else []
        try:
            candidates += resolve_policies(record.task, record.level, request.policy if request else None)
        except DmcvbError:
            pass  # the release's own copy is enough
        for path in candidates:
            try:
                if Path(path).is_file() and load_policy(path, task).digest == policy.digest:
                    found.append(str(path))
                    break
            except DmcvbError:
                continue
        else:
            raise StoreError(
                f"policy {policy.name} of {record.name} (digest {policy.digest[:12]}) is neither in the release nor "
                f"bundled with this dmcvb-gen; put its file at {policy.path}"
            )
    return tuple(found)


def background_source(record: SubsetRecord, moved: str | None, fallback: tuple[str, str]) -> tuple[str, str]:
    """(source, split) of a subset's backgrounds, checked against the manifest's digest.

    Args:
      moved: where the videos are now, instead of where the manifest says.
      fallback: of a subset that shows none.

    Raises:
      StoreError: they are other videos.
    """
    if record.backgrounds is None:
        return fallback
    source, split = moved or record.backgrounds["source"], record.backgrounds["split"]
    if load_backgrounds(source, split).digest != record.backgrounds["digest"]:
        raise StoreError(
            f"backgrounds {source!r} are not those that {record.name} was painted with; give --backgrounds FOLDER"
        )
    return source, split


def make_jobs(
    manifest: Manifest,
    root: Path,
    shards: Mapping[ShardKey, SubsetRecord],
    target: Path,
    *,
    backgrounds: str | None = None,
    device: str | None = None,
) -> tuple[Job, ...]:
    """The jobs that make shards again; subsets that share trajectories are simulated once.

    Args:
      root: the release, for its policies.
      target: folder that the jobs write to.
      backgrounds: where the videos are now, if they moved.
      device: paint there instead of where the manifest says.

    Raises:
      DmcvbError: policies or backgrounds are not there, or not those of the manifest.
    """
    for entry in manifest.lineage:
        if entry.get("kind") == "import":
            raise StoreError(f"{manifest.name} was imported, so there is nothing to make it from; import it again")
        if entry.get("labels"):
            raise StoreError(
                f"{manifest.name} was repainted with {' and '.join(entry['labels'])} from {entry['from']}; "
                "repaint that release again instead of regenerating this one"
            )
    recipe, requests = recipe_of(manifest)
    files = {record.name: policy_files(root, record, requests.get(record.name)) for record in shards.values()}
    sources = {
        record.name: background_source(record, backgrounds, (recipe.backgrounds, recipe.split))
        for record in shards.values()
    }
    groups: dict[tuple, list[SubsetRecord]] = {}
    for (name, shard), record in shards.items():
        where = device or record.renderer.get("device") or "cpu"
        names = stream_names(manifest, record)
        key = (names, shard, record.episodes, record.episodes_per_shard, record.deterministic, files[name])
        groups.setdefault((*key, sources[name], where), []).append(record)
    jobs = []
    for (names, shard, episodes, _, _, paths, (source, split), where), records in groups.items():
        request = requests.get(records[0].name)
        per_goal = request.episodes_per_goal if request else None
        if records[0].setting == "fixed" and not per_goal:
            raise RecipeError(f"the manifest's recipe does not say the goals of {records[0].name}")
        jobs.append(
            Job(
                root=str(target),
                subsets=tuple(records),
                shard=shard,
                policies=paths,
                seed=recipe.seed,
                names=names,
                backgrounds=source,
                split=split,
                device=where,
                episodes_per_goal=per_goal,
                fixed_goals=per_goal and episodes // per_goal,
            )
        )
    return tuple(jobs)
