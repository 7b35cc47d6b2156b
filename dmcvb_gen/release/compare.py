"""Compare returns, lengths, successes and state numbers of the subsets that two releases have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dmcvb_gen.dataset import Release, Subset
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.release.statistics import read_states
from dmcvb_gen.tasks import get_task


@dataclass(frozen=True)
class Spread:
    """Mean, standard deviation and quartiles of `count` values; quartiles are None for numbers of the state."""

    count: int
    mean: float
    std: float
    p25: float | None = None
    median: float | None = None
    p75: float | None = None


@dataclass(frozen=True)
class Comparison:
    """One quantity of a subset in two releases.

    Attributes:
      quantity: "return" (of an episode), "length" (agent steps), "success" (share of episodes that reach their goal),
        or a number of the state: "orientations[3]".
      z: difference of the means in standard deviations of the first; None if the first does not vary.
    """

    subset: str
    quantity: str
    one: Spread
    other: Spread

    @property
    def z(self) -> float | None:
        return (self.other.mean - self.one.mean) / self.one.std if self.one.std > 0 else None


def compare(one: Release, other: Release) -> list[Comparison]:
    """Compare the data of the subsets that both releases have, `one` being the reference.

    Returns, lengths and successes come from all episodes; numbers of the state from the first 20 of each subset.

    Raises:
      DmcvbError: the releases have no subset in common, or states of a subset have other sizes.
    """
    names = [name for name in one if name in other and len(one[name].episodes) and len(other[name].episodes)]
    if not names:
        raise DmcvbError("the two releases have no subset in common: compare releases of the same tasks and levels")
    return [found for name in names for found in _subset(one[name], other[name])]


def _subset(one: Subset, other: Subset) -> Iterator[Comparison]:
    pair = (one, other)
    yield Comparison(one.name, "return", *(_spread(subset.returns) for subset in pair))
    yield Comparison(one.name, "length", *(_spread(subset.lengths) for subset in pair))
    task = get_task(one.task)
    if task.goal_geoms:
        yield Comparison(one.name, "success", *(_spread(subset.read("terminated"), False) for subset in pair))
    states = [np.concatenate(list(read_states(subset))).astype(np.float64) for subset in pair]
    if states[0].shape[1] != states[1].shape[1]:
        sizes = " and ".join(str(rows.shape[1]) for rows in states)
        raise DmcvbError(f"{one.name}: states have {sizes} numbers, so they cannot be compared")
    for field, columns in task.state_slices.items():
        for number, column in enumerate(range(columns.start, columns.stop)):
            quantity = f"{field}[{number}]" if columns.stop - columns.start > 1 else field
            yield Comparison(one.name, quantity, *(_spread(rows[:, column], False) for rows in states))


def _spread(values: np.ndarray, quartiles: bool = True) -> Spread:
    values = np.asarray(values, np.float64)
    points = np.percentile(values, (25, 50, 75)).tolist() if quartiles else ()
    return Spread(len(values), float(values.mean()), float(values.std()), *points)
