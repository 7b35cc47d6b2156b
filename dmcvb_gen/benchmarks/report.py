"""The report of a validation: results in, one self-contained HTML page and a JSON file out.

Wherever a score stands, the profile that made it stands beside it.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import io
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dmcvb_gen import __version__
from dmcvb_gen.behaviours.policies.paper import paper_returns
from dmcvb_gen.benchmarks.checks import Structure
from dmcvb_gen.benchmarks.paper import paper_score
from dmcvb_gen.benchmarks.run import Setup
from dmcvb_gen.benchmarks.tables import Cell, Missing
from dmcvb_gen.release.verify import Finding
from dmcvb_gen.rollout.info import return_statistics
from dmcvb_gen.store import Release
from dmcvb_gen.store.manifest import environment, write_json_atomically

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
    "pictures": "no black, one-colored or frozen pictures",
    "labels": "distractor labels fit their setting",
}
"""Check -> what it says when it passes. Checks of later versions are listed under their own names."""
SHOWN = 200
"""Findings on the page; the JSON file has all."""
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#1a1a1a}
h1{font-size:1.5em} h2{font-size:1.2em;margin-top:2em;border-bottom:1px solid #ccc}
table{border-collapse:collapse;margin:.5em 0} td,th{border:1px solid #ccc;padding:.3em .6em;text-align:left;
vertical-align:top} th{background:#f4f4f4;font-weight:600} .verdict{padding:.8em 1em;border-radius:6px;color:#fff;
font-weight:600} .sound{background:#1b7f4b} .unsound{background:#b3261e} .note{background:#fff4d6;padding:.5em 1em;
border-radius:6px} .tag{font-size:.75em;background:#fff4d6;padding:0 .4em;border-radius:3px;white-space:nowrap}
.paper{color:#666;font-size:.9em} .bad{color:#b3261e} .ok{color:#1b7f4b} img{max-width:100%}
.pixel{image-rendering:pixelated;width:100%} code{background:#f4f4f4;padding:0 .3em} .scroll{overflow-x:auto}
"""


def write_report(
    *,
    setup: Setup,
    release: Release,
    structure: Structure,
    cells: Sequence[Cell],
    results: Sequence[tuple[Cell, dict[str, Any]]],
    missing: Sequence[Missing],
    warnings: Sequence[Finding],
    seconds: float,
) -> tuple[Path, Path]:
    """Write report.html and report.json into the setup's folder; gives both paths."""
    folder = Path(setup.out)
    folder.mkdir(parents=True, exist_ok=True)
    facts = report_facts(setup, release, structure, cells, results, missing, warnings, seconds)
    write_json_atomically(folder / "report.json", facts)
    page = folder / "report.html"
    page.write_text(_page(facts, release, results, setup), encoding="utf-8")
    return page, folder / "report.json"


def report_facts(setup, release, structure, cells, results, missing, warnings, seconds) -> dict[str, Any]:
    """Everything that the page says, as plain values."""
    failed = [{"cell": cell.id, "error": result["error"]} for cell, result in results if "error" in result]
    return {
        "format": "dmcvb-gen validation",
        "generator": f"dmcvb-gen {__version__}",
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "release": {"name": release.manifest.name, "version": release.manifest.version, "path": release.root},
        "sound": structure.sound and not failed,
        "profile": dataclasses.asdict(setup.profile),
        "structure": {
            "sound": structure.sound,
            "checked": structure.checked,
            "seconds": structure.seconds,
            "findings": [dataclasses.asdict(finding) for finding in structure.findings],
        },
        "warnings": [dataclasses.asdict(finding) for finding in warnings],
        "returns": {
            name: return_statistics(subset.returns) | {"paper": paper_returns(subset.task, subset.level)}
            for name, subset in release.subsets.items()
        },
        "cells_planned": len(cells),
        "failed": failed,
        "results": [result | _shares(cell, results) for cell, result in results if "error" not in result],
        "missing": [dataclasses.asdict(entry) for entry in missing],
        "settings": {
            key: value for key, value in dataclasses.asdict(setup).items() if key not in ("profile", "root", "out")
        },
        "versions": environment(),
        "seconds": seconds,
    }


