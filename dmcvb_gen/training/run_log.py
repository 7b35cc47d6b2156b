"""The log of a run: it writes evaluations to progress.csv and TensorBoard.

`progress.csv` has a row an evaluation.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Mapping
from pathlib import Path

from dmcvb_gen.files import remove_partial, replacing
from dmcvb_gen.policies.header import Evaluation

COLUMNS = ("step", "seconds", "return_mean", "return_std", "success", "speed", "alpha", "updates")
"""Agent steps; seconds of training; returns of the evaluation's episodes; share of episodes that the task ended and
their mean speed (mazes); the entropy's weight; gradient updates. What an algorithm does not have is left empty."""


def read_rows(folder: str | Path) -> list[dict[str, str]]:
    """Rows of a run's progress.csv, in order of steps.

    A line that a killed process left half written, or that is being written, is left out.
    """
    path, rows = Path(folder) / "progress.csv", {}
    if not path.exists():
        return []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            try:
                float(row["return_std"]), float(row["return_mean"])  # the line goes on behind them
                rows[int(row["step"])] = {name: row.get(name) or "" for name in COLUMNS}
            except (KeyError, TypeError, ValueError):
                continue
    return [rows[step] for step in sorted(rows)]


def _write(file, rows) -> None:
    csv.DictWriter(file, COLUMNS, lineterminator="\n").writerows(rows)


class RunLog:
    """Appends to the logs of a run that goes on at `step`; what was logged after it is made again."""

    def __init__(self, folder: Path, step: int):
        from torch.utils.tensorboard import SummaryWriter

        self._path = folder / "progress.csv"
        rows = [row for row in read_rows(folder) if int(row["step"]) <= step]
        remove_partial(folder)  # of a process that was killed
        with replacing(self._path) as temporary, temporary.open("w", newline="") as file:
            csv.DictWriter(file, COLUMNS, lineterminator="\n").writeheader()
            _write(file, rows)
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)

    def add(
        self, step: int, evaluation: Evaluation, seconds: float, updates: int, metrics: Mapping[str, float]
    ) -> None:
        """Log one evaluation and the learner's own numbers (`temperature` goes into the CSV too)."""
        known = {"return_mean": evaluation.mean, "return_std": evaluation.std}
        known |= {"success": evaluation.success, "speed": evaluation.speed, "alpha": metrics.get("temperature")}
        known = {name: value for name, value in known.items() if value is not None}
        row = dict.fromkeys(COLUMNS, "") | {name: f"{value:.6g}" for name, value in known.items()}
        row |= {"step": step, "seconds": round(seconds, 1), "updates": updates}
        with self._path.open("a", newline="") as file:
            _write(file, [row])
        for name, value in known.items():
            if name != "alpha":
                self._board.add_scalar(f"evaluation/{name}", value, step)
        for name, value in metrics.items():
            self._board.add_scalar(f"training/{name}", value, step)
        self._board.add_scalar("training/steps_per_second", step / max(seconds, 1e-9), step)
        self._board.flush()

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a full disk has been reported where it was met
            self._board.close()
