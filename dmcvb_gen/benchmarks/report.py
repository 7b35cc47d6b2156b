"""Write the report of a validation: one self-contained HTML page, its tables as Markdown, and a JSON file.

Wherever a score stands, the profile that made it stands beside it. The page's text lies in data/report.html.jinja,
the tables' in data/report.md.jinja; here is what they show.
"""

from __future__ import annotations

import dataclasses
import html
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from dmcvb_gen.benchmarks.agreement import rank_agreement, shared_cells
from dmcvb_gen.benchmarks.checks import Structure, comparable, known_returns
from dmcvb_gen.benchmarks.claims import claim_words, judge, mean_of
from dmcvb_gen.benchmarks.figures import (
    agreement_figures,
    curve_figures,
    data_url,
    figure_url,
    label_of,
    place_of,
    return_figures,
)
from dmcvb_gen.benchmarks.kept import recipe_digest
from dmcvb_gen.benchmarks.paper import paper_score
from dmcvb_gen.benchmarks.setup import Setup
from dmcvb_gen.benchmarks.suites import BENCHMARKS, Cell, Missing
from dmcvb_gen.dataset import Release
from dmcvb_gen.dataset.manifest import environment
from dmcvb_gen.files import write_json, write_text
from dmcvb_gen.generate.info import return_statistics
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.spec import is_maze, task_folder
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import pluralize
from dmcvb_gen.version import __version__

CHECKS = {
    "files": "every file has its bytes and digest",
    "shapes": "arrays have their shapes and types",
    "lengths": "lengths, discounts and ends agree",
    "finite": "all values are finite",
    "actions": "actions lie in [-1, 1]",
    "returns": "returns are the sums of the rewards, in range, and as the policies' files say",
    "duplicates": "no two episodes are the same",
    "states": "physics states give the stored states",
    "rewards": "physics gives the stored rewards",
    "physics": "stored actions lead to the stored physics states",
    "pixels": "sampled frames painted again are the stored ones",
    "pictures": "no black, one-colored or frozen images",
    "labels": "distractor labels fit their setting",
    "modalities": "depth, segmentation and the like, if stored, are what the states show",
}
"""Check -> what it says when it passes. Checks of later versions are listed under their own names."""
SHOWN = 200
"""Findings on the page; the JSON file has all."""
SHEETS = 60
"""Pictures of each kind on the page, which holds them; the others lie beside the cells."""
MARKUP = {ord(mark): f"&#{ord(mark)};" for mark in "|\\*_`"}
"""Written as entities, they mean nothing to any reader of Markdown."""
STATISTICS = ("mean", "std", "min", "p25", "median", "p75", "max")
Results = Sequence[tuple[Cell, dict[str, Any]]]


def write_report(
    *,
    setup: Setup,
    release: Release,
    structure: Structure,
    cells: Sequence[Cell],
    results: Results,
    missing: Sequence[Missing],
    warnings: Sequence[Issue],
    seconds: float,
    name: str = "report",
) -> tuple[Path, Path]:
    """Write <name>.html, .md and .json into the setup's folder; gives the paths of the page and of the JSON file."""
    page = Path(setup.out) / f"{name}.html"
    facts = report_facts(setup, release, structure, cells, results, missing, warnings, seconds)
    write_json(page.with_suffix(".json"), facts)
    good = [(cell, result) for cell, result in results if "error" not in result]
    write_text(page.with_suffix(".md"), render_tables(facts))
    write_text(page, render_page(facts, release, good, setup))
    return page, page.with_suffix(".json")


