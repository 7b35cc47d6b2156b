"""The generation engine: take the states of a shard's episodes, render them, and commit the shard.

::

    command      states                            what is written
    rollout      simulated                         every array
    regenerate   simulated                         every array, compared with the release's digests
    repaint      read from another release         every array; distractors are stored or drawn anew
    paint        read from the release itself      pictures, added to the shard
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dmcvb_gen.dataset.manifest import CommitRecord, SubsetRecord, commit_path, environment
from dmcvb_gen.dataset.pictures import stored_pictures
from dmcvb_gen.dataset.shards import damage
from dmcvb_gen.dataset.writer import WrittenArrays, write_pictures, write_shard
from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.inputs import Inputs
from dmcvb_gen.generate.jobs import Job
from dmcvb_gen.generate.render import distractor_state_of, label_arrays, len_rows, paint, paint_labels, renderers
from dmcvb_gen.generate.target import staging_folder_of
from dmcvb_gen.parallel import Future, ProgressCallback, ignore
from dmcvb_gen.policies.actor import Policy, random_policy
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import as_maze, fixed_pairs
from dmcvb_gen.text import quoted

COPIED = ("state", "action", "reward", "discount", "length", "terminated", "return", "seed", "behaviour", "goal_pair")
"""Arrays that a repaint copies besides the physics states."""


@dataclass(frozen=True)
class Episodes:
    """Episodes before they are rendered; rows past an episode's end are zero.

    Attributes:
      index: (episode,) int, in the subset.
      physics: (episode, row, physics) float64.
      length: (episode,) int32, transitions of each.
      arrays: the values to store beside pictures and labels, by name.
      labels: labels of the distractors, (episode, row up to the longest episode's last); None: drawn from the streams.
      seconds: time spent so far, by part.
    """

    index: np.ndarray
    physics: np.ndarray
    length: np.ndarray
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    labels: DistractorState | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class JobResult:
    """The result of a job.

    Attributes:
      commits: one record for each subset of the job.
      steps: transitions committed, over all subsets.
      seconds: time spent in "physics", "policy", "rendering" and "storage".
    """

    commits: tuple[CommitRecord, ...]
    steps: int
    seconds: dict[str, float] = field(default_factory=dict)


def run_job(job: Job, threads: int = 1, tick: ProgressCallback = ignore) -> JobResult | Future:
    """Take the states of a job's episodes, render them for each subset, and commit the shards.

    Args:
      threads: threads of the physics.
      tick: called with the number of frames rendered since the last call.

    Returns:
      The result, or a `Future` of it while shards are being uploaded.

    Raises:
      StoreError: a source shard is damaged, or the disk is full or cannot be written.
    """
    episodes = stored_episodes(job) if job.stored else simulated_episodes(job, threads)
    seconds = dict(episodes.seconds) | {"rendering": 0.0, "storage": 0.0}
    sent, written = [], WrittenArrays(job.target.folder or staging_folder_of(job.target).folder)
    for record in job.subsets:
        started, rendering = time.perf_counter(), Stopwatch()
        arrays = rendering.time(shard_arrays(job, record, episodes, tick))
        sent.append(_write_and_commit(job, record, arrays, episodes.length, written))
        seconds["rendering"] += rendering.seconds
        seconds["storage"] += time.perf_counter() - started - rendering.seconds

    def committed() -> JobResult:
        for _, wait in sent:
            wait()
        commits = tuple(commit for commit, _ in sent)
        return JobResult(commits, sum(commit.steps for commit in commits), seconds)

    return Future(committed) if job.target.uploads else committed()


# -- states ---------------------------------------------------------------------------------------


def simulated_episodes(job: Job, threads: int = 1) -> Episodes:
    """Simulate the episodes of a job.

    Args:
      threads: threads of the physics.
    """
    record = job.subsets[0]
    task = get_task(record.task)
    pairs = fixed_pairs(as_maze(task).layout, record.fixed_goals, job.seed) if record.fixed_goals else None
    made = simulate(
        task,
        _policies(record.task, inputs_of(job, record).policies, tuple(policy.digest for policy in record.policies)),
        list(job.episodes),
        job.seed,
        job.names,
        deterministic=record.deterministic,
        goal_pairs=pairs,
        episodes_per_goal=record.episodes_per_goal,
        threads=threads,
        max_steps=record.max_steps,
    )
    return Episodes(made.episodes, made.physics, made.length, made.arrays(), seconds=made.seconds)


@functools.lru_cache(maxsize=4)
def _policies(task_name: str, files: tuple[str, ...], digests: tuple[str, ...]) -> list[Policy]:
    """The policies of a subset (uniform random actions without files), read once in each process.

    Args:
      digests: digests of the policies, so that a file that was replaced is read again.
    """
    task = get_task(task_name)
    loaded = [load_policy(path, task) for path in files]
    for path, policy, digest in zip(files, loaded, digests, strict=True):
        if policy.digest != digest:
            raise StoreError(
                f"{path} is not the policy that the release names (digest {policy.digest[:12]}, asked for "
                f"{digest[:12]}); bring back the file as it was, or give another --out"
            )
    return loaded or [random_policy(task)]


def stored_episodes(job: Job) -> Episodes:
    """Read the episodes of a job from the release that has them.

    Raises:
      StoreError: the shard is damaged.
    """
    assert job.stored
    subset = job.stored.subset
    if broken := damage(Path(subset.root), subset.record, job.shard):
        raise StoreError(f"{subset.name} shard {job.shard}: {broken}; run `dmcvb-gen regenerate {quoted(subset.root)}`")
    index = np.asarray(job.episodes)
    physics, length = subset.read("physics", index), subset.read("length", index)
    labels = None if job.stored.new_labels else subset.labels(index)[:, : int(length.max()) + 1]
    copied = {} if job.stored.in_place else {name: subset.read(name, index) for name in COPIED} | {"physics": physics}
    return Episodes(index, physics, length, copied, labels)


def inputs_of(job: Job, record: SubsetRecord) -> Inputs:
    """The policy files and videos of a subset on this machine."""
    return job.inputs or staging_folder_of(job.target).inputs(record)


# -- rendering and storing ------------------------------------------------------------------------


def shard_arrays(
    job: Job, record: SubsetRecord, episodes: Episodes, progress: ProgressCallback = ignore
) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of a shard, made one at a time: pictures, labels, states, depth and segmentation.

    Yields:
      (name, (episode, row, ...)), or (name, (episode,)) for arrays without steps.
    """
    task, length, rows = get_task(record.task), episodes.length, episodes.physics.shape[1]
    renderer, videos = renderers.get(record, inputs_of(job, record).backgrounds)
    labels = episodes.labels
    if labels is None:
        streams, states = (record, job.seed, job.names, episodes.index), (episodes.physics, length)
        labels = distractor_state_of(*streams, *states, videos, episodes.arrays["action"])
    physics = episodes.physics[:, : len_rows(labels)]
    if record.pixels:
        pictures = stored_pictures(record, bool(task.goal_geoms))
        yield from paint(task, renderer, physics, labels, length, rows, progress, pictures)
    else:
        progress(int((length + 1).sum()))
    if job.in_place:
        return
    yield from label_arrays(labels, length, rows)
    yield from episodes.arrays.items()
    for label in job.labels:
        yield from paint_labels(task, renderer, physics, labels, length, rows, label, record.hidden_goal, record.views)


def _write_and_commit(
    job: Job,
    record: SubsetRecord,
    arrays: Iterator[tuple[str, np.ndarray]],
    lengths: np.ndarray,
    written: WrittenArrays,
) -> tuple[CommitRecord, Callable[[], None]]:
    """Write a shard and commit it: its commit record, and a function that waits until it is in the release.

    Args:
      written: arrays of the job's subsets so far, to which equal ones are linked.

    Raises:
      StoreError: it cannot be written, or another machine has committed this shard with other bytes.
    """
    made_by = environment()
    if job.stored and job.in_place:
        subset = job.stored.subset
        added = write_pictures(Path(subset.root), record, subset.commits[job.shard], arrays, made_by)
        return added, lambda: None
    folder = staging_folder_of(job.target).prepare(record)
    commit = write_shard(folder, record, job.shard, arrays, lengths, made_by, written)
    (folder / commit_path(record.name, job.shard)).unlink()  # it is committed last
    return commit, job.target.commit_shard(folder, commit)


class Stopwatch:
    """Measure the time that an iterator takes for its items, without what the caller does with them."""

    def __init__(self):
        self.seconds = 0.0

    def time(self, items: Iterator) -> Iterator:
        """The same items."""
        started = time.perf_counter()
        for item in items:
            self.seconds += time.perf_counter() - started
            yield item
            started = time.perf_counter()
        self.seconds += time.perf_counter() - started
