"""Doing a job: simulate its episodes, paint them for each setting, commit the shards."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dmcvb_gen.behaviours.policies.actor import Policy, random_policy
from dmcvb_gen.behaviours.policies.policy_file import load_policy
from dmcvb_gen.behaviours.policies.simulate import Simulation, simulate
from dmcvb_gen.pool import Tick, ignore
from dmcvb_gen.rollout.jobs import Job
from dmcvb_gen.rollout.painting import exogenous_of, label_arrays, len_rows, paint, renderers
from dmcvb_gen.store.manifest import CommitRecord, SubsetRecord, environment
from dmcvb_gen.store.writer import write_shard
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs


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
    task = get_task(job.subsets[0].task)
    return [load_policy(path, task) for path in job.inputs.policies] or [random_policy(task)]


def simulate_job(job: Job, threads: int = 1, episodes: range | None = None, max_steps: int | None = None) -> Simulation:
    """The episodes of a job, without pictures.

    Args:
      threads: of the physics.
      episodes, max_steps: others than the job's, for estimates.
    """
    record = job.subsets[0]
    task = get_task(record.task)
    pairs = fixed_pairs(task.layout, record.fixed_goals, job.seed) if record.fixed_goals else None
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


def run_job(job: Job, threads: int = 1, tick: Tick = ignore) -> JobResult:
    """Simulate, paint and commit a job.

    Args:
      threads: of the physics.
      tick: told how many frames were painted since the last call.

    Raises:
      StoreError: the disk is full or cannot be written.
    """
    simulation = simulate_job(job, threads)
    seconds = dict(simulation.seconds) | {"rendering": 0.0, "storage": 0.0}
    commits = []
    for record in job.subsets:
        started, painting = time.perf_counter(), Stopwatch()
        arrays = painting.time(painted_arrays(job, record, simulation, tick))
        made_in = environment(job.device)
        commits.append(write_shard(Path(job.root), record, job.shard, arrays, simulation.length, made_in))
        seconds["rendering"] += painting.seconds
        seconds["storage"] += time.perf_counter() - started - painting.seconds
    return JobResult(tuple(commits), sum(commit.steps for commit in commits), seconds)


def painted_arrays(
    job: Job, record: SubsetRecord, simulation: Simulation, tick: Tick
) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of a shard, one at a time: pictures, labels, and what was simulated."""
    task, rows = get_task(record.task), simulation.state.shape[1]
    renderer, videos = renderers.get(record, job.inputs.backgrounds, job.device)
    episodes, physics, length = simulation.episodes, simulation.physics, simulation.length
    exogenous = exogenous_of(record, job.seed, job.names, episodes, physics, length, videos)
    if record.pixels:
        physics = physics[:, : len_rows(exogenous)]
        yield from paint(task, renderer, physics, exogenous, length, rows, tick)
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