def _shares(cell: Cell, results) -> dict[str, Any]:
    """A score as a share of BC(state) on the same data, ours and the paper's (B2: of BC on all of expert/none)."""
    ours = None
    for other, result in results:
        if "error" in result or (other.benchmark, other.task) != (cell.benchmark, cell.task):
            continue
        if cell.benchmark == "b2":
            whole = other.setting == "none" and other.agent.name == "bc" and other.policy_label == "expert"
        else:
            whole = other.agent.name == "state-bc" and other.policy_label == cell.policy_label
        if whole:
            ours = result["score"]["mean"]
    mean = dict((c, r) for c, r in results)[cell]["score"]["mean"]
    published = paper_score(cell.task, cell.policy_label, cell.setting, cell.agent.paper_name)
    reference = paper_score(cell.task, cell.policy_label, cell.setting, "bc(state)")
    by_paper = published[0] / reference[0] if published and reference and cell.benchmark == "b1" else None
    return {
        "share": mean / ours if ours else None,
        "paper_share": by_paper,
        "share_of": "BC on all of expert/none" if cell.benchmark == "b2" else "BC(state)",
    }


# -- the page -------------------------------------------------------------------------------------


def _page(facts: dict[str, Any], release: Release, results, setup: Setup) -> str:
    good = [(cell, result) for cell, result in results if "error" not in result]
    parts = [
        f"<h1>Validation of {_text(facts['release']['name'])} {_text(facts['release']['version'])}</h1>",
        _verdict(facts),
        f"<p class=note>Profile <b>{_text(facts['profile']['note'])}</b></p>",
        _structure(facts),
        "<h2>Episode returns</h2>",
        _returns(facts, release),
    ]
    if facts["results"]:
        parts += ["<h2>Scores</h2>", _scores(facts), "<h2>Learning curves</h2>", _image(_curves(good, facts))]
        parts += ["<h2>Evaluation episodes</h2>", _sheets(good, setup, "rollout", facts)]
        parts += ["<h2>What decoders see through the encoders</h2>", _inspection(good, facts)]
        parts += ["<p>Above what the agent saw, below what the decoder made of its 64 numbers.</p>"]
        parts += [_sheets(good, setup, "decoder", facts)]
    if facts["missing"]:
        rows = [
            (m["benchmark"], ", ".join(m["subsets"]), f"<code>{_text(m['command'])}</code>")
            for m in facts["missing"]
            if m["subsets"]
        ]
        rows += [
            (m["benchmark"], ", ".join(m["left_out"]), "in the release, left out by --only")
            for m in facts["missing"]
            if m["left_out"]
        ]
        parts += ["<h2>What the benchmarks would need besides</h2>"]
        parts += [_table(("benchmark", "missing subsets", "how to roll them out"), rows, raw=(2,))]
    parts += ["<h2>Time, settings, versions</h2>", _times(facts)]
    settings = {"profile": facts["profile"]["name"], **facts["profile"], **facts["settings"], **facts["versions"]}
    del settings["name"], settings["note"]  # said above
    parts += [_table(("setting", "value"), ((key, str(value)) for key, value in settings.items()))]
    body = "\n".join(parts)
    title = f"Validation of {_text(facts['release']['name'])}"
    return (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{title}</title>"
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _verdict(facts: dict[str, Any]) -> str:
    found, failed = len(facts["structure"]["findings"]), len(facts["failed"])
    checked = ", ".join(f"{count:,} {what}" for what, count in facts["structure"]["checked"].items())
    if facts["sound"]:
        text = f"Sound: {checked}."
    else:
        text = f"Not sound: {found} findings" + (f", {failed} cells failed" if failed else "") + f" in {checked}."
    done = len(facts["results"])
    text += f" {done} of {facts['cells_planned']} benchmark cells run [{facts['profile']['name']}]."
    text += f" {len(facts['warnings'])} warnings." if facts["warnings"] else ""
    return f"<p class='verdict {'sound' if facts['sound'] else 'unsound'}'>{_text(text)}</p>"


def _structure(facts: dict[str, Any]) -> str:
    findings = facts["structure"]["findings"]
    by_check: dict[str, int] = {}
    for finding in findings:
        by_check[finding["check"]] = by_check.get(finding["check"], 0) + 1
    names = dict.fromkeys([*CHECKS, *by_check])
    rows = (
        (name, CHECKS.get(name, name), f"<span class=bad>{by_check[name]} findings</span>" if name in by_check else
         "<span class=ok>passes</span>")
        for name in names
    )  # fmt: skip
    parts = ["<h2>Structure</h2>", _table(("check", "says", "result"), rows, raw=(2,))]
    columns = ("check", "subset", "episode", "step", "what")
    keys = ("check", "subset", "episode", "step", "message")
    for title, entries in (("Findings", findings), ("Warnings", facts["warnings"])):
        if entries:
            shown = ([_plain(entry[key]) for key in keys] for entry in entries[:SHOWN])
            parts += [f"<h3>{title}</h3>", _table(columns, shown)]
            parts += [f"<p>and {len(entries) - SHOWN} more in report.json</p>"] if len(entries) > SHOWN else []
    if facts["failed"]:
        parts += ["<h3>Cells that failed</h3>"]
        parts += [_table(("cell", "why"), ((entry["cell"], entry["error"]) for entry in facts["failed"]))]
    return "\n".join(parts)


def _returns(facts: dict[str, Any], release: Release) -> str:
    keys = ("mean", "std", "min", "p25", "median", "p75", "max")
    rows = []
    for name, values in facts["returns"].items():
        rows.append([name, *(f"{values[key]:.1f}" for key in keys)])
        if values["paper"]:
            rows.append(["the paper", *(f"{values['paper'][key]:.1f}" for key in keys)])
    return _table(("subset", *keys), rows) + _image(_return_figure(release))


def _return_figure(release: Release) -> Figure:
    """Histograms of returns, the paper's quartiles and range as a box under each."""
    names = list(release.subsets)
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 2.4 * lines), layout="constrained")
    for index, name in enumerate(names):
        axis = figure.add_subplot(lines, columns, index + 1)
        subset = release.subsets[name]
        axis.hist(subset.returns, bins=30, color="#4477aa")
        axis.set_title(name, fontsize=9)
        axis.set(xlabel="return", ylabel="episodes")
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
        paper = paper_returns(subset.task, subset.level)
        if paper:
            low = -0.12 * axis.get_ylim()[1]
            axis.plot([paper["min"], paper["max"]], [low, low], color="#cc6677", linewidth=1)
            axis.plot([paper["p25"], paper["p75"]], [low, low], color="#cc6677", linewidth=6, solid_capstyle="butt")
            axis.plot([paper["median"]], [low], "|", color="black", markersize=9)
            axis.set_yticks([tick for tick in axis.get_yticks() if tick >= 0])
            axis.set_title(f"{name}\nbelow: the paper's range, quartiles, median", fontsize=8)
    return figure


