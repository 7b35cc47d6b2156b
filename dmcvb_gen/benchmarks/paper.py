"""The paper's scores of benchmark 1: means and standard errors by task, level, distractor and agent."""

from __future__ import annotations

import csv
import functools
from importlib import resources


@functools.cache
def _table() -> dict[tuple[str, str, str, str], tuple[float, float]]:
    path = resources.files("dmcvb_gen.benchmarks") / "data" / "paper_benchmark1_locomotion.csv"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return {
        (row["task"], row["level"], row["distractor"], row["agent"]): (float(row["mean"]), float(row["stderr"]))
        for row in csv.DictReader(lines)
    }


def paper_score(task: str, level: str, setting: str, agent: str | None) -> tuple[float, float] | None:
    """(mean, standard error) of the published score; None if the paper has none.

    Args:
      level: "expert", ..., or "expert+medium".
      setting: "none", "static" or "dynamic" at the paper's difficulty; BC(state) and data have one row for all.
      agent: a column of the paper's table, `Agent.paper_name`, or "data".
    """
    table = _table()
    return table.get((task, level, setting, agent or "")) or table.get((task, level, "any", agent or ""))
