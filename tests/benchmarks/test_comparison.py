"""Scores beside the paper's: made-up results whose ratios and rank correlations are known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.agents.data import Slice
from dmcvb_gen.benchmarks.plan import BUDGETS, Cell
from dmcvb_gen.benchmarks.report import comparison

QUICK = BUDGETS["quick"]


def beside(task, agent, share, paper, spread=0.0, limit=500):
    """A cell on expert/none whose data returned 100, and which returned that share of it at three starts."""
    cell = Cell("b1", task, "none", parse_agent(agent), (Slice(f"{task}/expert/none"),))
    returns = [100 * (share - spread), 100 * share, 100 * (share + spread)]
    score = {"returns": returns, "mean": float(np.mean(returns)), "stderr": 1.0, "limit": limit}
    paper = paper and {"mean": paper, "stderr": 1}
    return cell, {"score": score, "data": {"mean": 100.0, "limit": 500}, "paper": paper}


SHARES = {"bc": (0.9, 900), "id+bc": (0.7, 800), "ae+bc": (0.5, 500), "lfd+bc": (0.1, 60)}


def test_scores_ranked_as_the_papers_agree_and_reversed_ones_do_not():
    found = comparison(QUICK, [beside("walker-walk", agent, *values) for agent, values in SHARES.items()])
    assert found["ranks"] == [{"task": "walker-walk", "cells": 4, "rho": 1.0, "low": 1.0, "high": 1.0}]
    reverse = zip(SHARES, [0.1, 0.5, 0.7, 0.9], [paper for _, paper in SHARES.values()], strict=True)
    [rank] = comparison(QUICK, [beside("walker-walk", *row) for row in reverse])["ranks"]
    assert rank["rho"] == -1.0


def test_ratios_are_shares_of_the_data_and_rho_is_by_task_and_together():
    """By hand: walker's data returned 958, cheetah's 890, humanoid's 766 in the paper, ours 100 throughout."""
    papers = {"walker-walk": 958, "cheetah-run": 890, "humanoid-walk": 766}
    rows = [("bc", 0.9, 0.85), ("id+bc", 0.5, 0.6), ("ae+bc", 0.51, 0.3), ("lfd+bc", 0.1, 0.1)]
    results = [
        beside(task, agent, share, paper * data, spread=0.05)
        for task, data in papers.items()
        for agent, share, paper in rows
    ]
    found = comparison(QUICK, results)
    assert {round(row["paper_ratio"], 6) for row in found["cells"]} == {0.85, 0.6, 0.3, 0.1}
    assert found["cells"][0] == {
        "task": "walker-walk",
        "where": "expert none bc",
        "ours": pytest.approx(90),
        "stderr": 1.0,
        "paper": pytest.approx(0.85 * 958),
        "ratio": pytest.approx(0.9),
        "paper_ratio": pytest.approx(0.85),
    }
    ranks = {row["task"]: row for row in found["ranks"]}
    assert set(ranks) == {*papers, "all tasks"} and ranks["all tasks"]["cells"] == 12
    walker = ranks["walker-walk"]
    assert walker["rho"] == pytest.approx(0.8)  # one swap of neighbors of four: 1 - 6 * 2 / (4 * 15)
    assert walker["low"] <= 0.8 <= walker["high"] == 1.0


def test_noise_other_limits_and_cells_that_the_paper_lacks_are_not_compared():
    cells = [beside("walker-walk", agent, 0.5, 500) for agent in ("bc", "id+bc", "ae+bc")]
    assert len(comparison(QUICK, cells)["cells"]) == 3
    assert not comparison(BUDGETS["smoke"], cells)["cells"]
    assert not comparison(QUICK, [beside("walker-walk", "bc", 0.5, 500, limit=30)])["cells"]
    assert not comparison(QUICK, [beside("walker-walk", "bc", 0.5, None)])["cells"]
    assert not comparison(QUICK, cells[:1])["ranks"]  # one cell has no rank
