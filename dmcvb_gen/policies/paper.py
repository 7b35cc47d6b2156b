"""The paper's table of episode returns by task and level."""

from __future__ import annotations

import csv
import functools
from importlib import resources

from dmcvb_gen.spec import MazeName

MAZE_GROUPS = {"empty": "ant-maze/empty", "easy": "ant-maze/single-obstacle", "medium": "ant-maze/multi-obstacle"}
"""Layout's difficulty -> the paper's row, which pools the layouts of a difficulty."""


@functools.cache
def read_table(package: str, name: str, keys: int) -> dict[tuple[str, ...], dict[str, float]]:
    """The rows of a table of the paper, by their first columns.

    Args:
      name: of a CSV file in the folder `data` of `package`; lines that begin with # are comments.
      keys: number of the columns that name a row; the others are numbers.
    """
    text = (resources.files(package) / "data" / name).read_text()
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    places = [(tuple(row.values())[:keys], list(row.items())[keys:]) for row in rows]
    return {place: {column: float(value) for column, value in values} for place, values in places}


def paper_task(task_id: str) -> str:
    """The name of a task's row: the paper's mazes are pooled by difficulty."""
    maze = MazeName.parse(task_id)
    if not maze or maze.rows:
        return task_id
    return next((row for difficulty, row in MAZE_GROUPS.items() if maze.layout.startswith(difficulty)), task_id)


def paper_returns(task_id: str, level: str) -> dict[str, float] | None:
    """Steps, mean, std, min, p25, median, p75, max of the paper's episode returns; None if it has no row."""
    table = read_table("dmcvb_gen.policies", "paper_episode_returns.csv", 2)
    row = table.get((paper_task(task_id), level))
    return dict(row) if row else None


def medium_return(task_id: str) -> float | None:
    """The mean return that a maze's medium policy is to have; None if medium is half of the way to convergence.

    The paper says of medium that it has half of the expert's return, which negative returns leave without a meaning;
    its table of the data's episode rewards (appendix "Reward Distribution"; our data/paper_episode_returns.csv) has a
    row a group of layouts: -172.2 empty, -131.1 single-obstacle, -176.0 multi-obstacle, over episodes of 600 steps.
    """
    row = paper_returns(task_id, "medium") if paper_task(task_id) in MAZE_GROUPS.values() else None
    return row["mean"] if row else None
