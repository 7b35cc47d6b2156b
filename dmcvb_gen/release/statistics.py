"""Statistics of a release: mean and spread of every state number, and how the policies of each level move."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import mujoco
import numpy as np

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import Task

EPISODES = 20
"""Number of first episodes of a task and level that are read, so that memory does not grow with the release."""
HEIGHTS = ("height", "head_height", "body_height")
"""State fields with the height of the body; a task has one of them or none."""
POSITION, VELOCITY = "walker_position", "velocity"
"""State fields with the position of the root (mazes), and the velocities of all joints, MuJoCo's qvel (other tasks)."""


@dataclass(frozen=True)
class StateStatistics:
    """Every number of a task's state, over all levels.

    Attributes:
      steps: number of observations.
      mean, std: (state,) float64.
      fields: field -> its columns.
    """

    task: str
    steps: int
    mean: np.ndarray
    std: np.ndarray
    fields: dict[str, slice]


@dataclass(frozen=True)
class LevelStatistics:
    """Motion statistics of the policies of a level.

    Attributes:
      subset: name of the subset whose first `EPISODES` episodes they are of.
      speed: mean horizontal speed of the root, m/s; None if the task has no root that moves.
      height: mean height of body or head in meters; None if the state has none.
      success: share of all episodes of the subset that reached their goal; None for tasks without one.
    """

    task: str
    level: str
    subset: str
    episodes: int
    speed: float | None
    height: float | None
    success: float | None


def _trajectories(release: Release) -> dict[tuple[str, str], Subset]:
    """(task, level) -> the first subset with episodes of it; settings share trajectories or resemble each other."""
    found: dict[tuple[str, str], Subset] = {}
    for subset in release.subsets.values():
        if len(subset.episodes):
            found.setdefault((subset.task, subset.level), subset)
    return found


def _episodes(subset: Subset, name: str) -> Iterable[np.ndarray]:
    """Observations of an array, episode by episode, the last one included: (length + 1, ...)."""
    for _, values in islice(subset.each_episode([name]), EPISODES):
        yield values[name]


def state_statistics(release: Release) -> list[StateStatistics]:
    """Statistics of the states of every task of a release, in its order."""
    tasks: dict[str, list[np.ndarray]] = {}
    for (task, _), subset in _trajectories(release).items():
        tasks.setdefault(task, []).extend(np.asarray(rows, np.float64) for rows in _episodes(subset, "state"))
    out = []
    for name, episodes in tasks.items():
        states = np.concatenate(episodes)
        out.append(StateStatistics(name, len(states), states.mean(0), states.std(0), get_task(name).state_slices))
    return out


def states_json(release: Release) -> str:
    """`state_statistics` as a file: task -> steps, and mean and std of each field's numbers."""
    tasks = {
        states.task: {
            "steps": states.steps,
            "fields": {
                field: {"mean": _rounded(states.mean[place]), "std": _rounded(states.std[place])}
                for field, place in states.fields.items()
            },
        }
        for states in state_statistics(release)
    }
    return json.dumps(tasks, indent=1) + "\n"


def _rounded(values: np.ndarray) -> list[float]:
    """Round to five digits, because the order of a sum, and so the last digits, may differ between machines."""
    return [float(f"{value:.5g}") for value in values]


def level_statistics(release: Release) -> list[LevelStatistics]:
    """Statistics of every task and level of a release, in its order."""
    out = []
    for (name, level), subset in _trajectories(release).items():
        task = get_task(name)
        field = next((task.state_slices[height] for height in HEIGHTS if height in task.state_slices), None)
        height = None
        if field is not None:
            height = float(np.concatenate([rows[:, field] for rows in _episodes(subset, "state")]).mean())
        success = float(subset.read("terminated").mean()) if task.goal_geoms else None
        count = len(subset.episodes[:EPISODES])
        out.append(LevelStatistics(name, level, subset.name, count, _speed(task, subset), height, success))
    return out


def _speed(task: Task, subset: Subset) -> float | None:
    """Mean horizontal speed of the root over all steps in m/s; from the states if there are no physics states."""
    columns, states = _root_columns(task.model), task.state_slices
    if columns is None:
        return None
    position, velocity = columns
    if "physics" in subset.arrays:
        moved = _moved(subset, "physics", 1 + position)  # time comes first
    elif POSITION in states:
        moved = _moved(subset, "state", states[POSITION].start + np.arange(2))
    else:
        fields = states[VELOCITY].start + velocity
        return _mean_length([rows[:, fields] for rows in _episodes(subset, "state")])
    return _mean_length(moved) / (subset.record.seconds_per_step)


def _moved(subset: Subset, name: str, columns: np.ndarray) -> list[np.ndarray]:
    """Return how far columns of an array move in each step, episode by episode: (length, column)."""
    return [np.diff(rows[:, columns], axis=0) for rows in _episodes(subset, name) if len(rows) > 1]


def _mean_length(vectors: list[np.ndarray]) -> float:
    return float(np.sqrt((np.concatenate(vectors) ** 2).sum(axis=1)).mean())


def _root_columns(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the root's horizontal motion in qpos and qvel: x and y of a free joint, or the slides along x and y.

    The root is the first body with a joint. None if it has neither (a finger, an arm that is fixed to its base).
    """
    joints = np.flatnonzero(model.jnt_bodyid == model.jnt_bodyid[0]) if model.njnt else np.array([], int)
    positions, velocities = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    free = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_FREE
    if free.any():
        return positions[free][0] + np.arange(2), velocities[free][0] + np.arange(2)
    slides = (model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE) & model.jnt_axis[joints][:, :2].any(axis=1)
    return (positions[slides], velocities[slides]) if slides.any() else None
