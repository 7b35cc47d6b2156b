"""How long and how big: a plan in, steps, bytes and core-hours out, from a short measurement on this machine."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.behaviours.policies.simulate import simulate
from dmcvb_gen.rollout.plan import Job, Plan, load_policies, renderer_for
from dmcvb_gen.rollout.worker import exogenous_of, label_arrays, len_rows, paint
from dmcvb_gen.store.manifest import SubsetRecord
from dmcvb_gen.store.schema import EpisodeShape, array_specs, create_arrays, picture_layout_for
from dmcvb_gen.store.writer import find_array
from dmcvb_gen.tasks import get_task

SAMPLE_EPISODES, SHORT_STEPS, LONG_STEPS = 2, 127, 255
"""Two runs whose frames fill the tracer's launches of 256: their difference is what steps cost, without start-up."""


@dataclass(frozen=True)
class Rate:
    """Measured on a few short episodes of one task and setting."""

    seconds_per_step: float
    bytes_per_step: float


@dataclass(frozen=True)
class Estimate:
    """What a plan will cost. Steps of maze tasks are an upper bound: their episodes may end early."""

    jobs: int
    done: int
    episodes: int
    steps: int
    bytes: float
    core_seconds: float
    rates: dict[str, Rate]

    def seconds(self, workers: int) -> float:
        return self.core_seconds / max(workers, 1)


def measure(job: Job, record: SubsetRecord) -> Rate:
    """Simulate, paint and compress a few short episodes, in a temporary folder."""
    task = get_task(record.task)
    policies = load_policies(record.task, job.policies)
    renderer, backgrounds = renderer_for(record, job.backgrounds, job.split, job.device)

    def run(steps: int) -> tuple[float, float]:
        started = time.perf_counter()
        out = simulate(task, policies, range(SAMPLE_EPISODES), job.seed, job.names, max_steps=steps)
        exogenous = exogenous_of(job, record, out.episodes, out.physics, out.length, backgrounds)
        rows = task.max_steps + 1
        with tempfile.TemporaryDirectory() as folder:
            group = zarr.create_group(folder)
            specs, layout = array_specs(EpisodeShape.of(task), record.size), picture_layout_for(record.setting)
            create_arrays(group, specs, SAMPLE_EPISODES, rows, SAMPLE_EPISODES, layout)
            for name, value in paint(
                task, renderer, out.physics[:, : len_rows(exogenous)], exogenous, out.length, rows
            ):
                find_array(group, name)[0][:] = value
            for name, value in [*label_arrays(exogenous, out.length, rows), *out.arrays().items()]:
                find_array(group, name)[0][:] = value
            elapsed = time.perf_counter() - started
            files = [path for path in Path(folder).rglob("*") if path.is_file() and path.name != "zarr.json"]
            return elapsed, float(sum(path.stat().st_size for path in files))

    try:
        run(2)  # kernels are compiled and buffers made
        short_seconds, short_bytes = run(SHORT_STEPS)
        long_seconds, long_bytes = run(LONG_STEPS)
    finally:
        renderer.close()
    steps, whole = SAMPLE_EPISODES * (LONG_STEPS - SHORT_STEPS), SAMPLE_EPISODES * LONG_STEPS
    seconds, size = (long_seconds - short_seconds) / steps, (long_bytes - short_bytes) / steps
    # A busy machine can make the longer run the quicker one, and episodes can end early: then the mean must do.
    return Rate(seconds if seconds > 0 else long_seconds / whole, size if size > 0 else long_bytes / whole)


def estimate(plan: Plan) -> Estimate:
    """Measure each task and setting of a plan for a moment and extrapolate."""
    rates: dict[str, Rate] = {}
    size = seconds = 0.0
    for job in plan.jobs:
        for record in job.subsets:
            key = f"{record.task}/{record.setting}"
            if key not in rates:
                rates[key] = measure(job, record)
            steps = len(job.episodes) * get_task(record.task).max_steps
            size += steps * rates[key].bytes_per_step
            seconds += steps * rates[key].seconds_per_step
    return Estimate(
        jobs=len(plan.jobs),
        done=plan.done,
        episodes=plan.episodes,
        steps=plan.steps,
        bytes=size,
        core_seconds=seconds,
        rates=rates,
    )


def raw_bytes(plan: Plan) -> float:
    """A cautious bound for the disk check: pictures at half their raw size."""
    total = 0.0
    for job in plan.jobs:
        for record in job.subsets:
            task = get_task(record.task)
            pictures = sum(spec.picture for spec in array_specs(EpisodeShape.of(task), record.size))
            total += len(job.episodes) * task.max_steps * pictures * record.size**2 * 3
    return float(np.ceil(total * 0.5))
