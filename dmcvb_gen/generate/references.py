"""Reference returns for normalized scores: 0 is what random actions return, 100 what the data's expert does."""

from __future__ import annotations

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.spec import FIXED

RANDOM_EPISODES, SEED, NAMES = 10, 0, ("reference",)
"""Episodes of uniform actions that are simulated if the release has none of its own."""


def reference_returns(release: Release, record: SubsetRecord, simulated: bool = True) -> tuple[float, float] | None:
    """(random, expert): mean returns of random actions and of the expert; None if one is unknown.

    Both of episodes that are cut where the subset's are. Those that its record names; else those of the release's own
    subsets of the same task and setting; else random actions are simulated, and the package's expert says what it was
    measured to return.

    Args:
      simulated: False takes what the release says alone, which needs no simulator.
    """
    if record.return_range is not None:
        return record.return_range
    low, high = (_own(release, record, level) for level in ("random", "expert"))
    if simulated and record.setting != FIXED:  # its pairs of start and goal have returns of their own
        high = _bundled(record) if high is None else high
        low = _simulated(record) if low is None and high is not None else low
    return None if low is None or high is None else (low, high)


def normalized(score: float, references: tuple[float, float] | None) -> float | None:
    """A mean return as a share of the way from random actions (0) to the expert (100); None without references."""
    if references is None or references[0] == references[1]:
        return None
    return 100 * (score - references[0]) / (references[1] - references[0])


def _own(release: Release, record: SubsetRecord, level: str) -> float | None:
    for subset in release.subsets.values():
        like = (subset.task, subset.level, subset.setting) == (record.task, level, record.setting)
        cut = (subset.record.max_steps, subset.record.action_repeat) == (record.max_steps, record.action_repeat)
        if like and cut and len(subset.returns):
            return float(subset.returns.mean())
    return None


def _simulated(record: SubsetRecord) -> float:
    from dmcvb_gen.policies.actor import RandomPolicy
    from dmcvb_gen.policies.simulate import simulate
    from dmcvb_gen.tasks import get_task

    task, names = get_task(record.task).at(record.action_repeat), (*NAMES, record.task)
    episodes = list(range(RANDOM_EPISODES))
    found = simulate(task, [RandomPolicy(task)], episodes, SEED, names, max_steps=record.max_steps)
    return float(found.reward.astype("float64").sum(axis=1).mean())


def _bundled(record: SubsetRecord) -> float | None:
    from dmcvb_gen.policies.bundled import bundled_policies
    from dmcvb_gen.policies.policy_file import read_header
    from dmcvb_gen.tasks import ACTION_REPEAT, get_task

    try:
        whole = get_task(record.task).at(record.action_repeat).max_steps
        if record.action_repeat > ACTION_REPEAT or record.max_steps != whole:
            return None
        header = read_header(bundled_policies(record.task, "expert")[0])
    except DmcvbError:
        return None
    return header.evaluation.mean if header.evaluation else None
