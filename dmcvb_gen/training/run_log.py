"""The log of a run, progress.jsonl: a line of JSON an evaluation."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmcvb_gen.files import write_text
from dmcvb_gen.policies.header import Evaluation

LOG = "progress.jsonl"


def read_rows(folder: str | Path) -> list[dict[str, Any]]:
    """The lines of a run's log; without one that a killed process left half written, or that is being written.

    A line has step (agent steps), seconds (of training), updates (of gradients), return_mean and return_std, of mazes
    success and speed, and the learner's own numbers.
    """
    path, rows = Path(folder) / LOG, []
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(ValueError):
            rows.append(json.loads(line))
    return rows


class RunLog:
    """Appends to the log of a run that goes on at `step`; what was logged after it is made again."""

    def __init__(self, folder: Path, step: int):
        self._path = folder / LOG
        kept = [row for row in read_rows(folder) if row["step"] <= step]
        write_text(self._path, "".join(json.dumps(row) + "\n" for row in kept))

    def add(
        self, step: int, evaluation: Evaluation, seconds: float, updates: int, metrics: Mapping[str, float]
    ) -> None:
        """Log one evaluation, and the learner's own numbers."""
        row = {"step": step, "seconds": round(seconds, 1), "updates": updates}
        row |= {"return_mean": evaluation.mean, "return_std": evaluation.std}
        row |= {"success": evaluation.success, "speed": evaluation.speed, **metrics}
        known = {name: value for name, value in row.items() if value is not None}
        with self._path.open("a") as file:
            file.write(json.dumps(known) + "\n")