def report_facts(setup, release, structure, cells, results, missing, warnings, seconds) -> dict[str, Any]:
    """Everything that the page says, as plain values."""
    failed = [{"cell": cell.id, "error": result["error"]} for cell, result in results if "error" in result]
    there, asked = release_episodes(release)
    return {
        "format": "dmcvb-gen validation",
        "generator": f"dmcvb-gen {__version__}",
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "release": {
            "name": release.manifest.name,
            "version": release.manifest.version,
            "digest": release.manifest.digest,
            "recipe_digest": recipe_digest(release),
            "pixels": any(record.pixels for record in release.manifest.subsets),
            "path": release.root,
        },
        "sound": structure.sound and not failed,
        "complete": there == asked,
        "episodes": {"there": sum(there.values()), "asked": sum(asked.values())},
        "incomplete": {name: [there[name], asked[name]] for name in asked if there[name] < asked[name]},
        "profile": dataclasses.asdict(setup.profile),
        "structure": {
            "sound": structure.sound,
            "checked": structure.checked,
            "seconds": structure.seconds,
            "findings": [dataclasses.asdict(finding) for finding in structure.findings],
        },
        "warnings": [dataclasses.asdict(finding) for finding in warnings],
        "returns": {
            name: return_statistics(returns)
            | {"paper": paper_returns(subset.task, subset.level) if comparable(subset) else None}
            for name, returns in known_returns(release).items()
            for subset in [release[name]]
        },
        "cells_planned": len(cells),
        "failed": failed,
        "results": [result | compare(cell, results) for cell, result in results if "error" not in result],
        "missing": [dataclasses.asdict(entry) for entry in missing],
        "settings": {
            key: value for key, value in dataclasses.asdict(setup).items() if key not in ("profile", "root", "out")
        },
        "versions": environment(),
        "seconds": seconds,
    }


def release_episodes(release: Release) -> tuple[dict[str, int], dict[str, int]]:
    """Subset -> episodes that are committed, and that the manifest asks for."""
    asked = {record.name: record.episodes for record in release.manifest.subsets}
    return {name: len(release.subsets[name].episodes) if name in release.subsets else 0 for name in asked}, asked


def compare(cell: Cell, results: Results) -> dict[str, Any]:
    """A score beside that of the cell's reference (`Benchmark.reference`).

    A share means something if 0 is the least that an episode can return; elsewhere (mazes: -800 is not "twenty
    times" -40) the difference stands.

    Returns:
      share, paper_share: shares of the reference's score, ours and the paper's; None if there is none.
      difference: from the reference's score; None if there is none.
      reference: words for what it refers to.
    """
    benchmark = BENCHMARKS.get(cell.benchmark)
    scores = {other: result["score"]["mean"] for other, result in results if "error" not in result}
    like = [other for other in scores if (other.benchmark, other.task) == (cell.benchmark, cell.task)]
    found = [scores[other] for other in like if benchmark.is_reference(other, cell)]
    shares = get_task(cell.task).return_range[0] >= 0
    ours = paper = difference = None
    if found:
        difference = scores[cell] - found[0]
        ours = scores[cell] / found[0] if shares and found[0] > 0 else None
    published = benchmark.paper_score(cell)
    if shares and published:
        whole = paper_score(cell.task, cell.policy_label, cell.setting, "bc(state)")
        paper = published[0] / whole[0] if whole else None
    return {"share": ours, "paper_share": paper, "difference": difference, "reference": benchmark.reference(cell)}


# -- the page -------------------------------------------------------------------------------------


def render_page(facts: Mapping[str, Any], release: Release, good: Results, setup: Setup) -> str:
    """The page of a report, self-contained.

    Args:
      good: results of cells that did not fail.
    """
    name = facts["profile"]["name"]
    return _template("report.html.jinja", autoescape=True).render(
        **_tables(facts),
        figures={
            "returns": [figure_url(figure) for figure in return_figures(release)],
            "agreement": [figure_url(figure) for figure in agreement_figures(shared_cells(facts["results"]))],
            "curves": [figure_url(figure) for figure in curve_figures(good, name)],
        },
        rollouts=_sheets(good, setup, "rollout"),
        decoders=_sheets(good, setup, "decoder"),
        inspection=_inspection(good, name),
        times=_times(facts),
        settings=_settings(facts),
    )


def render_tables(facts: Mapping[str, Any]) -> str:
    """Render the page's tables as Markdown, without pictures, times and settings; `facts` as in report.json."""
    text = _template("report.md.jinja").render(**_tables(facts))
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def _template(name: str, autoescape: bool = False) -> Template:
    loader = PackageLoader("dmcvb_gen.benchmarks", "data")
    environment = Environment(
        loader=loader, autoescape=autoescape, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"cell": _markdown_cell, "values_of": _values_of, "score_row": _score_row}
    return environment.get_template(name)


