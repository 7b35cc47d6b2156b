"""Estimate the steps, bytes and core time of a plan from short measurements on this machine.

What is measured once serves all that it is true of: episodes of a task and level for all settings that show them (a
maze's fixed goals are drawn as its random ones are), pictures of a task, level and kind of distractor. The mazes, whose
pictures cost the same, share theirs, and the lengths of their episodes: a plan of all of them simulates one in each.
Tasks are measured side by side in as many processes as will work: cores that share a chip are slower together.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.dataset.schema import PIXEL_CHUNK_STEPS, EpisodeShape, create_arrays, picture_layout_for, subset_specs
from dmcvb_gen.dataset.writer import find_array
from dmcvb_gen.generate.engine import Episodes, inputs_of, shard_arrays, simulated_episodes
from dmcvb_gen.generate.jobs import Job
from dmcvb_gen.generate.plan import Plan
from dmcvb_gen.generate.render import distractor_state_of, renderers
from dmcvb_gen.parallel import ProgressCallback, ignore, in_order
from dmcvb_gen.parallel.cores import usable_cores
from dmcvb_gen.spec import ANT_MAZE, LOCOMOTION
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import format_bytes

SAMPLE_EPISODES = {LOCOMOTION: 2, ANT_MAZE: 6}
"""Whole episodes simulated of each locomotion task and level, and of each level of all mazes together: theirs vary in
length."""
TIMED_STEPS = 64
"""Steps of a job's whole batch that are timed: a batch's cost a step is not that of a few episodes."""
SAMPLE_CHUNKS = 5
"""Runs of frames, a chunk of the pictures each, painted and compressed for a sample; spread over the episodes."""


@dataclass(frozen=True)
class Rate:
    """Measured on a few episodes of one task, level and setting.

    Attributes:
      seconds_per_step: seconds of one core that simulate, paint and store a step of one setting.
      bytes_per_step: stored.
      shared_bytes_per_step: the part of them that is equal in all subsets of a job, which links store once.
      steps_per_episode: mean length.
    """

    seconds_per_step: float
    bytes_per_step: float
    shared_bytes_per_step: float
    steps_per_episode: float


@dataclass(frozen=True)
class Estimate:
    """Cost of a plan; `rates` by subset, `disk_bytes` what the bytes take if equal files are links."""

    jobs: int
    done: int
    episodes: int
    steps: int
    bytes: float
    disk_bytes: float
    core_seconds: float
    rates: dict[str, Rate]

    def seconds(self, workers: int) -> float:
        return self.core_seconds / max(min(workers, self.jobs), 1)  # a job is one worker's

    def of_subsets(self, plan: Plan) -> dict[str, tuple[int, float, float, float]]:
        """Subset -> episodes, steps, bytes and core-seconds that its jobs come to."""
        episodes: Counter[str] = Counter()
        for job in plan.jobs:
            episodes.update({record.name: len(job.episodes) for record in job.subsets})
        steps = {name: count * self.rates[name].steps_per_episode for name, count in episodes.items()}
        return {
            name: (episodes[name], n, n * self.rates[name].bytes_per_step, n * self.rates[name].seconds_per_step)
            for name, n in steps.items()
        }


@dataclass(frozen=True)
class _Piece:
    """One task's measurements: a job and a number of episodes of each trajectory, and subsets to paint."""

    trajectories: tuple[tuple[Job, int], ...]
    paintings: tuple[tuple[Job, SubsetRecord], ...]
    threads: int


@dataclass(frozen=True)
class _Measured:
    """Lengths of whole episodes and what a step costs without pictures, by trajectory; seconds, bytes and shared bytes
    of a painted step by `_painting_key`."""

    lengths: dict[tuple, list[int]]
    seconds: dict[tuple, float]
    paintings: dict[tuple, tuple[float, float, float]]


def _trajectory(record: SubsetRecord) -> tuple:
    """Return what decides a subset's trajectories."""
    return (record.task, record.level, record.deterministic, record.max_steps)


def _alike(record: SubsetRecord) -> tuple:
    """Key of the mean length of episodes; all mazes share one for each level."""
    return _trajectory(record) if record.goal_mode is None else (ANT_MAZE, *_trajectory(record)[1:])


def _simulate(job: Job, count: int, threads: int) -> tuple[Episodes, float]:
    """Whole episodes of a trajectory, and the seconds that a step takes one core without pictures."""
    simulated_episodes(job, max_steps=1)  # models are compiled, policies read
    started = time.perf_counter()
    timed = simulated_episodes(job, max_steps=TIMED_STEPS)
    seconds = (time.perf_counter() - started) / timed.length.sum()
    return simulated_episodes(job, min(threads, count), episodes=range(count)), seconds  # what is timed had one thread


