"""Tasks: `get_task("walker-walk")` gives the task of that name.

One table, `REGISTRY`, has the tasks that this package writes for a batch; third parties add theirs under the entry
point group `dmcvb_gen.tasks`. Mazes are named by their layout, every other task of dm_control's suite by
"<domain>-<task>", and tasks of your own by "<module>:<function>" (see `own`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib import metadata

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.own_code import is_own
from dmcvb_gen.spec import is_maze
from dmcvb_gen.tasks.ant_maze import ANT_MAZE_TASKS, ant_maze_task
from dmcvb_gen.tasks.base import ACTION_REPEAT, ACTION_REPEATS, PHYSICS_SPEC, EpisodeBatch, StepResult, Task
from dmcvb_gen.tasks.locomotion import CheetahRun, HumanoidWalk, WalkerWalk
from dmcvb_gen.tasks.own import own_task
from dmcvb_gen.tasks.suite import REFUSED, suite_ids, suite_task

ENTRY_POINTS = "dmcvb_gen.tasks"
"""Entry point group of other packages: the name is a task id, the object a function that gives the `Task`."""

REGISTRY: dict[str, Callable[[], Task]] = {task.id: task for task in (WalkerWalk, CheetahRun, HumanoidWalk)}
"""Task id -> what makes the task, called when it is first asked for."""

LOCOMOTION_TASKS = tuple(REGISTRY)


def register_task(task_id: str, make: Callable[[], Task]) -> None:
    """Add a task for this process.

    Raises:
      DmcvbError: there is another task of that name.
    """
    if task_id in all_task_ids() and REGISTRY.get(task_id) is not make:
        raise DmcvbError(f"there is a task {task_id!r} already; give yours another name")
    REGISTRY[task_id] = make


def check_in_workers(task_id: str) -> None:
    """Raises DmcvbError for a task that worker processes do not know."""
    if task_id in REGISTRY and task_id not in LOCOMOTION_TASKS:
        raise DmcvbError(
            f"task {task_id} is registered in this process alone; use workers=1, name it <module>:<function>, or give "
            f"your package an entry point {ENTRY_POINTS}"
        )


def task_ids() -> tuple[str, ...]:
    """The names of the tasks that are written for a batch, mazes included."""
    return LOCOMOTION_TASKS + ANT_MAZE_TASKS


def all_task_ids() -> tuple[str, ...]:
    """All names that `get_task` takes, but those of tasks and layouts of your own."""
    return tuple(dict.fromkeys([*task_ids(), *REGISTRY, *_entry_points(), *suite_ids()]))


@functools.cache
def _entry_points() -> dict[str, metadata.EntryPoint]:
    return {point.name: point for point in metadata.entry_points(group=ENTRY_POINTS)}


def _checked(task_id: str, task: object) -> Task:
    if not isinstance(task, Task):
        raise DmcvbError(f"task {task_id} is a {type(task).__name__}; register a function that returns a Task")
    return task


@functools.cache
def get_task(task_id: str) -> Task:
    """The task named `task_id`.

    Raises:
      UnknownNameError: no task has that name.
      DmcvbError: a task of your own, or of the suite, that cannot be used.
    """
    if task_id in REGISTRY:
        return _checked(task_id, REGISTRY[task_id]())
    if is_maze(task_id):
        return ant_maze_task(task_id)
    if is_own(task_id):
        return own_task(task_id)
    if task_id in _entry_points():
        return _checked(task_id, _entry_points()[task_id].load()())
    if task_id in suite_ids():
        return suite_task(task_id)
    if task_id in REFUSED:
        raise DmcvbError(f"{task_id} cannot be used: {REFUSED[task_id]}")
    raise UnknownNameError("task", task_id, all_task_ids())


__all__ = [
    "ACTION_REPEAT",
    "ACTION_REPEATS",
    "ANT_MAZE_TASKS",
    "LOCOMOTION_TASKS",
    "PHYSICS_SPEC",
    "EpisodeBatch",
    "StepResult",
    "Task",
    "all_task_ids",
    "check_in_workers",
    "get_task",
    "register_task",
    "suite_ids",
    "task_ids",
]
