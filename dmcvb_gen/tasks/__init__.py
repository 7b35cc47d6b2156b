"""Tasks: `get_task("walker-walk")` gives the task of that name.

One table, `REGISTRY`, has the tasks that this package writes for a batch. Mazes are named by their layout, every other
task of dm_control's suite by "<domain>-<task>", and tasks of your own by "<module>:<function>" (see `own`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.own_code import allow, is_own
from dmcvb_gen.spec import MazeName, is_maze
from dmcvb_gen.tasks.ant_maze import ANT_MAZE_TASKS, ant_maze_task
from dmcvb_gen.tasks.ant_maze.layouts import load_layout
from dmcvb_gen.tasks.base import ACTION_REPEAT, PHYSICS_SPEC, Task
from dmcvb_gen.tasks.locomotion import CheetahRun, HumanoidWalk, WalkerWalk
from dmcvb_gen.tasks.own import own_task
from dmcvb_gen.tasks.suite import suite_ids, suite_task

REGISTRY: dict[str, Callable[[], Task]] = {task.id: task for task in (WalkerWalk, CheetahRun, HumanoidWalk)}
"""Task id -> what makes the task, called when it is first asked for."""

LOCOMOTION_TASKS = tuple(REGISTRY)


def task_ids() -> tuple[str, ...]:
    """The names of the tasks that are written for a batch, mazes included."""
    return LOCOMOTION_TASKS + ANT_MAZE_TASKS


def typed_task(given: str | Path | None) -> str:
    """The id of a task that a person typed, whose code may run; of a maze's text file, the id that holds its rows.

    Raises:
      DmcvbError: nothing was typed, or the file cannot be read, or is no maze.
    """
    if given is None:
        raise DmcvbError("give a TASK, or the text file of a maze")
    path = Path(given).expanduser()
    if path.suffix == ".txt" or path.is_file() and str(given) not in (*task_ids(), *suite_ids()):
        layout = load_layout(path)
        return str(MazeName(layout.name, layout.text))
    allow([str(given)])
    return str(given)


@functools.cache
def get_task(task_id: str) -> Task:
    """The task named `task_id`.

    Raises:
      UnknownNameError: no task has that name.
      DmcvbError: a task of your own, or of the suite, that cannot be used.
    """
    if task_id in REGISTRY:
        return REGISTRY[task_id]()
    if is_maze(task_id):
        return ant_maze_task(task_id)
    if is_own(task_id):
        return own_task(task_id)
    if task_id in suite_ids():
        return suite_task(task_id)
    raise UnknownNameError("task", task_id, (*task_ids(), *suite_ids()))


__all__ = [
    "ACTION_REPEAT",
    "ANT_MAZE_TASKS",
    "LOCOMOTION_TASKS",
    "PHYSICS_SPEC",
    "Task",
    "get_task",
    "suite_ids",
    "task_ids",
    "typed_task",
]
