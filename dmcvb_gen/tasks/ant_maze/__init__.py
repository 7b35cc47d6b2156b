"""Make the tasks of ant mazes from their ids.

"ant-maze-empty7x7" is one of DMC-VB's layouts; "ant-maze-mine:*****/*...*/*****" carries a layout of its own.
"""

from __future__ import annotations

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.spec import MazeName
from dmcvb_gen.tasks.ant_maze.layouts import LAYOUTS, fixed_pairs, get_layout, make_layout
from dmcvb_gen.tasks.ant_maze.task import AntMaze
from dmcvb_gen.tasks.base import Task

ANT_MAZE_TASKS = tuple(str(MazeName(layout)) for layout in LAYOUTS)


def ant_maze_task(task_id: str) -> AntMaze:
    """The task of an id.

    Raises:
      UnknownNameError, LayoutError: no such layout, or a layout that cannot be used.
    """
    name = MazeName.parse(task_id)
    if not name or (not name.rows and name.layout not in LAYOUTS):
        raise UnknownNameError("task", task_id, ANT_MAZE_TASKS)
    layout = make_layout(name.layout, name.rows) if name.rows else get_layout(name.layout)
    return AntMaze(layout, task_id)


def as_maze(task: Task) -> AntMaze:
    """A task that must be a maze, with its layout.

    Raises:
      DmcvbError: it is none.
    """
    if not isinstance(task, AntMaze):
        raise DmcvbError(f"{task.id} is no maze; give one of {', '.join(ANT_MAZE_TASKS)} or a layout of your own")
    return task


__all__ = [
    "ANT_MAZE_TASKS",
    "LAYOUTS",
    "AntMaze",
    "ant_maze_task",
    "as_maze",
    "fixed_pairs",
]