def _scores(facts: dict[str, Any]) -> str:
    tag = f"<span class=tag>{_text(facts['profile']['name'])}</span>"
    tables = []
    for benchmark in dict.fromkeys(result["cell"]["benchmark"] for result in facts["results"]):
        results = [result for result in facts["results"] if result["cell"]["benchmark"] == benchmark]
        agents = list(dict.fromkeys(result["cell"]["agent_name"] for result in results))
        rows: dict[tuple, dict[str, str]] = {}
        by_state: dict[tuple, dict[str, str]] = {}
        for result in results:
            cell = result["cell"]
            source = "+".join(_label(part) for part in cell["pretrain"])
            policy = cell["policy_label"] + (f" (encoder: {source})" if source else "")
            key = (cell["task"], policy, cell["setting"], f"{result['data_return']:.0f}")
            rows.setdefault(key, {})[cell["agent_name"]] = _score(result, tag)
            if cell["agent"]["sees_state"] and benchmark == "b1":
                by_state.setdefault(key[:2], {})[cell["agent_name"]] = _score(result, tag)
        for key, row in rows.items():  # states know of no distractors: one score stands beside those of every setting
            row |= by_state.get(key[:2], {})
        head = ("task", "policy learns from", "setting", "data's mean return", *agents)
        body = ([*key, *(row.get(agent, "") for agent in agents)] for key, row in rows.items())
        tables += [f"<h3>{benchmark}</h3>", _table(head, body, raw=range(4, 4 + len(agents)))]
    note = "" if facts["profile"]["scores"] else "<p class=note>This profile claims no score.</p>"
    return note + "\n".join(tables)


def _label(part: dict[str, Any]) -> str:
    from dmcvb_gen.benchmarks.tables import Part

    return Part(**part).label


def _score(result: dict[str, Any], tag: str) -> str:
    score, paper = result["score"], result["paper"]
    text = f"<b>{score['mean']:.0f} &plusmn; {score['stderr']:.0f}</b> {tag}"
    if result["share"] is not None and result["profile"]["scores"]:
        text += f"<br>{100 * result['share']:.0f} % of {_text(result['share_of'])}"
    if score["success"] is not None:
        text += f"<br>success {100 * score['success']:.0f} %"
        text += f", {score['speed']:.2f} m/s" if score["speed"] is not None else ""
    if paper:
        text += f"<br><span class=paper>paper {paper['mean']:.0f} &plusmn; {paper['stderr']:.0f}"
        text += f", {100 * result['paper_share']:.0f} %" if result["paper_share"] is not None else ""
        text += "</span>"
    return text


