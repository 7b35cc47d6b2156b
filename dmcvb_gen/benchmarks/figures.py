"""Draw the figures of a validation's page, as PNGs in data URLs."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dmcvb_gen.benchmarks.agreement import Pair
from dmcvb_gen.benchmarks.checks import comparable, known_returns
from dmcvb_gen.benchmarks.suites import Cell
from dmcvb_gen.dataset import Release
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.spec import task_folder

DPI = 110
COLUMNS = 3
"""Histograms side by side."""
HISTOGRAM_LINES, CURVE_LINES = 6, 6
"""Lines of a figure at most. More stand in further ones: laying a figure out takes time that grows with the square of
its axes, and beyond 65,536 pixels it cannot be drawn.
"""
FEW_RETURNS = 20
"""Fewer episodes are drawn as a mark each: bars would look like a distribution."""
NAME_BREAK = 26
"""Characters of a subset's name beyond which it stands on two lines."""


def data_url(png: bytes) -> str:
    """A PNG as a URL that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def figure_url(figure: Figure) -> str:
    """A figure as a PNG in a URL."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return data_url(buffer.getvalue())


def batched(values: Iterable, most: int) -> Iterator[list]:
    """The values in lists of `most`, the last one what is left."""
    rest = iter(values)
    while part := list(islice(rest, most)):
        yield part


def return_figures(release: Release) -> Iterator[Figure]:
    """Histograms of returns, the paper's quartiles and range as a box under each."""
    for part in batched(known_returns(release).items(), HISTOGRAM_LINES * COLUMNS):
        yield _return_figure(release, dict(part))


def _return_figure(release: Release, known: Mapping[str, np.ndarray]) -> Figure:
    columns = min(COLUMNS, len(known))
    lines = -(-len(known) // columns)
    figure = Figure(figsize=(4 * columns, 2.4 * lines), layout="constrained")
    for index, (name, returns) in enumerate(known.items()):
        axis = figure.add_subplot(lines, columns, index + 1)
        subset = release.subsets[name]
        few = len(returns) < FEW_RETURNS
        if few:
            axis.plot(returns, np.full(len(returns), 0.5), "|", color="#4477aa", markersize=14, markeredgewidth=2)
            axis.set_ylim(-0.25, 1)
        else:
            axis.hist(returns, bins=30, color="#4477aa")
            axis.yaxis.set_major_locator(MaxNLocator(integer=True))
        shown = name if len(name) <= NAME_BREAK else name.replace("/", "\n", 1)
        axis.set_title(shown, fontsize=9)
        axis.set(xlabel="return", ylabel="a mark an episode" if few else "episodes")
        paper = paper_returns(subset.task, subset.level) if comparable(subset) else None
        if paper:
            low = -0.12 * axis.get_ylim()[1]
            axis.plot([paper["min"], paper["max"]], [low, low], color="#cc6677", linewidth=1)
            axis.plot([paper["p25"], paper["p75"]], [low, low], color="#cc6677", linewidth=6, solid_capstyle="butt")
            axis.plot([paper["median"]], [low], "|", color="black", markersize=9)
            axis.set_yticks([tick for tick in axis.get_yticks() if tick >= 0])
            axis.set_title(f"{shown}\nbelow: the paper's range, quartiles, median", fontsize=8)
        if few:
            axis.set_yticks([])
    return figure


def curve_figures(results: Sequence[tuple[Cell, dict[str, Any]]], profile: str) -> Iterator[Figure]:
    """A row a group of cells (task, policy set, setting): losses on the left, online scores on the right."""
    groups: dict[tuple, list] = {}
    for cell, result in results:
        groups.setdefault((cell.benchmark, cell.task, cell.policy_label, cell.setting), []).append((cell, result))
    colors = {name: f"C{index}" for index, name in enumerate(dict.fromkeys(label_of(cell) for cell, _ in results))}
    for part in batched(groups.values(), CURVE_LINES):
        yield _curve_figure(part, colors, profile)


def _curve_figure(groups: Sequence[Sequence], colors: Mapping[str, str], profile: str) -> Figure:
    figure = Figure(figsize=(11, 2.8 * len(groups)), layout="constrained")
    for line, members in enumerate(groups):
        loss, score = (figure.add_subplot(len(groups), 2, 2 * line + column) for column in (1, 2))
        for cell, result in members:
            _draw_curve(loss, score, label_of(cell), colors[label_of(cell)], result["curve"])
        evaluated, data = members[0][1]["score"], members[0][1]["data"]
        if evaluated["limit"] == data["limit"]:  # else their returns cannot be compared
            score.axhline(data["mean"], color="gray", linestyle="--", linewidth=1, label="data")
        loss.set(
            title=f"{place_of(members[0][0])}: loss (test solid, training dotted)", xlabel="Adam step", yscale="log"
        )
        score.set(title=f"online return [{profile}]", xlabel="Adam step")
        if data["mean"] > 0:
            score.set_ylim(bottom=0)
        for axis in (loss, score):
            axis.title.set_fontsize(9)
            axis.set_xlim(left=0)
        score.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def agreement_figures(pairs: Sequence[Pair]) -> Iterator[Figure]:
    """Our scores over the paper's, both as shares of their data's return; none if no cell is in both."""
    if not pairs:
        return
    figure = Figure(figsize=(6, 5), layout="constrained")
    axis = figure.add_subplot()
    for task in dict.fromkeys(pair.task for pair in pairs):
        own = [pair for pair in pairs if pair.task == task]
        axis.scatter([pair.paper for pair in own], [pair.ours for pair in own], label=task, s=18)
    most = max(1.0, *(max(pair.paper, pair.ours) for pair in pairs))
    axis.plot([0, most], [0, most], color="gray", linestyle="--", linewidth=1, label="equal")
    axis.set(xlabel="the paper's score, share of its data", ylabel="our score, share of our data")
    axis.legend(fontsize=8)
    yield figure


def label_of(cell: Cell) -> str:
    """A cell among those of its task and policy set: its agent, and what else its encoder learned from."""
    return f"{cell.agent.name} (encoder: {cell.pretrain_label})" if cell.pretrain else cell.agent.name


def place_of(cell: Cell) -> str:
    """A cell's task, policy set and setting."""
    return f"{task_folder(cell.task)}/{cell.policy_label}/{cell.setting}"


def _draw_curve(loss, score, label: str, color: str, curve: list[dict[str, Any]]) -> None:
    for name, style in (("loss", ":"), ("test_loss", "-")):
        points = [(point["step"], point[name]) for point in curve if name in point]
        if points:
            loss.plot(*zip(*points, strict=True), style, color=color, linewidth=1)
    points = [(p["step"], p["score"]["mean"], p["score"]["stderr"]) for p in curve if "score" in p]
    steps, means, errors = zip(*points, strict=True)
    score.errorbar(steps, means, errors, marker="o", markersize=3, color=color, label=label)
