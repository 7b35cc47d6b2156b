"""Count what a plan will make: episodes, frames and bytes of each subset. Nothing is simulated or measured."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import free_bytes
from dmcvb_gen.generate.plan import Plan
from dmcvb_gen.generate.works import episodes_left
from dmcvb_gen.text import format_bytes

LEAST_SHARE = 0.05
"""Share of their raw bytes that arrays take after compression, at the very least."""


@dataclass(frozen=True)
class SubsetCount:
    """What a plan comes to in one subset.

    Attributes:
      done, left: episodes that are there, and episodes to make.
      frames: images to render, if no episode ends early.
      raw_bytes: bytes of what is to be made before compression, if no episode ends early; of shared trajectories in
        the first subset alone.
    """

    name: str
    done: int
    left: int
    frames: int
    raw_bytes: int


def count(plan: Plan) -> tuple[SubsetCount, ...]:
    """Counts of all subsets that a plan chose, whether something is left to do in them or not."""
    left = episodes_left(plan.works)
    frames: Counter[str] = Counter()
    raw: Counter[str] = Counter()
    for work in plan.works:
        rows, below = len(work.episodes) * work.trajectories.rows, [work.trajectories]
        for setting in work.settings:
            name, labels = setting.record.name, [setting.labels] if setting.labels else []
            made = [layer for layer in (*below, *labels, *setting.images) if layer.name in work.make]
            raw[name] += rows * sum(layer.row_bytes for layer in made)
            frames[name] += rows * sum(layer.kind == "images" for layer in made)
            below = []
    return tuple(
        SubsetCount(name, chosen - left[name], left[name], frames[name], raw[name])
        for name, chosen in plan.chosen.items()
    )


def check_room(plan: Plan) -> None:
    """Raises StoreError if what a plan makes cannot fit on the disk of its folder, however well it is compressed."""
    needed = LEAST_SHARE * sum(subset.raw_bytes for subset in count(plan))
    folder = plan.release.store.folder
    if folder and needed > (free := free_bytes(folder)):
        raise StoreError(
            f"at least {format_bytes(needed)} are needed and {format_bytes(free)} are free at {folder}; "
            "make room, choose another --out or fewer --episodes"
        )
