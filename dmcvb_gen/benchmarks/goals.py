"""Fixed goals of a maze (benchmark B3): (start, goal) pairs of a subset and their cells.

What a subset was asked to be decides, never how much of it is at hand: a part of a release is scored on the starts
and goals of the whole one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dmcvb_gen.dataset import Subset
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks import get_task

Cells = tuple[tuple[int, int], tuple[int, int]]
"""(row, column) of the start, (row, column) of the goal."""


@dataclass(frozen=True)
class GoalPairs:
    """The pairs of a subset.

    Attributes:
      whole: indices of the pairs whose every episode is committed.
      partial: indices of the others.
    """

    whole: tuple[int, ...]
    partial: tuple[int, ...] = ()


def goal_pairs(subset: Subset) -> GoalPairs:
    """Which pairs a subset has, by its record; by the episodes' own labels if that does not say it (imported)."""
    per_goal = subset.record.episodes_per_goal
    if per_goal is None:
        return GoalPairs(tuple(int(pair) for pair in np.unique(subset.read("goal_pair")) if pair >= 0))
    count, have = subset.record.episodes, set(map(int, subset.episodes))
    whole, partial = [], []
    for pair, first in enumerate(range(0, count, per_goal)):
        (whole if have.issuperset(range(first, min(first + per_goal, count))) else partial).append(pair)
    return GoalPairs(tuple(whole), tuple(partial))


def goal_cells(subset: Subset, pair: int) -> Cells:
    """The cells of a pair's start and goal, as its first episode shows them.

    Raises:
      DmcvbError: no episode of the pair is there.
    """
    task = get_task(subset.task)
    known = subset.episodes[subset.read("goal_pair") == pair]
    if not len(known):
        raise DmcvbError(f"{subset.name} has no episodes of goal pair {pair}; fetch or roll them out")
    state = subset.read("state", known[:1])[0, 0]
    floor = np.array(task.layout.free)

    def cell(field: str) -> tuple[int, int]:
        place = task.layout.grid(state[task.state_slices[field]][:2])
        row, column = floor[np.square(floor - place).sum(axis=1).argmin()]
        return int(row), int(column)

    return cell("walker_position"), cell("target_position")


__all__ = ["Cells", "GoalPairs", "goal_cells", "goal_pairs"]
