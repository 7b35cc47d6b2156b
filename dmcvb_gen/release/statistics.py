"""Mean and spread of every number of a release's states, as a file of its card."""

from __future__ import annotations

import json
from itertools import islice

import numpy as np

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.tasks import get_task

EPISODES = 20
"""Number of first episodes of a task and level that are read, so that memory does not grow with the release."""


def states_json(release: Release) -> str:
    """Task -> steps, and mean and standard deviation of each field's numbers; as JSON.

    Of each task and level, the first setting counts: settings share trajectories or resemble each other.
    """
    firsts = {(subset.task, subset.level): subset for subset in reversed(release.subsets.values())}
    episodes: dict[str, list[np.ndarray]] = {}
    for subset in release.subsets.values():
        if firsts[subset.task, subset.level] is subset:
            read = islice(subset.each_episode(["state"]), EPISODES)
            episodes.setdefault(subset.task, []).extend(values["state"] for _, values in read)
    tasks = {}
    for name, rows in episodes.items():
        states = np.concatenate(rows).astype(np.float64)
        mean, std, fields = _rounded(states.mean(0)), _rounded(states.std(0)), get_task(name).state_slices
        numbers = {field: {"mean": mean[place], "std": std[place]} for field, place in fields.items()}
        tasks[name] = {"steps": len(states), "fields": numbers}
    return json.dumps(tasks, indent=1) + "\n"


def _rounded(values: np.ndarray) -> list[float]:
    """Round to five digits, because the order of a sum, and so the last digits, may differ between machines."""
    return [float(f"{value:.5g}") for value in values]