def _curves(good, facts: dict[str, Any]) -> Figure:
    """A row a group of cells (task, policy set, setting): losses on the left, online scores on the right."""
    groups: dict[tuple, list] = {}
    for cell, result in good:
        groups.setdefault((cell.benchmark, cell.task, cell.policy_label, cell.setting), []).append((cell, result))
    agents = list(dict.fromkeys(cell.agent.name for cell, _ in good))
    figure = Figure(figsize=(11, 2.8 * len(groups)), layout="constrained")
    for line, (key, members) in enumerate(groups.items()):
        loss, score = figure.add_subplot(len(groups), 2, 2 * line + 1), figure.add_subplot(len(groups), 2, 2 * line + 2)
        for cell, result in members:
            color, curve = f"C{agents.index(cell.agent.name)}", result["curve"]
            for name, style in (("loss", ":"), ("test_loss", "-")):
                points = [(point["step"], point[name]) for point in curve if name in point]
                if points:
                    shown = cell.agent.name if name == "test_loss" else None
                    loss.plot(*zip(*points, strict=True), style, color=color, label=shown, linewidth=1)
            points = [(p["step"], p["score"]["mean"], p["score"]["stderr"]) for p in curve if "score" in p]
            steps, means, errors = zip(*points, strict=True)
            score.errorbar(steps, means, errors, marker="o", markersize=3, color=color, label=cell.agent.name)
        score.axhline(members[0][1]["data_return"], color="gray", linestyle="--", linewidth=1, label="data")
        title = "/".join(key[1:])
        loss.set(title=f"{title}: loss (test solid, training dotted)", xlabel="Adam step", yscale="log")
        score.set(title=f"online return [{facts['profile']['name']}]", xlabel="Adam step")
        if members[0][1]["data_return"] > 0:
            score.set_ylim(bottom=0)
        for axis in (loss, score):
            axis.title.set_fontsize(9)
            axis.set_xlim(left=0)
        score.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def _inspection(good, facts: dict[str, Any]) -> str:
    rows = [
        (cell.agent.name, f"{cell.task}/{cell.policy_label}/{cell.setting}", *(
            "-" if result["inspection"][key] is None else f"{result['inspection'][key]:.4f}"
            for key in ("observation_mse", "state_mse")
        ), facts["profile"]["name"])
        for cell, result in good if result["inspection"]
    ]  # fmt: skip
    head = ("encoder of", "data", "test MSE of pixels in [-0.5, 0.5]", "test MSE of normalized states", "profile")
    return _table(head, rows) if rows else "<p>No agent with pictures was inspected.</p>"


def _sheets(good, setup: Setup, kind: str, facts: dict[str, Any]) -> str:
    parts = []
    for cell, result in good:
        path = setup.cells / f"{cell.id}.{kind}.png"
        if not path.exists() or cell.agent.sees_state:
            continue
        caption = f"{cell.agent.name}, {cell.task} {cell.policy_label}/{cell.setting}"
        if kind == "rollout":
            score = result["final"]
            caption += f": first of {len(score['returns'])} episodes of the last evaluation, return "
            caption += f"{score['returns'][0]:.0f} [{facts['profile']['name']}]"
        parts += [f"<p>{_text(caption)}</p><img class=pixel alt='{_text(caption)}' src='{_data(path.read_bytes())}'>"]
    return "\n".join(parts) or "<p>No agent that sees pictures was run.</p>"


def _times(facts: dict[str, Any]) -> str:
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
    head = ("cell", "training s", "evaluation s", "inspection s", "all s", "encoder s", "Adam steps/s", "peak GB")
    total = f"<p>{facts['seconds']:.0f} s in all, of which {facts['structure']['seconds']:.0f} s for the structure."
    total += " Cells that were done before took their time then.</p>"
    return total + (_table(head, rows) if rows else "")


# -- pieces ---------------------------------------------------------------------------------------


def _text(value: object) -> str:
    return html.escape(str(value))


def _plain(value: object) -> str:
    return "" if value is None else str(value)


def _table(head: Iterable[str], rows: Iterable[Sequence[str]], raw: Iterable[int] = ()) -> str:
    raw = set(raw)
    lines = ["<tr>" + "".join(f"<th>{_text(name)}</th>" for name in head) + "</tr>"]
    for row in rows:
        entries = (value if index in raw else _text(value) for index, value in enumerate(row))
        lines.append("<tr>" + "".join(f"<td>{entry}</td>" for entry in entries) + "</tr>")
    return "<div class=scroll><table>" + "\n".join(lines) + "</table></div>"


def _image(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return f"<img alt='figure' src='{_data(buffer.getvalue())}'>"


def _data(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()


__all__ = ["CHECKS", "report_facts", "write_report"]
