"""The log of a run, progress.jsonl: a line of JSON an evaluation."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmcvb_gen.files import write_text

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


def keep_rows(folder: Path, step: int) -> None:
    """Drop what was logged after `step`, at which the run goes on: it is made again."""
    kept = [row for row in read_rows(folder) if row["step"] <= step]
    write_text(folder / LOG, "".join(json.dumps(row) + "\n" for row in kept))


def add_row(folder: Path, row: Mapping[str, float | None]) -> None:
    """Log one evaluation; numbers that are not known are left out."""
    known = {name: value for name, value in row.items() if value is not None}
    with (folder / LOG).open("a") as file:
        file.write(json.dumps(known) + "\n")
