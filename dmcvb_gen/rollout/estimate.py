"""How long and how big: a plan in, steps, bytes and core-hours out, from short measurements on this machine.

What is measured once serves all that it is true of: episodes of a task and level for all settings that show them (a
maze's fixed goals are drawn as its random ones are), pictures of a task, level and kind of distractor. The mazes, whose
pictures cost the same, share theirs, and the lengths of their episodes: a plan of all of them simulates one in each.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.behaviours.policies.simulate import Simulation
from dmcvb_gen.names import ANT_MAZE, LOCOMOTION, distractor_of
from dmcvb_gen.rollout.jobs import Job
from dmcvb_gen.rollout.painting import exogenous_of, label_arrays, len_rows, paint, renderers
from dmcvb_gen.rollout.plan import Plan
from dmcvb_gen.rollout.worker import inputs_of, simulate_job
from dmcvb_gen.store.manifest import SubsetRecord
from dmcvb_gen.store.pictures import stored_pictures
from dmcvb_gen.store.schema import PIXEL_CHUNK_STEPS, EpisodeShape, create_arrays, picture_layout_for, subset_specs
from dmcvb_gen.store.writer import find_array
from dmcvb_gen.tasks import get_task

SAMPLE_EPISODES = {LOCOMOTION: 2, ANT_MAZE: 6}
"""Whole episodes simulated of each locomotion task and level, and of each level of all mazes together: theirs vary in
length."""
TIMED_STEPS = 16
"""Steps of a job's whole batch that are timed: a batch's cost a step is not that of a few episodes."""
SAMPLE_CHUNKS = 5
"""Runs of frames, a chunk of the pictures each, painted and compressed for a sample; spread over the episodes."""


@dataclass(frozen=True)
class Rate:
    """Measured on a few episodes of one task, level and setting.

    Attributes:
      seconds_per_step: of one core, for simulating, painting and storing one setting.
      bytes_per_step: stored.
      steps_per_episode: mean length.
    """

    seconds_per_step: float
    bytes_per_step: float
    steps_per_episode: float


@dataclass(frozen=True)
class Estimate:
    """What a plan will cost; `rates` by subset."""

    jobs: int
    done: int
    episodes: int
    steps: int
    bytes: float
    core_seconds: float
    rates: dict[str, Rate]

    def seconds(self, workers: int) -> float:
        return self.core_seconds / max(workers, 1)


@dataclass(frozen=True)
class _Sample:
    """Whole episodes of a trajectory, and what a step of them costs without pictures."""

    episodes: Simulation
    seconds_per_step: float


def _trajectory(record: SubsetRecord) -> tuple:
    """What decides how its episodes go."""
    return (record.task, record.level, record.deterministic, record.max_steps)


def _alike(record: SubsetRecord) -> tuple:
    """Whose episodes' lengths are taken together: those of the level's mazes."""
    return _trajectory(record) if record.family == LOCOMOTION else (ANT_MAZE, *_trajectory(record)[1:])


def _simulate(job: Job, count: int) -> _Sample:
    count = min(count, job.subsets[0].episodes)
    simulate_job(job, max_steps=1)  # models are compiled, policies read
    started = time.perf_counter()
    timed = simulate_job(job, max_steps=TIMED_STEPS)
    seconds = (time.perf_counter() - started) / timed.length.sum()
    threads = min(os.cpu_count() or 1, count)  # what is timed had one
    return _Sample(simulate_job(job, threads, episodes=range(count)), seconds)


def _paint(job: Job, record: SubsetRecord, sample: Simulation) -> tuple[float, float]:
    """Seconds and bytes a step of painting and storing one setting."""
    task, chunk = get_task(record.task), min(PIXEL_CHUNK_STEPS, record.max_steps + 1)
    renderer, videos = renderers.get(record, inputs_of(job, record).backgrounds, job.device)
    exogenous = exogenous_of(
        record, job.seed, job.names, sample.episodes, sample.physics, sample.length, videos
    )  # of whole episodes: a walk's camera is elsewhere at their end
    runs = _runs(sample.length + 1, chunk)
    episode, row = (np.array([[run[i] for run in runs]]).T for i in (0, 1))
    row = np.minimum(row + np.arange(chunk), sample.length[episode])
    physics, labels = sample.physics[episode, row], exogenous[episode, row]
    length = np.full(len(runs), chunk - 1)
    paint_once = list(paint(task, renderer, physics[:1, :2], labels[:1, :2], length[:1] * 0 + 1, 2))
    del paint_once  # kernels are compiled and buffers made
    specs, layout = subset_specs(EpisodeShape.of(task), record), picture_layout_for(record.setting)
    with tempfile.TemporaryDirectory() as folder:
        group = zarr.create_group(folder)
        create_arrays(group, specs, len(runs), chunk, len(runs), layout)
        started = time.perf_counter()
        stored = stored_pictures(record, bool(task.goal_geoms))
        pictures = paint(task, renderer, physics[:, : len_rows(labels)], labels, length, chunk, arrays=stored)
        for name, value in pictures:
            find_array(group, name)[0][:] = value
        for name, value in label_arrays(labels, length, chunk):
            find_array(group, name)[0][:] = value
        for name, value in sample.arrays().items():
            if value.ndim > 1:
                find_array(group, name)[0][:] = value[episode, row]
        seconds = time.perf_counter() - started
        files = [path for path in Path(folder).rglob("*") if path.is_file() and path.name != "zarr.json"]
        size = sum(path.stat().st_size for path in files)
    frames = len(runs) * chunk
    return seconds / frames, size / frames


def _runs(rows: np.ndarray, chunk: int) -> list[tuple[int, int]]:
    """(episode, first row) of up to `SAMPLE_CHUNKS` chunks, evenly spread over episodes of so many rows."""
    known = [(episode, first) for episode, count in enumerate(rows) for first in range(0, int(count), chunk)]
    chosen = np.linspace(0, len(known) - 1, min(SAMPLE_CHUNKS, len(known))).round().astype(int)
    return [known[index] for index in chosen]


def _samples(plan: Plan) -> dict[tuple, _Sample]:
    """By trajectory: as many episodes of each that those alike come to `SAMPLE_EPISODES` together."""
    first: dict[tuple, tuple[Job, SubsetRecord]] = {
        _trajectory(record): (job, record) for job in reversed(plan.jobs) for record in job.subsets
    }
    sharing = Counter(_alike(record) for _, record in first.values())
    return {
        trajectory: _simulate(job, math.ceil(SAMPLE_EPISODES[record.family] / sharing[_alike(record)]))
        for trajectory, (job, record) in sorted(first.items())  # by task: few of their models are kept
    }


def _mean_lengths(plan: Plan, samples: dict[tuple, _Sample]) -> dict[tuple, float]:
    """By trajectory: the mean length in steps of all sampled episodes that are alike."""
    alike = {_trajectory(record): _alike(record) for job in plan.jobs for record in job.subsets}
    lengths: dict[Hashable, list[int]] = defaultdict(list)
    for trajectory, sample in samples.items():
        lengths[alike[trajectory]] += sample.episodes.length.tolist()
    return {trajectory: float(np.mean(lengths[key])) for trajectory, key in alike.items()}


def estimate(plan: Plan) -> Estimate:
    """Measure what a plan is made of for a moment and extrapolate."""
    samples = _samples(plan)
    lengths = _mean_lengths(plan, samples)
    paintings: dict[Hashable, tuple[float, float]] = {}
    rates: dict[str, Rate] = {}
    for job in sorted(plan.jobs, key=lambda job: _painting_key(job.subsets[0])):  # a painter serves all its levels
        for record in job.subsets:
            if record.name in rates:
                continue
            sample, key = samples[_trajectory(record)], _painting_key(record)
            if key not in paintings:
                paintings[key] = _paint(job, record, sample.episodes)
            seconds, size = paintings[key]
            shared = sample.seconds_per_step / len(job.subsets)
            rates[record.name] = Rate(seconds + shared, size, lengths[_trajectory(record)])
    return _extrapolate(plan, rates)


def _extrapolate(plan: Plan, rates: dict[str, Rate]) -> Estimate:
    steps = size = seconds = 0.0
    for job in plan.jobs:
        for record in job.subsets:
            rate = rates[record.name]
            count = len(job.episodes) * rate.steps_per_episode
            steps, size = steps + count, size + count * rate.bytes_per_step
            seconds += count * rate.seconds_per_step
    return Estimate(len(plan.jobs), plan.done, plan.episodes, round(steps), size, seconds, rates)


def _painting_key(record: SubsetRecord) -> tuple:
    """What decides the cost of a frame; the same for all mazes."""
    if record.family == ANT_MAZE:
        return (ANT_MAZE, record.level, "", "")
    setting = distractor_of(record.task, record.setting)
    return (record.task, setting.kind, setting.difficulty, record.level)


def raw_bytes(plan: Plan) -> float:
    """A cautious bound for the disk check: pictures at half their raw size."""
    total = 0.0
    for job in plan.jobs:
        for record in job.subsets:
            specs = subset_specs(EpisodeShape.of(get_task(record.task)), record)
            pictures = sum(spec.picture for spec in specs)
            total += len(job.episodes) * record.max_steps * pictures * record.size**2 * 3
    return float(np.ceil(total * 0.5))