def _paint(job: Job, record: SubsetRecord, sample: Episodes) -> tuple[float, float, float]:
    """Seconds, bytes and shared bytes a step of painting and storing one setting."""
    task, chunk = get_task(record.task), min(PIXEL_CHUNK_STEPS, record.max_steps + 1)
    if not record.pixels:  # what an array costs besides its rows would be all of the time of a few of them
        chunk = max(chunk, int(sample.length.min()) + 1)
    _, videos = renderers.get(record, inputs_of(job, record).backgrounds, job.device)
    labels = distractor_state_of(
        record, job.seed, job.names, sample.index, sample.physics, sample.length, videos, sample.arrays["action"]
    )  # of whole episodes: a walk's camera is elsewhere at their end
    runs = _runs(sample.length + 1, chunk)
    episode, row = (np.array([[run[i] for run in runs]]).T for i in (0, 1))
    row = np.minimum(row + np.arange(chunk), sample.length[episode])
    values = {name: value[episode, row] for name, value in sample.arrays.items() if value.ndim > 1}
    length = np.full(len(runs), chunk - 1)
    timed = Episodes(sample.index[episode[:, 0]], sample.physics[episode, row], length, values, labels[episode, row])
    first = Episodes(timed.index[:1], timed.physics[:1, :2], length[:1] * 0 + 1, {}, labels[episode, row][:1, :2])
    for _ in shard_arrays(job, record, first):
        pass  # kernels are compiled and buffers made
    specs, layout = subset_specs(EpisodeShape.of(task), record), picture_layout_for(record.spec.camera_moves)
    with tempfile.TemporaryDirectory() as folder:
        group = zarr.create_group(folder)
        create_arrays(group, specs, len(runs), chunk, len(runs), layout)
        started = time.perf_counter()
        for name, value in shard_arrays(job, record, timed):
            find_array(group, name)[0][:] = value
        seconds = time.perf_counter() - started
        size = _stored_bytes(Path(folder))
        shared = sum(_stored_bytes(Path(folder) / find_array(group, name)[1]) for name in values)
    frames = len(runs) * chunk
    return seconds / frames, size / frames, shared / frames


def _stored_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and path.name != "zarr.json")


def _runs(rows: np.ndarray, chunk: int) -> list[tuple[int, int]]:
    """(episode, first row) of up to `SAMPLE_CHUNKS` chunks, evenly spread over episodes of so many rows."""
    known = [(episode, first) for episode, count in enumerate(rows) for first in range(0, int(count), chunk)]
    chosen = np.linspace(0, len(known) - 1, min(SAMPLE_CHUNKS, len(known))).round().astype(int)
    return [known[index] for index in chosen]


def _pieces(plan: Plan, threads: int) -> list[_Piece]:
    """By task. As many episodes of each trajectory as those alike come to `SAMPLE_EPISODES` together; each painting
    once, of the first task that has it."""
    jobs = {_trajectory(job.subsets[0]): job for job in reversed(plan.jobs)}
    sharing = Counter(_alike(job.subsets[0]) for job in jobs.values())
    paintings = {_painting_key(record): (job, record) for job in reversed(plan.jobs) for record in job.subsets}

    def count(record: SubsetRecord) -> int:
        return min(math.ceil(SAMPLE_EPISODES[record.family] / sharing[_alike(record)]), record.episodes)

    return [
        _Piece(
            tuple((job, count(job.subsets[0])) for job in jobs.values() if job.subsets[0].task == task),
            tuple(pair for _, pair in sorted(paintings.items()) if pair[1].task == task),  # a painter serves all levels
            threads,
        )
        for task in sorted({job.subsets[0].task for job in jobs.values()})
    ]


def _measure(piece: _Piece, tick: ProgressCallback = ignore) -> _Measured:
    measured, episodes = _Measured({}, {}, {}), {}
    for job, count in piece.trajectories:
        key = _trajectory(job.subsets[0])
        episodes[key], measured.seconds[key] = _simulate(job, count, piece.threads)
        measured.lengths[key] = episodes[key].length.tolist()
        tick(1)
    for job, record in piece.paintings:
        measured.paintings[_painting_key(record)] = _paint(job, record, episodes[_trajectory(record)])
        tick(1)
    return measured


