"""Count what a plan will make: episodes, frames and bytes of each subset. Nothing is simulated or measured."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.dataset.schema import EpisodeShape, subset_specs
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import free_bytes
from dmcvb_gen.generate.plan import Plan
from dmcvb_gen.generate.render import frame_count
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import format_bytes

LEAST_SHARE = 0.05
"""Share of their raw bytes that arrays take after compression, at the very least."""


@dataclass(frozen=True)
class SubsetCount:
    """What a plan comes to in one subset.

    Attributes:
      done, left: episodes that are there, and episodes to make.
      frames: images to render (steps to make without images), if no episode ends early.
      raw_bytes: bytes of what is to be made before compression, if no episode ends early.
    """

    name: str
    done: int
    left: int
    frames: int
    raw_bytes: int


def count(plan: Plan) -> tuple[SubsetCount, ...]:
    """Counts of all subsets that a plan chose, whether something is left to do in them or not."""
    left: Counter[str] = Counter()
    for job in plan.jobs:
        left.update({record.name: len(job.episodes) for record in job.subsets})
    records = {record.name: record for job in plan.jobs for record in job.subsets}
    found = []
    for name, chosen in plan.chosen.items():
        frames = raw = 0
        if record := records.get(name):
            frames = frame_count(record, left[name] * record.max_steps, left[name])
            raw = left[name] * (record.max_steps + 1) * _row_bytes(record)
        found.append(SubsetCount(name, chosen - left[name], left[name], frames, raw))
    return tuple(found)


def _row_bytes(record: SubsetRecord) -> int:
    """Bytes of a row of an episode: all arrays that have a value for each step."""
    specs = subset_specs(EpisodeShape.of(get_task(record.task)), record)
    entries = [(3 * record.size**2 if spec.picture else math.prod(spec.shape), spec) for spec in specs if spec.steps]
    return sum(number * np.dtype(spec.dtype).itemsize for number, spec in entries)


def check_room(plan: Plan) -> None:
    """Raises StoreError if what a plan makes cannot fit on the disk of its folder, however well it is compressed."""
    needed = LEAST_SHARE * sum(subset.raw_bytes for subset in count(plan))
    if plan.target.folder and needed > (free := free_bytes(plan.target.folder)):
        raise StoreError(
            f"at least {format_bytes(needed)} are needed and {format_bytes(free)} are free at {plan.target.place}; "
            "make room, choose another --out or fewer --episodes"
        )
