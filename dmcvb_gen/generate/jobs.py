"""Jobs: the shards of a release that are to be made, each with all that decides its bytes.

A job is one shard of one trajectory: the fixed run of episodes is simulated once and rendered for every subset that
shares it. It depends on the manifest, its policies and its videos alone, so a rollout, a repair and a worker on
another machine make the same bytes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.manifest import Manifest, SubsetRecord
from dmcvb_gen.dataset.shards import ShardKey
from dmcvb_gen.dataset.writer import shard_episodes
from dmcvb_gen.errors import RecipeError, StoreError
from dmcvb_gen.generate.inputs import Inputs
from dmcvb_gen.generate.recipe import Recipe, make_recipe
from dmcvb_gen.generate.target import Target
from dmcvb_gen.spec import FIXED, is_maze


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
      target: the release to write to.
      subsets: the records of the subsets to write, one or more of a task and level.
      shard: index of the shard.
      inputs: policies and videos; None: the release's own copies.
      seed, names: the random streams of the episodes.
      stored: source that states are read from; None: they are simulated.
      labels: "depth", "segmentation" and "flow", stored beside the pixels.
    """

    target: Target
    subsets: tuple[SubsetRecord, ...]
    shard: int
    inputs: Inputs | None
    seed: int
    names: tuple[str, ...]
    stored: Stored | None = None
    labels: tuple[str, ...] = ()

    @property
    def in_place(self) -> bool:
        """True if pictures are added to an existing shard."""
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
    target: Target,
    inputs: Mapping[str, Inputs] | None = None,
    stored: Mapping[str, Stored] | None = None,
    labels: tuple[str, ...] = (),
) -> tuple[Job, ...]:
    """The jobs that make shards; subsets that share trajectories are simulated once.

    Args:
      target: the release that the jobs write to.
      inputs: inputs of each subset, by name; the release's own copies by default.
      stored: source of the states of each subset, by name; by default they are simulated.
      labels: see `Job`.

    Raises:
      RecipeError: the manifest does not say the goals of a subset with fixed ones.
    """
    groups: dict[tuple, list[SubsetRecord]] = {}
    for (name, shard), record in shards.items():
        if record.setting == FIXED and not (record.fixed_goals and record.episodes_per_goal):
            raise RecipeError(f"the manifest does not say the goals of {name}; make it from its recipe again")
        seed = manifest.recipe_of(name).get("seed", 0)
        source = stored[name] if stored else None  # which no two subsets share
        key = (*_trajectory(manifest, record), source, seed, shard, inputs and inputs[name])
        groups.setdefault(key, []).append(record)
    return tuple(
        Job(target, tuple(records), shard, given, seed, names, source, labels)
        for (names, *_, source, seed, shard, given), records in groups.items()
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


def streams_of(manifest: Manifest, record: SubsetRecord) -> tuple[int, tuple[str, ...]]:
    """Seed and names of the random streams of a subset's episodes."""
    return manifest.recipe_of(record.name).get("seed", 0), stream_names(manifest, record)


def recipe_of(manifest: Manifest, subset: str) -> Recipe:
    """The recipe that a subset was made by: the manifest's first, or the one that added it."""
    return make_recipe(manifest.recipe_of(subset), "the manifest's recipe")
