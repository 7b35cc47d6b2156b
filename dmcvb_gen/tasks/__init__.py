"""Tasks: `get_task("walker-walk")` gives the task of that name."""

from __future__ import annotations

import functools

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.names import ANT_MAZE, family_of
from dmcvb_gen.tasks.ant_maze import ANT_MAZE_TASKS, ant_maze_task
from dmcvb_gen.tasks.base import ACTION_REPEAT, PHYSICS_SPEC, EpisodeBatch, StepResult, Task
from dmcvb_gen.tasks.locomotion import CheetahRun, HumanoidWalk, WalkerWalk

_LOCOMOTION = {task.id: task for task in (WalkerWalk, CheetahRun, HumanoidWalk)}

LOCOMOTION_TASKS = tuple(_LOCOMOTION)


def task_ids() -> tuple[str, ...]:
    """The names that `get_task` takes."""
    return LOCOMOTION_TASKS + ANT_MAZE_TASKS


@functools.cache
def get_task(task_id: str) -> Task:
    """The task named `task_id`.

    Raises:
      UnknownNameError: no task has that name.
    """
    if task_id in _LOCOMOTION:
        return _LOCOMOTION[task_id]()
    if family_of(task_id) == ANT_MAZE:
        return ant_maze_task(task_id)
    raise UnknownNameError("task", task_id, task_ids())


__all__ = [
    "ACTION_REPEAT",
    "ANT_MAZE_TASKS",
    "LOCOMOTION_TASKS",
    "PHYSICS_SPEC",
    "EpisodeBatch",
    "StepResult",
    "Task",
    "get_task",
    "task_ids",
]