def _tables(facts: Mapping[str, Any]) -> dict[str, Any]:
    return dict(
        release=facts["release"],
        profile=facts["profile"],
        verdict=_verdict(facts),
        trained=bool(facts["cells_planned"]),
        checks=_checks(facts["structure"]["findings"]),
        incomplete=[(name, *counts) for name, counts in facts["incomplete"].items()],
        findings=_listed(facts["structure"]["findings"]),
        warnings=_listed(facts["warnings"]),
        failed=[(entry["cell"], entry["error"]) for entry in facts["failed"]],
        returns=_returns(facts["returns"]),
        scores=[_scores(name, facts) for name in dict.fromkeys(r["cell"]["benchmark"] for r in facts["results"])],
        groups=_groups(facts["results"]),
        agreement=[(one.task, str(one)) for one in rank_agreement(shared_cells(facts["results"]))],
        notes=_notes(facts["results"]),
        answers=_answers(facts["results"]),
        missing=_missing(facts["missing"]),
    )


def _markdown_cell(value: Any) -> str:
    """A value in one cell of a table: no bar of its own, no line's end, nothing taken for Markdown or HTML."""
    text = "" if value is None else html.escape(str(value), quote=False).translate(MARKUP)
    return "<br>".join(text.replace("](", "]&#40;").splitlines())  # no link; "[smoke]" stays as it is


