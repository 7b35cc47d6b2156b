"""Validate a release: check it, run benchmarks on it, and write one page about it all.

The page is self-contained HTML; all facts lie beside it as JSON. It shows the results that lie in
cells/ with the fingerprint of this release and budget; another release or budget means another folder.
Wherever a score stands, the budget that made it stands beside it.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import io
import json
import math
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.agents.trainer import Budget
from dmcvb_gen.benchmarks.checks import Structure, comparable, known_returns, normalized_score
from dmcvb_gen.benchmarks.plan import BENCHMARKS, Cell, Missing, Results, only, paper_score, plan_benchmark
from dmcvb_gen.dataset.environment import environment
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import write_json, write_text
from dmcvb_gen.generate.info import STATISTICS, return_statistics
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.spec import task_folder
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import pluralize
from dmcvb_gen.version import __version__

CHECKS = {
    "files": "every file has its bytes and digest",
    "shapes": "arrays have their shapes and types",
    "lengths": "lengths, discounts and ends agree",
    "finite": "all values are finite",
    "actions": "actions lie in their bounds",
    "returns": "returns are the sums of the rewards, in range, and as the policies' files say",
    "duplicates": "no two episodes are the same",
    "states": "physics states give the stored states",
    "rewards": "physics gives the stored rewards",
    "physics": "stored actions lead to the stored physics states",
    "pixels": "sampled frames render to the stored ones",
    "pictures": "no black or one-colored images",
    "modalities": "depth, segmentation and the like, if stored, are what the states show",
}
"""Check -> what it says when it passes. Checks of later versions are listed under their own names."""
SHOWN = 200
"""Findings on the page; the JSON file has all."""
SAMPLES = 2_000
"""Samples of the bootstrap."""
FEWEST = 3
"""Cells below which a rank correlation says nothing."""
DPI = 110


# -- the validation ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Validation:
    """Result of a validation.

    Attributes:
      structure: result of the structure checks.
      results: (cell, result) of every cell that was asked for; a result of {"error": ...} failed.
      complete: True if every episode is there.
      report: the page.
    """

    structure: Structure
    results: tuple[tuple[Cell, dict[str, Any]], ...]
    warnings: tuple[Issue, ...]
    complete: bool
    report: Path

    @property
    def facts(self) -> Path:
        """The JSON file beside the page."""
        return self.report.with_suffix(".json")

    @property
    def failed(self) -> tuple[tuple[Cell, str], ...]:
        return tuple((cell, result["error"]) for cell, result in self.results if "error" in result)

    @property
    def sound(self) -> bool:
        """True if the release is sound and every cell could be run."""
        return self.structure.sound and not self.failed


def plan_validation(
    release: Release, benchmarks: Sequence[str], agents: Sequence[str], patterns: Sequence[str]
) -> tuple[Release, list[Cell], list[Missing]]:
    """The subsets that are asked for, the cells of the benchmarks on them, and what is missing for others.

    Raises:
      DmcvbError: a name is unknown, or there are no data for a benchmark.
    """
    chosen = only(release, patterns)
    if not chosen.subsets:
        raise DmcvbError(f"{release.place} has no committed episodes yet; run the rollout first")
    cells: list[Cell] = []
    missing: list[Missing] = []
    for name in dict.fromkeys(benchmarks):
        found, lacking = plan_benchmark(name, chosen, agents)
        if not found:
            needs = [f"roll out {', '.join(m.subsets[:4])}" for m in lacking] or ["roll out another task"]
            cure = "let --only take more subsets" if patterns else "; ".join(needs)
            raise DmcvbError(f"benchmark {name} has no data in {chosen.place}; {cure}")
        cells += found
        missing += lacking
    used = {cell.agent for cell in cells}
    idle = [name for name in agents if (agent := parse_agent(name)).pretrain is None and agent not in used]
    if benchmarks and idle:
        raise DmcvbError(
            f"{' and '.join(benchmarks)}: agents with a pre-trained encoder are compared with bc, and "
            f"{idle[0]} has none; remove it, or add --benchmark b1"
        )
    return chosen, cells, missing


def claim_folder(out: str | Path, release: Release, budget: Budget, training: bool) -> None:
    """Make the report's folder, see that it takes files, and note whose results it holds; all before any work.

    Raises:
      DmcvbError: the folder cannot be made or written, or holds results of another release or budget.
    """
    folder = local_path(out)
    if release.store.folder and folder.resolve().is_relative_to(release.store.folder.resolve()):
        raise DmcvbError(f"{folder} lies in the release, which never changes; choose another --out")
    with storage_errors(folder, "write to"):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    mine, path = {"release": release.manifest.name, "budget": budget.facts()}, folder / "budget.json"
    there = mine
    with contextlib.suppress(OSError, ValueError):
        there = json.loads(path.read_text())
    if not (isinstance(there, dict) and {*mine} == {*there} and isinstance(there["budget"], dict)):
        raise DmcvbError(f"{path} is no note of a validation; give another --out")
    if there != mine:
        names = {f"budget.{name}" for name in mine["budget"] if there["budget"].get(name) != mine["budget"][name]}
        names |= {"release"} if there["release"] != mine["release"] else set()
        whose = "release {release}, profile {budget[name]}, seed {budget[seed]}".format(**there)
        raise DmcvbError(f"{out} holds results of {whose} (other {', '.join(sorted(names))}); give another --out")
    if training:
        with storage_errors(folder, "write to"):
            write_json(path, mine)


# -- facts ------------------------------------------------------------------------------------------


def write_report(folder: Path, facts: dict[str, Any], results: Results) -> Path:
    """Write report.html and .json into a folder; gives the path of the page.

    Raises:
      StoreError: they cannot be written.
    """
    page = folder / "report.html"
    good = [(cell, result) for cell, result in results if "error" not in result]
    with storage_errors(folder, "write to"):
        write_json(page.with_suffix(".json"), facts)
        write_text(page, render_page(facts, good, folder))
    return page


def report_facts(
    data: Release,
    release: Release,
    budget: Budget,
    structure: Structure,
    planned: int,
    results: Results,
    missing: Sequence[Missing],
    warnings: Sequence[Issue],
) -> dict[str, Any]:
    """Everything that the page says, as plain values.

    Args:
      data: the whole release, which `results` may be of. release: what was asked for of it.
    """
    failed = [{"cell": cell.id, "error": result["error"]} for cell, result in results if "error" in result]
    asked = {record.name: record.episodes for record in release.manifest.subsets}
    there = asked | {name: have for name, (have, _) in release.shortfalls.items()}
    return {
        "format": "dmcvb-gen validation",
        "generator": f"dmcvb-gen {__version__}",
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "release": {
            "name": release.manifest.name,
            "version": release.manifest.version,
            "digest": release.digest,
            "path": release.place,
        },
        "sound": structure.sound and not failed,
        "complete": there == asked,
        "episodes": {"there": sum(there.values()), "asked": sum(asked.values())},
        "incomplete": {name: [there[name], asked[name]] for name in asked if there[name] < asked[name]},
        "budget": dataclasses.asdict(budget),
        "structure": dataclasses.asdict(structure) | {"sound": structure.sound, "warnings": None},
        "warnings": [dataclasses.asdict(finding) for finding in warnings],
        "returns": {
            name: return_statistics(returns)
            | {"paper": paper_returns(subset.task, subset.level) if comparable(subset) else None}
            for name, returns in known_returns(release).items()
            for subset in [release[name]]
        },
        "cells_planned": planned,
        "failed": failed,
        "results": [
            result | compare(cell, results) | {"score": normalized_score(data, cell, result["score"])}
            for cell, result in results
            if "error" not in result
        ],
        "comparison": comparison(budget, results),
        "missing": [dataclasses.asdict(entry) for entry in missing],
        "versions": environment(),
    }


def compare(cell: Cell, results: Results) -> dict[str, Any]:
    """A score beside that of the cell's reference (`Benchmark.reference`).

    A share means something if 0 is the least that an episode can return; elsewhere (mazes: -800 is not "twenty
    times" -40) the difference stands.

    Returns:
      share: share of the reference's score; None if there is none.
      difference: from the reference's score; None if there is none.
      reference: words for what it refers to.
    """
    benchmark = BENCHMARKS.get(cell.benchmark)
    scores = {other: result["score"]["mean"] for other, result in results if "error" not in result}
    like = [other for other in scores if (other.benchmark, other.task) == (cell.benchmark, cell.task)]
    found = [scores[other] for other in like if benchmark.is_reference(other, cell)]
    shares = get_task(cell.task).return_range[0] >= 0
    share = difference = None
    if found:
        difference = scores[cell] - found[0]
        share = scores[cell] / found[0] if shares and found[0] > 0 else None
    return {"share": share, "difference": difference, "reference": benchmark.reference(cell)}


def comparison(budget: Budget, results: Results) -> dict[str, list[dict[str, Any]]]:
    """The cells of B1 that the paper's table has, too, and how alike they are ranked.

    A score is taken as a share of its data's mean return, ours of our data and the paper's of the paper's, so that
    tasks and levels compare. Cells whose episodes were cut elsewhere than the data's are left out.

    Returns:
      cells: task, where, ours, stderr, paper, ratio, paper_ratio. ranks: task, cells, rho, low, high: Spearman's rho of
      a task's cells and of all, with the ends of its 95 % interval, a stratified bootstrap over episodes as in rliable
      (Agarwal et al. 2021).
    """
    rows, shares = [], []
    for cell, result in results:
        data = paper_score(cell.task, cell.policy_label, cell.setting, "data")
        if not (budget.scores and data and result.get("paper")) or result["data"]["mean"] <= 0:
            continue
        score, whole = result["score"], result["data"]["mean"]
        if score["limit"] != result["data"]["limit"]:
            continue
        row = {"task": cell.task, "where": f"{cell.policy_label} {cell.setting} {cell.agent.name}"}
        row |= {"ours": score["mean"], "stderr": score["stderr"], "paper": result["paper"]["mean"]}
        rows.append(row | {"ratio": score["mean"] / whole, "paper_ratio": result["paper"]["mean"] / data[0]})
        shares.append(np.array(score["returns"]) / whole)
    groups = {task: [i for i, row in enumerate(rows) if row["task"] == task] for task in {r["task"]: 0 for r in rows}}
    groups |= {"all tasks": list(range(len(rows)))} if len(groups) > 1 else {}
    ranks = [
        {"task": task, "cells": len(group)}
        | rank_correlation([shares[i] for i in group], [rows[i]["paper_ratio"] for i in group])
        for task, group in groups.items()
        if len(group) >= FEWEST
    ]
    return {"cells": rows, "ranks": ranks}


def rank_correlation(returns: Sequence[np.ndarray], paper: Sequence[float], seed: int = 0) -> dict[str, float]:
    """Spearman's rho between the means of (episode,) returns and the paper's numbers, and its 95 % interval."""
    from scipy.stats import bootstrap, spearmanr  # takes a second, which other reports need not wait for

    def rho(*drawn: np.ndarray) -> float:
        ours = [of_cell.mean() for of_cell in drawn]
        return float(spearmanr(ours, paper).statistic) if len(set(ours)) > 1 else 0.0  # all alike: no order

    drawn = bootstrap(returns, rho, vectorized=False, n_resamples=SAMPLES, method="percentile", random_state=seed)
    low, high = drawn.confidence_interval
    return {"rho": rho(*returns), "low": float(low), "high": float(high)}


# -- the page ---------------------------------------------------------------------------------------


def render_page(facts: dict[str, Any], good: Results, folder: Path) -> str:
    """The page of a report, self-contained.

    Args:
      good: results of cells that did not fail. folder: the report's.
    """
    name = facts["budget"]["name"]
    loader = PackageLoader("dmcvb_gen.benchmarks", "data")
    jinja = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return jinja.get_template("report.html.jinja").render(
        facts | _tables(facts),
        curves=[figure_url(figure) for figure in curve_figures(good, name)],
        rollouts=list(_sheets(good, folder, "rollout")),
        decoders=list(_sheets(good, folder, "decoder")),
        inspection=list(_inspection(good)),
        times=[(result["id"], f"{result['seconds']:.0f}") for result in facts["results"]],
        settings=list(((facts["budget"] if facts["cells_planned"] else {}) | facts["versions"]).items()),
    )


def _tables(facts: Mapping[str, Any]) -> dict[str, Any]:
    return dict(
        verdict=verdict(facts),
        checks=_checks(facts["structure"]["findings"]),
        incomplete=[(name, *counts) for name, counts in facts["incomplete"].items()],
        findings=_listed(facts["structure"]["findings"]),
        warnings=_listed(facts["warnings"]),
        failed=[(entry["cell"], entry["error"]) for entry in facts["failed"]],
        returns=_returns(facts["returns"]),
        scores=[_scores(name, facts) for name in dict.fromkeys(r["cell"]["benchmark"] for r in facts["results"])],
        groups=_groups(facts),
        comparison=_comparison(facts["comparison"]),
        notes=_notes(facts),
        missing=[(m["benchmark"], ", ".join(m["subsets"])) for m in facts["missing"]],
    )


def verdict(facts: Mapping[str, Any]) -> dict[str, str]:
    """How a validation went, in a line: its kind (sound, incomplete, unsound) and its text."""
    checked = ", ".join(pluralize(count, what) for what, count in facts["structure"]["checked"].items())
    if facts["sound"]:
        text = f"All checks passed ({checked})."
    else:
        found, failed = len(facts["structure"]["findings"]), len(facts["failed"])
        text = f"Checks failed: {pluralize(found, 'findings')}, {pluralize(failed, 'failed cells')} ({checked})."
    if not facts["complete"]:
        text += " Incomplete: {there:,} of {asked:,} episodes.".format(**facts["episodes"])
    if facts["cells_planned"]:
        text += f" {len(facts['results'])} of {facts['cells_planned']} benchmark cells run [{facts['budget']['name']}]."
    else:
        text += " The data were checked; no agent was trained."
    text += f" {pluralize(len(facts['warnings']), 'warnings')}." if facts["warnings"] else ""
    return {"kind": ("sound" if facts["complete"] else "incomplete") if facts["sound"] else "unsound", "text": text}


def _checks(findings: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, int]]:
    counts = Counter(finding["check"] for finding in findings)
    return [(name, CHECKS.get(name, name), counts[name]) for name in dict.fromkeys([*CHECKS, *counts])]


def _listed(findings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    keys = ("check", "subset", "episode", "step", "message")
    rows = [[finding[key] for key in keys] for finding in findings[:SHOWN]]
    return {"rows": rows, "more": max(0, len(findings) - SHOWN)}


def _returns(returns: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    rows = []
    for name, ours in returns.items():
        for label, values in ((name, ours), ("the paper's", ours["paper"])):
            if values:
                rows.append([label, *(f"{values[key]:.1f}" for key in STATISTICS)])
    return {"head": ("subset", *STATISTICS), "rows": rows}


def _scores(benchmark: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """One benchmark's table: a row a task, policy set and setting, a column an agent."""
    results = [result for result in facts["results"] if result["cell"]["benchmark"] == benchmark]
    agents = list(dict.fromkeys(result["cell"]["agent"] for result in results))
    scores: dict[tuple, dict[str, list[str]]] = defaultdict(dict)
    by_state: dict[tuple, dict[str, list[str]]] = defaultdict(dict)
    data: dict[tuple, list[str]] = {}
    for result in results:
        cell = result["cell"]
        key = (task_folder(cell["task"]), result["labels"]["policy"], cell["setting"])
        data[key] = [_number(result["data"]["mean"]), *_goal_lines(result["data"])]
        lines = _score_lines(result, facts["budget"])
        scores[key][cell["agent"]] = scores[key].get(cell["agent"], []) + lines  # of each encoder
        if parse_agent(cell["agent"]).sees_state:
            by_state[key[:2]][cell["agent"]] = lines
    rows = []
    for key, known in scores.items():
        # States know of no distractors: one score stands beside those of every setting.
        known = by_state[key[:2]] | known
        rows.append({"facts": key, "data": data[key], "scores": [known.get(agent) for agent in agents]})
    head = ("task", "policy learns from", "setting", "the data's own", *agents)
    return {"title": BENCHMARKS.get(benchmark).title, "head": head, "rows": rows}


def _score_lines(result: Mapping[str, Any], budget: Mapping[str, Any]) -> list[str]:
    """An entry of a score table: mean and standard error with the budget, and further lines."""
    score = result["score"]
    lines = [f"{_number(score['mean'])} ± {_number(score['stderr'])} [{budget['name']}]"]
    if result["share"] is not None and budget["scores"]:
        lines.append(f"{100 * result['share']:.0f} % of {result['reference']}")
    elif result["difference"] and budget["scores"]:  # 0 is the reference itself
        side = "above" if result["difference"] > 0 else "below"
        lines.append(f"{_number(abs(result['difference']))} {side} {result['reference']}")
    if score["normalized"] is not None and budget["scores"]:
        lines.append(f"normalized {score['normalized']:.0f}")
    lines += _goal_lines(score)
    if result["labels"]["encoder"]:
        lines.append(f"encoder: {result['labels']['encoder']}")
    if budget["scores"] and (result["pretraining"] or {}).get("action_probe") is not None:
        lines.append(f"probe misses {100 * result['pretraining']['action_probe']:.0f} % of the actions' variance")
    return lines


def _goal_lines(score: Mapping[str, Any]) -> list[str]:
    """Success and speed, if a task has a goal."""
    if score["success"] is None:
        return []
    lines = [f"success {100 * score['success']:.0f} %"]
    return lines + [f"{score['speed']:.2f} m/s to the goal"] if score["speed"] is not None else lines


def _number(value: float) -> str:
    """A return: one decimal if that is worth something."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def _groups(facts: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Means that the paper gives: of mazes by their group of layouts (B1), of goal pairs by their maze (B3).

    The standard error takes the scores for independent.
    """
    groups: dict[tuple, list[Mapping[str, Any]]] = {}
    for result in facts["results"] if facts["budget"]["scores"] else ():
        cell = Cell.of(result["cell"])
        if group := BENCHMARKS.get(cell.benchmark).group(cell):
            groups.setdefault((cell.benchmark, *group, cell.setting, cell.label), []).append(result["score"])
    rows = []
    for key, scores in groups.items():
        mean = math.fsum(score["mean"] for score in scores) / len(scores)
        error = math.sqrt(math.fsum(score["stderr"] ** 2 for score in scores)) / len(scores)
        success = sum(score["success"] for score in scores) / len(scores)
        rows.append((*key, str(len(scores)), f"{_number(mean)} ± {_number(error)}", f"{100 * success:.0f} %"))
    return rows


def _comparison(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, list[tuple[str, ...]]]:
    cells = [
        (row["task"], row["where"], f"{_number(row['ours'])} ± {_number(row['stderr'])}", _number(row["paper"]))
        + (f"{row['ratio']:.2f}", f"{row['paper_ratio']:.2f}")
        for row in found["cells"]
    ]
    ranks = [
        (row["task"], str(row["cells"]), f"{row['rho']:.2f} [{row['low']:.2f}, {row['high']:.2f}]")
        for row in found["ranks"]
    ]
    return {"cells": cells, "ranks": ranks}


def _notes(facts: Mapping[str, Any]) -> list[str]:
    """Return the notes that a reader of the scores needs."""
    results = facts["results"]
    notes = ["A score is the mean return of an online evaluation, with its standard error."]
    if any(result["evaluations"] > 1 for result in results):
        notes.append("Of several evaluations in a training the best one counts, as in the paper.")
    for evaluated, data in sorted({(r["score"]["limit"], r["data"]["limit"]) for r in results}):
        notes.append(f"Evaluations are cut at {evaluated:,} agent steps, the data at {data:,}.")
    seen = [result["renderers"] for result in results if "size" in result["evaluation"]]
    for data, evaluation in sorted({(each["data"], each["evaluation"]) for each in seen}):
        if data != evaluation:
            text = f"The data were rendered elsewhere ({data}), the evaluations by renderer {evaluation}: agents with "
            notes.append(text + "images are scored on other images than they learned from.")
    if any(result["score"]["success"] is not None for result in results):
        notes.append("Success is the share of episodes that reach the goal.")
        notes.append("Speed is the distance to the goal at the start over the time that such episodes take.")
    return notes


def _inspection(good: Results) -> Iterator[tuple[str, ...]]:
    """A row an encoder; none for those of data of which nothing is held out."""
    for cell, result in good:
        found = result["inspection"]
        if found and found["state_mse"] is not None:
            yield cell.label, cell.place, *(f"{found[key]:.4f}" for key in ("observation_mse", "state_mse"))


def _sheets(good: Results, folder: Path, kind: str) -> Iterator[dict[str, str]]:
    """Pictures that cells left: "rollout" or "decoder"."""
    for cell, result in good:
        path = folder / "cells" / f"{cell.id}.{kind}.png"
        if not path.exists():
            continue
        caption = f"{cell.label} on {cell.place}"
        if kind == "rollout":
            returns = result["final"]["returns"]
            caption += f": first of {len(returns)} episodes of the last evaluation, return {_number(returns[0])} "
            caption += f"[{result['budget']['name']}]"
        yield {"caption": caption, "source": data_url(path.read_bytes())}


# -- figures ----------------------------------------------------------------------------------------


def data_url(png: bytes) -> str:
    """A PNG as a URL that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def figure_url(figure: Figure) -> str:
    """A figure as a PNG in a URL."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return data_url(buffer.getvalue())


def curve_figures(results: Results, budget: str) -> Iterator[Figure]:
    """A figure a group of cells (task, policy set, setting): losses on the left, online scores on the right."""
    groups: dict[tuple, list] = {}
    for cell, result in results:
        groups.setdefault((cell.benchmark, cell.place), []).append((cell, result))
    colors = {name: f"C{index}" for index, name in enumerate(dict.fromkeys(cell.label for cell, _ in results))}
    for (_, place), members in groups.items():
        figure = Figure(figsize=(11, 2.8), layout="constrained")
        loss, score = figure.subplots(1, 2)
        for cell, result in members:
            _draw_curve(loss, score, cell.label, colors[cell.label], result["curve"])
        evaluated, data = members[0][1]["score"], members[0][1]["data"]
        if evaluated["limit"] == data["limit"]:  # else their returns cannot be compared
            score.axhline(data["mean"], color="gray", linestyle="--", linewidth=1, label="data")
        loss.set(title=f"{place}: loss (test solid, training dotted)", xlabel="Adam step", yscale="log")
        score.set(title=f"online return [{budget}]", xlabel="Adam step")
        if data["mean"] > 0:
            score.set_ylim(bottom=0)
        score.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
        yield figure


def _draw_curve(loss, score, label: str, color: str, curve: list[dict[str, Any]]) -> None:
    for name, style in (("loss", ":"), ("test_loss", "-")):
        points = [(point["step"], point[name]) for point in curve if name in point]
        if points:
            loss.plot(*zip(*points, strict=True), style, color=color, linewidth=1)
    points = [(p["step"], p["score"]["mean"], p["score"]["stderr"]) for p in curve if "score" in p]
    score.errorbar(*zip(*points, strict=True), marker="o", markersize=3, color=color, label=label)
