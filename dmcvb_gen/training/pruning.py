"""Choose the checkpoints of a long run that may be deleted, from its learning curve."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping

LIMIT = 240
"""Checkpoints up to which nothing is deleted."""
RECENT = 20
"""The newest checkpoints always stay."""
BINS = 100
"""Return levels that are told apart between the task's lowest and highest return."""
PER_BIN = 3
"""Earliest checkpoints kept at each return level."""
TEETH = 8
"""Checkpoints kept of every doubling of the agent step, evenly spaced. Mixed wants the multiples of a seventh of a step
that is not known before the run ends; none is then farther away than a sixteenth of that step."""


def prunable_checkpoints(
    curve: Mapping[int, float], return_range: tuple[float, float], limit: int = LIMIT
) -> list[int]:
    """Agent steps whose checkpoints no selection will want, whatever the run converges to later.

    Selection wants, for a return r that is not known before the run ends: the first checkpoint that reaches r, some
    after it in case fresh episodes disappoint, and checkpoints near r. So these stay: every checkpoint that was
    better than all before it (the first to reach any r is one of them), the earliest few at each level of return, a
    comb of training steps, and the newest. No more than `BINS * PER_BIN` checkpoints, the records, `TEETH` a doubling
    and `RECENT` are ever left.

    Args:
      curve: agent step -> return of the checkpoints that are there.
      return_range: lowest and highest return an episode can have; if they are not known, those of the curve count.
    """
    if len(curve) <= limit:
        return []
    low, high = return_range if all(map(math.isfinite, return_range)) else (min(curve.values()), max(curve.values()))
    width = (high - low) or 1.0
    steps, best, level = sorted(curve), float("-inf"), defaultdict(int)
    keep, teeth = set(steps[-RECENT:]), set()
    for step in steps:
        value = curve[step]
        if value > best:
            best = value
            keep.add(step)
        tooth = (step.bit_length(), (step * TEETH) >> max(step.bit_length() - 1, 0))
        if tooth not in teeth:
            teeth.add(tooth)
            keep.add(step)
        place = int(BINS * (value - low) / width)
        if level[place] < PER_BIN:
            level[place] += 1
            keep.add(step)
    return [step for step in steps if step not in keep]