def _mean_lengths(plan: Plan, lengths: dict[tuple, list[int]]) -> dict[tuple, float]:
    """By trajectory: the mean length in steps of all sampled episodes that are alike."""
    alike = {_trajectory(record): _alike(record) for job in plan.jobs for record in job.subsets}
    together: dict[Hashable, list[int]] = defaultdict(list)
    for trajectory, some in lengths.items():
        together[alike[trajectory]] += some
    return {trajectory: float(np.mean(together[key])) for trajectory, key in alike.items()}


def measurements(plan: Plan) -> int:
    """Count the measurements of an estimate: one for each trajectory and one for each kind of pictures."""
    records = [record for job in plan.jobs for record in job.subsets]
    return len({_trajectory(record) for record in records}) + len({_painting_key(record) for record in records})


def estimate(plan: Plan, workers: int = 1, progress: ProgressCallback = ignore) -> Estimate:
    """Measure what a plan is made of for a moment and extrapolate.

    Args:
      workers: processes that measure side by side, as they will work; no more than there are cores.
      progress: called with 1 after each measurement; see `measurements`.

    Raises:
      StoreError: a worker was killed.
    """
    plan = _with_inputs(plan)
    cores = usable_cores()
    workers = min(workers, cores)
    lengths: dict[tuple, list[int]] = {}
    seconds: dict[tuple, float] = {}
    paintings: dict[tuple, tuple[float, float, float]] = {}
    for part in in_order(_measure, _pieces(plan, cores // workers), workers, progress):
        lengths |= part.lengths
        seconds |= part.seconds
        paintings |= part.paintings
    means = _mean_lengths(plan, lengths)
    rates: dict[str, Rate] = {}
    for job in plan.jobs:
        for record in job.subsets:
            painting, size, equal = paintings[_painting_key(record)]
            shared = seconds[_trajectory(record)] / len(job.subsets)
            rates.setdefault(record.name, Rate(painting + shared, size, equal, means[_trajectory(record)]))
    return _extrapolate(plan, rates)


def _with_inputs(plan: Plan) -> Plan:
    """The plan with policies and videos as they are here: a bucket that is not begun has no copies yet."""
    if plan.inputs is None:
        return plan
    jobs = (job if job.inputs else replace(job, inputs=plan.inputs[job.subsets[0].name]) for job in plan.jobs)
    return replace(plan, jobs=tuple(jobs))


def _extrapolate(plan: Plan, rates: dict[str, Rate]) -> Estimate:
    steps = size = linked = seconds = 0.0
    for job in plan.jobs:
        for number, record in enumerate(job.subsets):
            rate = rates[record.name]
            count = len(job.episodes) * rate.steps_per_episode
            steps, size = steps + count, size + count * rate.bytes_per_step
            linked += count * rate.shared_bytes_per_step * (number > 0)
            seconds += count * rate.seconds_per_step
    return Estimate(len(plan.jobs), plan.done, plan.episodes, round(steps), size, size - linked, seconds, rates)


def _painting_key(record: SubsetRecord) -> tuple:
    """Return what decides the cost of a frame; it is the same for all mazes."""
    if record.goal_mode is not None:
        return (ANT_MAZE, record.level, "", "")
    setting = record.distractor
    return (record.task, setting.kind, setting.difficulty, record.level)


def raw_bytes(plan: Plan) -> float:
    """Bytes that a plan's arrays would take without compression, if no episode ended early."""
    total = 0
    for job in plan.jobs:
        for record in job.subsets:
            step = 0
            for spec in subset_specs(EpisodeShape.of(get_task(record.task)), record):
                entries = 3 * record.size**2 if spec.picture else math.prod(spec.shape)
                step += entries * np.dtype(spec.dtype).itemsize * spec.steps
            total += len(job.episodes) * (record.max_steps + 1) * step
    return float(total)


def room_needed(plan: Plan, free: float, workers: int = 1, notify: Callable[[str], None] = ignore) -> float:
    """Bytes of disk that a plan's jobs will take at most; measured, as `estimate` does, if the raw arrays do not fit.

    Args:
      free: bytes of the disk that are free.
      workers: processes that measure side by side.
      notify: told that it measures, which takes seconds for each task.
    """
    if (raw := raw_bytes(plan)) <= free:
        return raw
    notify(
        f"{format_bytes(free)} are free and arrays take up to {format_bytes(raw)}; measuring how much they will take."
    )
    return estimate(plan, workers).disk_bytes
