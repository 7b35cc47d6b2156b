"""Doing a job: simulate its episodes, paint them for each setting, commit the shards."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from dmcvb_gen.dataset.manifest import CommitRecord, SubsetRecord, commit_path, environment
from dmcvb_gen.dataset.pictures import stored_pictures
from dmcvb_gen.dataset.writer import write_shard
from dmcvb_gen.generate.jobs import Inputs, Job
from dmcvb_gen.generate.render import distractor_state_of, label_arrays, len_rows, paint, renderers
from dmcvb_gen.generate.site import Site, staging_folder_of
from dmcvb_gen.parallel import Future, ProgressCallback, ignore
from dmcvb_gen.policies.actor import Policy, random_policy
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import Simulation, simulate
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import as_maze, fixed_pairs


@dataclass(frozen=True)
class JobResult:
    """What a job gave.

    Attributes:
      commits: a record a setting.
      steps: transitions committed, over all settings.
      seconds: time spent in "physics", "policy", "rendering" and "storage".
    """

    commits: tuple[CommitRecord, ...]
    steps: int
    seconds: dict[str, float] = field(default_factory=dict)


def load_policies(job: Job) -> list[Policy]:
    """The behaviour policies of a job (uniform random actions where there is no file)."""
    record = job.subsets[0]
    task = get_task(record.task)
    return [load_policy(path, task) for path in inputs_of(job, record).policies] or [random_policy(task)]


def inputs_of(job: Job, record: SubsetRecord) -> Inputs:
    """What a subset of a job is made from, on this machine."""
    return job.inputs or staging_folder_of(job.site).inputs(record)


def simulate_job(job: Job, threads: int = 1, episodes: range | None = None, max_steps: int | None = None) -> Simulation:
    """The episodes of a job, without pictures.

    Args:
      threads: of the physics.
      episodes, max_steps: others than the job's, for estimates.
    """
    record = job.subsets[0]
    task = get_task(record.task)
    pairs = fixed_pairs(as_maze(task).layout, record.fixed_goals, job.seed) if record.fixed_goals else None
    return simulate(
        task,
        load_policies(job),
        list(episodes or job.episodes),
        job.seed,
        job.names,
        deterministic=record.deterministic,
        goal_pairs=pairs,
        episodes_per_goal=record.episodes_per_goal,
        threads=threads,
        max_steps=max_steps or record.max_steps,
    )


def run_job(job: Job, threads: int = 1, tick: ProgressCallback = ignore) -> JobResult | Future:
    """Simulate, paint and commit a job.

    Args:
      threads: of the physics.
      tick: told how many frames were painted since the last call.

    Returns:
      What it gave; later, where shards are still on their way to a bucket.

    Raises:
      StoreError: the disk is full or cannot be written.
    """
    simulation = simulate_job(job, threads)
    seconds = dict(simulation.seconds) | {"rendering": 0.0, "storage": 0.0}
    sent = []
    for record in job.subsets:
        started, painting = time.perf_counter(), Stopwatch()
        arrays = painting.time(painted_arrays(job, record, simulation, tick))
        sent.append(make_shard(job.site, record, job.shard, arrays, simulation.length, job.device))
        seconds["rendering"] += painting.seconds
        seconds["storage"] += time.perf_counter() - started - painting.seconds

    def arrived() -> JobResult:
        for _, wait in sent:
            wait()
        commits = tuple(commit for commit, _ in sent)
        return JobResult(commits, sum(commit.steps for commit in commits), seconds)

    return Future(arrived) if job.site.slow else arrived()


def make_shard(
    site: Site,
    record: SubsetRecord,
    shard: int,
    arrays: Iterator[tuple[str, np.ndarray]],
    lengths: np.ndarray,
    device: str,
) -> tuple[CommitRecord, Callable[[], None]]:
    """Write a shard on this process's stage and deliver it.

    Args:
      arrays, lengths: as for `write_shard`.
      device: that painted.

    Returns:
      Its commit record, and a call that waits until it is delivered.

    Raises:
      StoreError: it cannot be written or delivered.
    """
    folder = staging_folder_of(site).prepare(record)
    commit = write_shard(folder, record, shard, arrays, lengths, environment(device))
    (folder / commit_path(record.name, shard)).unlink()  # it belongs to the delivery
    return commit, site.deliver(folder, commit)


def painted_arrays(
    job: Job, record: SubsetRecord, simulation: Simulation, tick: ProgressCallback
) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of a shard, one at a time: pictures, labels, and what was simulated."""
    task, rows = get_task(record.task), simulation.state.shape[1]
    renderer, videos = renderers.get(record, inputs_of(job, record).backgrounds, job.device)
    episodes, physics, length = simulation.episodes, simulation.physics, simulation.length
    exogenous = distractor_state_of(record, job.seed, job.names, episodes, physics, length, videos)
    if record.pixels:
        physics = physics[:, : len_rows(exogenous)]
        arrays = stored_pictures(record, bool(task.goal_geoms))
        yield from paint(task, renderer, physics, exogenous, length, rows, tick, arrays)
    else:
        tick(int((length + 1).sum()))
    yield from label_arrays(exogenous, length, rows)
    yield from simulation.arrays().items()


class Stopwatch:
    """The time that an iterator takes for its items, apart from what is done with them."""

    def __init__(self):
        self.seconds = 0.0

    def time(self, items: Iterator) -> Iterator:
        """The items."""
        started = time.perf_counter()
        for item in items:
            self.seconds += time.perf_counter() - started
            yield item
            started = time.perf_counter()
        self.seconds += time.perf_counter() - started