def _values_of(row: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    return [row[name] for name in names]


def _score_row(row: Mapping[str, Any], profile: str) -> list[str]:
    """A row of `_scores` in plain text, its profile beside every score."""
    return [*row["facts"], "\n".join(row["data"]), *(_score_text(entry, profile) for entry in row["scores"])]


def _score_text(entry: Mapping[str, Any] | None, profile: str) -> str:
    if entry is None:
        return ""
    paper = entry["paper"]
    published = [f"paper {paper['mean']} ± {paper['stderr']}{paper['share']}"] if paper else []
    return "\n".join([f"{entry['mean']} ± {entry['stderr']} [{profile}]", *entry["lines"], *published])


def _verdict(facts: Mapping[str, Any]) -> dict[str, str]:
    found, failed = len(facts["structure"]["findings"]), len(facts["failed"])
    checked = ", ".join(pluralize(count, what) for what, count in facts["structure"]["checked"].items())
    there, asked = facts["episodes"]["there"], facts["episodes"]["asked"]
    if not facts["sound"]:
        kind = "unsound"
        text = f"Not sound: {pluralize(found, 'findings')}"
        text += (f", {pluralize(failed, 'cells')} failed" if failed else "") + f" in {checked}."
    elif not facts["complete"]:
        kind, text = "incomplete", f"Incomplete: {there:,} of {asked:,} episodes. Sound is what is there: {checked}."
    else:
        kind, text = "sound", f"Sound: {checked}."
    if kind == "unsound" and not facts["complete"]:
        text += f" Incomplete: {there:,} of {asked:,} episodes."
    done = len(facts["results"])
    if facts["cells_planned"]:
        text += f" {done} of {facts['cells_planned']} benchmark cells run [{facts['profile']['name']}]."
    else:
        text += " The data were checked; no agent was trained."
    text += f" {pluralize(len(facts['warnings']), 'warnings')}." if facts["warnings"] else ""
    return {"kind": kind, "text": text}


def _checks(findings: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    counts = Counter(finding["check"] for finding in findings)
    names = dict.fromkeys([*CHECKS, *counts])
    return [{"name": name, "says": CHECKS.get(name, name), "findings": counts[name]} for name in names]


def _listed(findings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    keys = ("check", "subset", "episode", "step", "message")
    rows = [[finding[key] for key in keys] for finding in findings[:SHOWN]]
    return {"rows": rows, "more": max(0, len(findings) - SHOWN)}


def _returns(returns: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    rows = []
    for name, values in returns.items():
        rows.append([name, *(f"{values[key]:.1f}" for key in STATISTICS)])
        if values["paper"]:
            rows.append(["the paper", *(f"{values['paper'][key]:.1f}" for key in STATISTICS)])
    return {"head": ("subset", *STATISTICS), "rows": rows}


def _scores(benchmark: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """One benchmark's table: a row a task, policy set and setting, a column an agent."""
    results = [result for result in facts["results"] if result["cell"]["benchmark"] == benchmark]
    agents = list(dict.fromkeys(result["cell"]["agent_name"] for result in results))
    rows: dict[tuple, dict[str, Any]] = {}
    by_state: dict[tuple, dict[str, Any]] = {}
    data: dict[tuple, list[str]] = {}
    for result in results:
        cell = result["cell"]
        key = (task_folder(cell["task"]), cell["policy_label"], cell["setting"])
        data[key] = _data_lines(result["data"])
        rows.setdefault(key, {})[cell["agent_name"]] = entry = _score(result)
        if cell["agent"]["sees_state"]:
            by_state.setdefault(key[:2], {})[cell["agent_name"]] = entry
    for key, row in rows.items():  # states know of no distractors: one score stands beside those of every setting
        rows[key] = by_state.get(key[:2], {}) | row
    return {
        "title": BENCHMARKS.get(benchmark).title,
        "head": ("task", "policy learns from", "setting", "the data's own", *agents),
        "rows": [
            {"facts": key, "data": data[key], "scores": [row.get(agent) for agent in agents]}
            for key, row in rows.items()
        ],
    }


def _groups(results: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Means that the paper gives: of mazes by their group of layouts (B1), of goal pairs by their maze (B3)."""
    groups: dict[tuple, list[Mapping[str, Any]]] = {}
    for result in results:
        cell = result["cell"]
        if not is_maze(cell["task"]) or not result["profile"]["scores"]:
            continue
        group = BENCHMARKS.get(cell["benchmark"]).group(cell["task"], cell["policy_label"])
        if group is None:
            continue
        encoder = f" (encoder: {cell['pretrain_label']})" if cell["pretrain_label"] else ""
        key = (cell["benchmark"], *group, cell["setting"], cell["agent_name"] + encoder)
        groups.setdefault(key, []).append(result)
    rows = []
    for key, members in groups.items():
        scores = [member["score"] for member in members]
        mean, error = mean_of([score["mean"] for score in scores], [score["stderr"] for score in scores])
        success = sum(score["success"] for score in scores) / len(scores)
        rows.append((*key, str(len(scores)), f"{_number(mean)} ± {_number(error)}", f"{100 * success:.0f} %"))
    return rows


def _number(value: float) -> str:
    """A return: one decimal if that is worth something."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def _score(result: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of a score table: mean and standard error, further lines, and the paper's."""
    score, paper = result["score"], result["paper"]
    lines = _goal_lines(score)
    if result["share"] is not None and result["profile"]["scores"]:
        lines.insert(0, f"{100 * result['share']:.0f} % of {result['reference']}")
    elif result["difference"] and result["profile"]["scores"]:  # 0 is the reference itself
        side = "above" if result["difference"] > 0 else "below"
        lines.insert(0, f"{_number(abs(result['difference']))} {side} {result['reference']}")
    if result["cell"]["pretrain_label"]:
        lines.append(f"encoder: {result['cell']['pretrain_label']}")
    if paper and result["profile"]["scores"]:
        share = f", {100 * result['paper_share']:.0f} %" if result["paper_share"] is not None else ""
        paper = {"mean": f"{paper['mean']:.0f}", "stderr": f"{paper['stderr']:.0f}", "share": share}
    else:
        paper = None  # noise is never set beside the paper's numbers
    return {"mean": _number(score["mean"]), "stderr": _number(score["stderr"]), "lines": lines, "paper": paper}


def _goal_lines(score: Mapping[str, Any]) -> list[str]:
    """Success and speed, if a task has a goal."""
    if score["success"] is None:
        return []
    lines = [f"success {100 * score['success']:.0f} %"]
    return lines + [f"{score['speed']:.2f} m/s to the goal"] if score["speed"] is not None else lines


def _data_lines(data: Mapping[str, Any]) -> list[str]:
    return [_number(data["mean"]), *_goal_lines(data)]


def _notes(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the notes that a reader of the scores needs."""
    most = max((result["evaluations"] for result in results), default=1)
    kind = "of the trained policy" if most == 1 else f"the best of {most} over a training, as in the paper"
    notes = [f"A score is an online evaluation {kind}: mean and standard error over its episodes."]
    for evaluated, data in sorted({(r["score"]["limit"], r["data"]["limit"]) for r in results}):
        if evaluated == data:
            notes.append(f"Evaluations are cut at {evaluated:,} agent steps, as the data are.")
        else:
            notes.append(
                f"Evaluations are cut at {evaluated:,} agent steps, the data at {data:,}: their returns cannot be "
                "compared where the end is not reached before."
            )
    pictured = [result for result in results if "size" in result["evaluation"]]
    others = ", agents that see states in float32" if len(pictured) < len(results) else ""
    for precision in sorted({result["machine"]["precision"] for result in pictured}):
        notes.append(f"Networks that see images computed in {precision}{others}.")
    for data, evaluation in sorted({(r["renderers"]["data"], r["renderers"]["evaluation"]) for r in pictured}):
        if data != evaluation:
            notes.append(
                f"The data were painted elsewhere ({data}), the evaluations here by renderer {evaluation}: agents with "
                "images are scored on other images than they learned from."
            )
    if any(result["score"]["success"] is not None for result in results):
        notes.append(
            "Success is the share of episodes that reach the goal; the speed is the distance to the goal at the start "
            "over the time to reach it, of those episodes."
        )
    return notes


def _answers(results: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    words = claim_words()
    return [(words[a.claim], a.where, a.answer, a.numbers) for a in judge(results)]


def _inspection(good: Results, profile: str) -> list[tuple]:
    return [
        (
            label_of(cell),
            place_of(cell),
            *(
                "-" if result["inspection"][key] is None else f"{result['inspection'][key]:.4f}"
                for key in ("observation_mse", "state_mse")
            ),
            ", ".join(f"{field} {error:.3f}" for field, error in (result["inspection"]["state_l1"] or {}).items()),
            profile,
        )
        for cell, result in good
        if result["inspection"]
    ]


def _sheets(good: Results, setup: Setup, kind: str) -> dict[str, Any]:
    """Pictures that cells left: "rollout" or "decoder"."""
    found = []
    seeing = [(cell, result) for cell, result in good if not cell.agent.sees_state]
    paths = [setup.cells / f"{cell.id}.{kind}.png" for cell, _ in seeing]
    there = [(*pair, path) for pair, path in zip(seeing, paths, strict=True) if path.exists()]
    for cell, result, path in there[:SHEETS]:
        caption = f"{label_of(cell)} on {place_of(cell)}"
        if kind == "rollout":
            score = result["final"]
            caption += f": first of {len(score['returns'])} episodes of the last evaluation, return "
            caption += f"{_number(score['returns'][0])} [{setup.profile.name}]"
        found.append({"caption": caption, "source": data_url(path.read_bytes())})
    return {"shown": found, "more": len(there) - len(found), "names": f"cells/*.{kind}.png"}


def _missing(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    rows = []
    for entry in entries:
        command = entry["command"].startswith("dmcvb-gen")
        if entry["subsets"]:
            subsets = ", ".join(entry["subsets"])
            rows.append(dict(benchmark=entry["benchmark"], subsets=subsets, how=entry["command"], command=command))
        if entry["left_out"]:
            subsets, how = ", ".join(entry["left_out"]), "in the release, left out by --only"
            rows.append(dict(benchmark=entry["benchmark"], subsets=subsets, how=how, command=False))
    return rows


def _times(facts: Mapping[str, Any]) -> dict[str, Any]:
    rows = [
        (
            result["id"],
            *(f"{result['seconds'][part]:.0f}" for part in ("training", "evaluation", "inspection", "all")),
            f"{result['pretraining']['seconds']:.0f}" if result["pretraining"] else "",
            f"{result['steps_per_second']:.1f}",
            f"{result['memory_bytes'] / 1e9:.1f}",
        )
        for result in facts["results"]
    ]
    return {"rows": rows, "total": f"{facts['seconds']:.0f}", "structure": f"{facts['structure']['seconds']:.0f}"}


def _settings(facts: Mapping[str, Any]) -> list[tuple[str, Any]]:
    if not facts["cells_planned"]:
        return list({**facts["settings"], **facts["versions"]}.items())
    profile = {key: value for key, value in facts["profile"].items() if key not in ("name", "note")}
    network = profile["network"]
    profile["network"] = "channels {}, strides {}".format(
        *(" ".join(map(str, network[key])) for key in ("channels", "strides"))
    )
    return list({"profile": facts["profile"]["name"], **profile, **facts["settings"], **facts["versions"]}.items())


__all__ = ["CHECKS", "compare", "release_episodes", "render_page", "render_tables", "report_facts", "write_report"]
