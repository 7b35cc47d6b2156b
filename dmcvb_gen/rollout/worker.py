"""Doing a job: simulate its episodes, paint them for each setting, commit the shards."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dmcvb_gen.behaviours.policies.simulate import Simulation, simulate
from dmcvb_gen.distractors import make_exogenous
from dmcvb_gen.labels import Exogenous
from dmcvb_gen.names import distractor_of
from dmcvb_gen.pool import Tick, ignore
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.rollout.plan import Job, load_policies, renderer_for
from dmcvb_gen.seeding import STREAMS, episode_stream
from dmcvb_gen.store.manifest import CommitRecord, SubsetRecord
from dmcvb_gen.store.pictures import picture_arrays
from dmcvb_gen.store.writer import write_shard
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import fixed_pairs
from dmcvb_gen.tasks.base import Task

PAINT_FRAMES = 2004
"""Frames painted between two ticks of the progress bar."""


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


def simulate_job(job: Job, threads: int = 1) -> Simulation:
    """The episodes of a job, without pictures."""
    task = get_task(job.subsets[0].task)
    pairs = None
    if job.fixed_goals:
        pairs = fixed_pairs(task.layout, job.fixed_goals, job.seed)
    return simulate(
        task,
        load_policies(task.id, job.policies),
        list(job.episodes),
        job.seed,
        job.names,
        deterministic=job.subsets[0].deterministic,
        goal_pairs=pairs,
        episodes_per_goal=job.episodes_per_goal,
        threads=threads,
    )


def exogenous_of(
    job: Job, record: SubsetRecord, episodes: np.ndarray, physics: np.ndarray, length: np.ndarray, backgrounds
) -> Exogenous:
    """Distractor labels of episodes, leading shape (episode, row); rows past an episode's end are zero.

    Args:
      physics: (episode, row, physics) float64.
      length: (episode,) transitions of each.
    """
    task = get_task(record.task)
    rows = int(length.max()) + 1
    after = np.arange(rows)[None] > length[:, None]
    padded = physics[:, :rows].copy()
    last = physics[np.arange(len(physics)), length]
    padded[after] = np.repeat(last, after.sum(axis=1), axis=0)  # a state that MuJoCo can be put into
    generators = {
        name: [episode_stream(job.seed, job.names, int(i), name) for i in episodes]
        for name in STREAMS
        if name not in ("initial_state", "policy")
    }
    setting = distractor_of(record.task, record.setting)
    return make_exogenous(task, setting, padded, generators, backgrounds, split=job.split)


def paint(
    task: Task,
    renderer: Renderer,
    physics: np.ndarray,
    exogenous: Exogenous,
    length: np.ndarray,
    rows: int,
    tick: Tick = ignore,
) -> Iterator[tuple[str, np.ndarray]]:
    """Pictures of episodes, one array at a time.

    Yields:
      (name, (episode, rows, size, size, 3) uint8); rows past an episode's end stay zero.
    """
    episode, row = np.nonzero(np.arange(physics.shape[1])[None] <= length[:, None])
    size, total = renderer.size, len(episode)
    names = zip(picture_arrays(task.views), picture_arrays(task.views, hide_goal=True), strict=True)
    for view, (name, hidden_name) in zip(task.views, names, strict=True):
        picture = np.zeros((len(physics), rows, size, size, 3), np.uint8)
        for first in range(0, total, PAINT_FRAMES):
            e, r = episode[first : first + PAINT_FRAMES], row[first : first + PAINT_FRAMES]
            picture[e, r] = renderer.render(physics[e, r], exogenous[e, r], views=[view])[:, 0]
            tick(len(e))
        yield name, picture
        if not task.goal_geoms:
            continue
        seen = _goal_in_sight(task, view, physics[episode, row], exogenous[episode, row])
        seen, spans = _spans_of_one_background(task, view, size, physics, exogenous, episode, row, seen)
        shown = [picture[e, rows[0]].copy() for e, rows in spans]
        hidden = picture
        for first in range(0, len(seen), PAINT_FRAMES):
            e, r = episode[seen[first : first + PAINT_FRAMES]], row[seen[first : first + PAINT_FRAMES]]
            hidden[e, r] = renderer.render(physics[e, r], exogenous[e, r], views=[view], hide_goal=True)[:, 0]
        for (e, rows_of), before in zip(spans, shown, strict=True):
            behind = hidden[e, rows_of[0]]
            covered = (behind != before).any(axis=-1, keepdims=True)
            hidden[e, rows_of[1:]] = np.where(covered, behind, hidden[e, rows_of[1:]])
        yield hidden_name, hidden


def _goal_in_sight(task: Task, view: str, physics: np.ndarray, exogenous: Exogenous) -> np.ndarray:
    """Indices of the frames in which the goal (or its shadow) may change a pixel; the others share their pictures."""
    if not hasattr(task, "goal_in_sight"):
        return np.arange(len(physics))
    return np.flatnonzero(task.goal_in_sight(view, physics, exogenous))


def _spans_of_one_background(
    task: Task,
    view: str,
    size: int,
    physics: np.ndarray,
    exogenous: Exogenous,
    episode: np.ndarray,
    row: np.ndarray,
    seen: np.ndarray,
) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
    """Frames that need no picture of their own with the goal hidden.

    Where the camera stands still, and nothing that moves is near the goal, what is behind the goal is the same in
    every frame of an episode: one hidden picture tells it for all.

    Returns:
      What is left of `seen`, and (episode, rows): hide the goal in the first of the rows, copy its pixels to the rest.
    """
    if not len(seen) or not hasattr(task, "goal_alone"):
        return seen, []
    index = task.views.index(view)
    alone = np.zeros(len(episode), bool)
    alone[seen] = task.goal_alone(physics[episode[seen], row[seen]], size)
    spans = []
    for e in np.unique(episode[seen]):
        frames = np.flatnonzero(alone & (episode == e))
        poses = [field[e, row[frames], index] for field in (exogenous.camera_position, exogenous.camera_quaternion)]
        if len(frames) > 1 and all((pose == pose[0]).all() for pose in poses):
            spans.append((int(e), row[frames]))
            alone[frames[0]] = False
        else:
            alone[frames] = False
    return seen[~alone[seen]], spans


class _RendererCache:
    """Renderers by what decides them, so that the shards of a subset share one."""

    def __init__(self):
        self._made: dict[tuple, tuple] = {}

    def get(self, record: SubsetRecord, backgrounds: str, split: str, device: str):
        setting = distractor_of(record.task, record.setting)
        key = (record.task, setting.name, record.size, str(sorted(record.renderer.items(), key=str)))
        key += (backgrounds, split, device)
        if key not in self._made:
            for renderer, _ in self._made.values():
                renderer.close()  # one at a time: a renderer's buffers are large
            self._made = {key: renderer_for(record, backgrounds, split, device)}
        return self._made[key]


_renderers = _RendererCache()


def run_job(job: Job, threads: int = 1, tick: Tick = ignore) -> JobResult:
    """Simulate, paint and commit a job.

    Args:
      tick: told how many frames were painted since the last call.

    Raises:
      StoreError: the disk is full or cannot be written.
    """
    simulation = simulate_job(job, threads)
    seconds = dict(simulation.seconds) | {"rendering": 0.0, "storage": 0.0}
    commits = []
    for record in job.subsets:
        started = time.perf_counter()
        commit, painting = _commit(job, record, simulation, tick)
        seconds["rendering"] += painting
        seconds["storage"] += time.perf_counter() - started - painting
        commits.append(commit)
    return JobResult(tuple(commits), sum(commit.steps for commit in commits), seconds)


def _commit(job, record, simulation, tick):
    task = get_task(record.task)
    rows = simulation.state.shape[1]
    painting = 0.0

    def arrays():
        nonlocal painting
        started = time.perf_counter()
        renderer, backgrounds = _renderers.get(record, job.backgrounds, job.split, job.device)
        exogenous = exogenous_of(job, record, simulation.episodes, simulation.physics, simulation.length, backgrounds)
        pictures = paint(
            task, renderer, simulation.physics[:, : len_rows(exogenous)], exogenous, simulation.length, rows, tick
        )
        for item in pictures:
            painting += time.perf_counter() - started
            yield item
            started = time.perf_counter()
        painting += time.perf_counter() - started
        yield from label_arrays(exogenous, simulation.length, rows)
        yield from simulation.arrays().items()

    commit = write_shard(Path(job.root), record, job.shard, arrays(), simulation.length)
    return commit, painting


def len_rows(exogenous: Exogenous) -> int:
    """Rows of labels with leading shape (episode, row)."""
    return exogenous.background_video.shape[1]


def label_arrays(exogenous: Exogenous, length: np.ndarray, rows: int) -> Iterator[tuple[str, np.ndarray]]:
    """The labels under their stored names, rows past an episode's end zero."""
    for name, value in exogenous.items():
        full = np.zeros((value.shape[0], rows, *value.shape[2:]), value.dtype)
        full[:, : value.shape[1]] = value
        full[np.arange(rows)[None] > length[:, None]] = 0
        yield f"exogenous/{name}", full
