"""Jobs: the shards of a release that are to be made, each with all that decides its bytes.

A job is one shard of one trajectory: the fixed run of episodes is simulated once and rendered for every subset that
shares it. It depends on the manifest, its policies and its videos alone, so a rollout, a repair and a worker on
another machine make the same bytes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.manifest import Manifest, SubsetRecord
from dmcvb_gen.dataset.shards import ShardKey
from dmcvb_gen.dataset.writer import shard_episodes
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, DmcvbError, RecipeError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.generate.recipe import Recipe, make_recipe
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.spec import FIXED, is_maze

if TYPE_CHECKING:
    from dmcvb_gen.generate.site import Site

BUILTIN = "builtin"
"""The videos that the package brings."""


@dataclass(frozen=True)
class Inputs:
    """The files that a subset is made from, on this machine.

    Attributes:
      policies: files of the behaviour policies, in the record's order; none for uniform random actions.
      backgrounds: "builtin", or the folder of the videos.
    """

    policies: tuple[str, ...] = ()
    backgrounds: str = BUILTIN


@dataclass(frozen=True)
class Stored:
    """The source of a job whose states are read instead of simulated.

    Attributes:
      subset: the subset to read from.
      new_labels: draw the distractors from the episodes' streams instead of using the stored ones.
      in_place: add pictures to this very subset's shard; everything else stays as it is.
    """

    subset: Subset
    new_labels: bool = False
    in_place: bool = False


@dataclass(frozen=True)
class Job:
    """One shard of subsets that share a trajectory: its states are simulated (or read) once and rendered for each.

    Attributes:
      site: the release to write to.
      subsets: the records of the subsets to write, one or more of a task and level.
      shard: index of the shard.
      inputs: policies and videos; None: the release's own copies.
      seed, names: the random streams of the episodes.
      device: renders the pictures, "cpu" or "cuda".
      stored: where states are read from; None: they are simulated.
      labels: "depth" and "segmentation", stored beside the pixels.
    """

    site: Site
    subsets: tuple[SubsetRecord, ...]
    shard: int
    inputs: Inputs | None
    seed: int
    names: tuple[str, ...]
    device: str = "cpu"
    stored: Stored | None = None
    labels: tuple[str, ...] = ()

    @property
    def in_place(self) -> bool:
        """Whether pictures are added to a shard that is there."""
        return self.stored is not None and self.stored.in_place

    @property
    def episodes(self) -> range:
        return range(*shard_episodes(self.subsets[0], self.shard))

    @property
    def frames(self) -> int:
        """Steps to make, counted once for each setting (at most: mazes may end early)."""
        return len(self.episodes) * self.subsets[0].max_steps * len(self.subsets)


def make_jobs(
    manifest: Manifest,
    shards: Mapping[ShardKey, SubsetRecord],
    site: Site,
    inputs: Mapping[str, Inputs] | None = None,
    device: str | None = None,
    stored: Mapping[str, Stored] | None = None,
    labels: tuple[str, ...] = (),
) -> tuple[Job, ...]:
    """The jobs that make shards; subsets that share trajectories are simulated once.

    Args:
      site: the release that the jobs write to.
      inputs: of each subset, by name; the release's own copies by default.
      device: render there instead of on the manifest's device.
      stored: where the states of each subset are read from, by name; by default they are simulated.
      labels: see `Job`.

    Raises:
      RecipeError: the manifest does not say the goals of a subset with fixed ones.
    """
    groups: dict[tuple, list[SubsetRecord]] = {}
    for (name, shard), record in shards.items():
        if record.setting == FIXED and not (record.fixed_goals and record.episodes_per_goal):
            raise RecipeError(f"the manifest does not say the goals of {name}; make it from its recipe again")
        where = device or record.renderer.get("device") or "cpu"
        seed = manifest.recipe_of(name).get("seed", 0)
        source = stored[name] if stored else None  # which no two subsets share
        key = (*_trajectory(manifest, record), source, seed, shard, inputs and inputs[name], where)
        groups.setdefault(key, []).append(record)
    return tuple(
        Job(site, tuple(records), shard, given, seed, names, where, source, labels)
        for (names, *_, source, seed, shard, given, where), records in groups.items()
    )


def part_of(jobs: Sequence[Job], part: tuple[int, int]) -> tuple[Job, ...]:
    """Every N-th job.

    Args:
      part: (K, N): the K-th of N parts, counted from 1; together, the parts are all jobs.

    Raises:
      StoreError: there is no such part.
    """
    number, count = part
    if not 1 <= number <= count:
        raise StoreError(f"part {number}/{count} is out of range; give K/N with K from 1 to N")
    return tuple(jobs[number - 1 :: count])


def left_to_do(jobs: Iterable[Job], done: Mapping[str, Collection[int]]) -> tuple[Job, ...]:
    """The jobs that are left, without the subsets whose shard is committed already.

    Args:
      done: subset -> shards.
    """
    left = []
    for job in jobs:
        records = tuple(record for record in job.subsets if job.shard not in done.get(record.name, ()))
        if records:
            left.append(replace(job, subsets=records))
    return tuple(left)


def _trajectory(manifest: Manifest, record: SubsetRecord) -> tuple:
    """All that decides the episodes of a subset, the names of its random streams first."""
    policies = tuple(policy.digest for policy in record.policies)
    size = (record.episodes, record.episodes_per_shard, record.max_steps)
    goals = (record.fixed_goals, record.episodes_per_goal)
    return stream_names(manifest, record), policies, record.deterministic, *size, *goals


def trajectory_names(trajectories: str, record: SubsetRecord) -> tuple[str, ...]:
    """Names of the random streams of a subset's episodes; subsets of the same names share their trajectories.

    Args:
      trajectories: the recipe's "shared" or "independent".
    """
    shared = trajectories == "shared" and not is_maze(record.task)  # maze subsets have both pictures
    return (record.task, record.level) if shared else (record.task, record.level, record.setting)


def stream_names(manifest: Manifest, record: SubsetRecord) -> tuple[str, ...]:
    """Names of the random streams of a subset's episodes (a repainted one keeps those of its source)."""
    for entry in reversed(manifest.lineage):
        if record.name in entry.get("streams", {}):
            return tuple(entry["streams"][record.name])
    return trajectory_names(manifest.recipe_of(record.name).get("trajectories", "shared"), record)


