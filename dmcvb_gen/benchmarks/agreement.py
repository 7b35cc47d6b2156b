"""Compare the order of a report's scores with the paper's: Spearman's rho with its interval.

A score is taken as a share of its data's mean return, ours of our data and the paper's of the paper's, so that tasks
and levels compare. The interval is a stratified bootstrap: starts are drawn again within each cell, as rliable does
(Agarwal et al. 2021), each with the mean of the seeds, which all drive from the same starts. It is scipy's, as rliable
1.2.0 gives arch 7 an argument that it refuses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.benchmarks.paper import paper_score

SAMPLES = 2_000
"""Samples of the bootstrap."""
FEWEST = 3
"""Cells below which a rank correlation says nothing."""
ALL = "all tasks"


@dataclass(frozen=True)
class Pair:
    """A cell that both the report and the paper have.

    Attributes:
      task, where: the task; level, setting and agent.
      returns: (start,) returns of our episodes as shares of our data's mean return, the mean of the seeds.
      paper: the paper's score as a share of the paper's data.
    """

    task: str
    where: str
    returns: np.ndarray
    paper: float

    @property
    def ours(self) -> float:
        return float(self.returns.mean())


@dataclass(frozen=True)
class Agreement:
    """Spearman's rho of the cells of a task, or of all.

    Attributes:
      cells: number of cells. low, high: ends of its 95 % interval.
    """

    task: str
    cells: int
    rho: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.rho:.2f} [{self.low:.2f}, {self.high:.2f}] over {self.cells} cells"


def shared_cells(results: Iterable[Mapping[str, Any]]) -> list[Pair]:
    """The cells of B1 that the paper's table has, too; seeds together. Profiles without scores have none."""
    found: dict[tuple[str, str], tuple[list[np.ndarray], float]] = {}
    for result in results:
        cell = result["cell"]
        task, label, setting = cell["task"], cell["policy_label"], cell["setting"]
        data = paper_score(task, label, setting, "data")
        if not (result["profile"]["scores"] and result.get("paper") and data) or result["data"]["mean"] <= 0:
            continue
        if result["score"].get("limit") != result["data"].get("limit"):
            continue  # returns of episodes that were cut elsewhere
        returns = np.array(result["score"]["returns"]) / result["data"]["mean"]
        paper = result["paper"]["mean"] / data[0]
        found.setdefault((task, f"{label} {setting} {cell['agent_name']}"), ([], paper))[0].append(returns)
    return [Pair(task, where, np.mean(returns, axis=0), paper) for (task, where), (returns, paper) in found.items()]


def rank_agreement(pairs: Sequence[Pair], seed: int = 0) -> list[Agreement]:
    """Spearman's rho of each task, and of all together if there are several."""
    tasks = list(dict.fromkeys(pair.task for pair in pairs))
    groups = {task: [pair for pair in pairs if pair.task == task] for task in tasks}
    groups |= {ALL: list(pairs)} if len(tasks) > 1 else {}
    return [_agreement(task, group, seed) for task, group in groups.items() if len(group) >= FEWEST]


def _agreement(task: str, pairs: Sequence[Pair], seed: int) -> Agreement:
    from scipy.stats import bootstrap, spearmanr  # takes a second, which other reports need not wait for

    returns, paper = [pair.returns for pair in pairs], [pair.paper for pair in pairs]

    def rho(*returns: np.ndarray) -> float:
        ours = [of_cell.mean() for of_cell in returns]
        return float(np.nan_to_num(spearmanr(ours, paper).statistic))  # all alike: no order, so no agreement

    drawn = bootstrap(returns, rho, vectorized=False, n_resamples=SAMPLES, method="percentile", random_state=seed)
    low, high = drawn.confidence_interval
    return Agreement(task, len(pairs), rho(*returns), float(low), float(high))
