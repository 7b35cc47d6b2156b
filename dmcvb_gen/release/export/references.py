"""Reference returns for normalized scores: those of random actions and of the expert."""

from __future__ import annotations

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.actor import random_policy
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import read_header
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.spec import FIXED
from dmcvb_gen.tasks import Task, get_task

RANDOM_EPISODES, SEED, NAMES = 10, 0, ("reference",)
"""Episodes of uniform actions that are simulated if the release has none of its own."""


def reference_returns(release: Release, record: SubsetRecord) -> dict[str, float]:
    """`ref_min_score` and `ref_max_score`: mean returns of random actions and of the expert; nothing if one is unknown.

    Both of episodes that are cut where the subset's are. Those of the release's own subsets of the same task and
    setting; else random actions are simulated, and the package's expert says what it was measured to return.
    """
    low, high = (_own(release, record, level) for level in ("random", "expert"))
    if record.setting != FIXED:  # its pairs of start and goal have returns of their own
        task = get_task(record.task).at(record.action_repeat)
        if high is None and record.max_steps == task.max_steps:
            high = _bundled(record.task)
        if low is None and high is not None:
            low = _simulated(task, record.max_steps)
    return {} if low is None or high is None else {"ref_min_score": low, "ref_max_score": high}


def _own(release: Release, record: SubsetRecord, level: str) -> float | None:
    for subset in release.subsets.values():
        like = (subset.task, subset.level, subset.setting) == (record.task, level, record.setting)
        cut = (subset.record.max_steps, subset.record.action_repeat) == (record.max_steps, record.action_repeat)
        if like and cut and len(subset.returns):
            return float(subset.returns.mean())
    return None


def _simulated(task: Task, max_steps: int) -> float:
    names = (*NAMES, task.id)
    found = simulate(task, [random_policy(task)], list(range(RANDOM_EPISODES)), SEED, names, max_steps=max_steps)
    return float(found.reward.astype("float64").sum(axis=1).mean())


def _bundled(task_id: str) -> float | None:
    try:
        header = read_header(bundled_policies(task_id, "expert")[0])
    except DmcvbError:
        return None
    return header.evaluation.mean if header.evaluation else None