# -- what a release is made from, found again -----------------------------------------------------


def release_inputs(root: Path, records: Iterable[SubsetRecord], backgrounds: str | None = None) -> dict[str, Inputs]:
    """Policies and videos of a release's subsets, checked by digest.

    Args:
      root: the release's folder, which has copies of what the package does not bring.
      backgrounds: where the videos are now, instead of where the manifest says.

    Raises:
      StoreError: a policy or the videos are not there, or not those of the manifest.
    """
    return {
        record.name: Inputs(policy_files(root, record), background_source(root, record, backgrounds))
        for record in records
    }


def recipe_of(manifest: Manifest, subset: str) -> Recipe:
    """The recipe that a subset was made by: the manifest's first, or the one that added it."""
    return make_recipe(manifest.recipe_of(subset), "the manifest's recipe")


def policy_files(root: Path, record: SubsetRecord) -> tuple[str, ...]:
    """Files of a subset's policies: the release's own copies, else the bundled ones, by digest.

    Raises:
      StoreError: neither is there.
    """
    found = []
    for policy in record.policies:
        candidates = [root / policy.path] if policy.path else []
        with contextlib.suppress(DmcvbError):  # the release's own copy is enough
            candidates += resolve_policies(record.task, record.level)
        same = (str(path) for path in candidates if _digest(path) == policy.digest)
        if (path := next(same, None)) is not None:
            found.append(path)
        else:
            raise StoreError(
                f"policy {policy.name} of {record.name} (digest {policy.digest[:12]}) is neither in the release nor "
                f"bundled with this dmcvb-gen; put its file at {policy.path}"
            )
    return tuple(found)


def _digest(path: Path) -> str | None:
    """The digest of a policy file, None if it cannot be read."""
    try:
        return sha256_file(path)
    except OSError:
        return None


def background_source(root: Path, record: SubsetRecord, moved: str | None = None) -> str:
    """Where a subset's videos are, checked against the manifest's digest.

    Args:
      moved: where they are now, instead of where the manifest says.

    Raises:
      StoreError: they are other videos, or not there.
    """
    if record.backgrounds is None:
        return BUILTIN
    given = video_source(root, record, moved)
    try:
        digest = load_backgrounds(given, record.backgrounds["split"]).digest
    except BackgroundError as error:
        raise StoreError(f"the backgrounds of {record.name} cannot be used: {error}") from None
    if digest != record.backgrounds["digest"]:
        raise StoreError(
            f"backgrounds {given!r} are not those that {record.name} was painted with; give --backgrounds FOLDER"
        )
    return given


def video_source(root: str | Path, record: SubsetRecord, moved: str | None = None) -> str:
    """Where a subset's videos are: "builtin" or a folder; nothing is opened.

    Args:
      root: the release's folder, which has copies of videos that the package does not bring.
      moved: where they are now, instead of where the manifest says.
    """
    source = moved or (record.backgrounds or {}).get("source", BUILTIN)
    inside = not (moved or source == BUILTIN or Path(source).is_absolute())  # absolute: in releases of version 1
    return f"{root}/{source}" if inside else source
