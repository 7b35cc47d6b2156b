"""Scores that a report's folder holds from earlier runs: a report that is written there loses none of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.benchmarks.profiles import budget, facts_of
from dmcvb_gen.benchmarks.setup import Setup
from dmcvb_gen.benchmarks.suites import BENCHMARKS, Cell, Slice
from dmcvb_gen.dataset import Release, Subset
from dmcvb_gen.dataset.writer import subset_digest
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.storage.remote import local_path
from dmcvb_gen.text import pluralize

NEEDED = {"digests", "evaluation", "renderers", "seed"}
"""What a report shows of each result, and those of earlier versions may lack."""


def kept_scores(out: str | Path) -> dict[str, Any] | None:
    """The facts of the report in a folder; None if there is none, or its numbers are noise."""
    path = local_path(out) / "report.json"
    try:
        facts = json.loads(path.read_text())
        return facts if facts["results"] and facts["profile"]["scores"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None  # no report of ours


def _check_same_release(setup: Setup, release: Release, kept: Mapping[str, Any]) -> None:
    """Refuse to write a release's scores over those of another one; one that has grown or moved is the same."""
    there = kept.get("release") or {}
    name, recipe = there.get("name"), there.get("recipe_digest")
    same = name in (None, release.manifest.name) and recipe in (None, recipe_digest(release))
    if same and name and Path(there.get("path", "")).resolve() != Path(release.root).resolve():
        same = _same_data(release, kept["results"])
    if not same:
        what = f"another release ({name} {there.get('version', '')}, {there.get('path', '')})"
        raise DmcvbError(f"{setup.out} holds scores of {what}; give another --out")


def recipe_digest(release: Release) -> str:
    """SHA-256 of the recipe that a release began with, which stays as it is while the release grows."""
    return hashlib.sha256(json.dumps(release.manifest.recipe, sort_keys=True).encode()).hexdigest()


def _same_data(release: Release, results: Sequence[Mapping[str, Any]]) -> bool:
    """Return True if each subset of the results is as it was or has grown since; those that are not there may be."""
    digests = {pair for result in results for pair in result.get("digests", {}).items()}
    return all(digest in _digests_so_far(release[name]) for name, digest in digests if name in release.subsets)


def _digests_so_far(subset: Subset) -> Iterator[str]:
    """The digest of a subset, and those that it had when it had fewer shards."""
    shards = sorted(subset.commits)
    for count in range(len(shards), 0, -1):
        yield subset_digest({shard: subset.commits[shard] for shard in shards[:count]})


def other_scores(
    setup: Setup, release: Release, cells: Sequence[Cell], kept: Mapping[str, Any]
) -> list[tuple[Cell, dict[str, Any]]]:
    """The kept cells that this run does not ask for, with their results: they stay in the report.

    Args:
      cells: those that the run asks for.

    Raises:
      DmcvbError: the kept scores are of another release, or one that would be left out is of other data or of another
        budget, so that it cannot stand beside the new ones.
    """
    _check_same_release(setup, release, kept)
    ids, asked = {cell.id for cell in cells}, {_place(cell) for cell in cells}
    found, stale = [], []
    for result in kept["results"]:
        if result.get("id") in ids:
            continue
        cell, like = _cell_of(result), budget(result.get("profile", {})) == budget(facts_of(setup.profile))
        if cell and like and NEEDED <= result.keys() and _unchanged(release, result):
            found.append((cell, result))
        elif cell is None or _place(cell) not in asked:  # else this run has its successor
            stale.append(result.get("id", "a cell"))
    if stale:
        raise DmcvbError(
            f"{setup.out} holds {pluralize(len(stale), 'scores')} that this run leaves out, of data or settings that "
            f"have changed since: {', '.join(stale[:3])}{', ...' * (len(stale) > 3)}; ask for their agents and "
            "benchmarks too, or give another --out"
        )
    return found


def _place(cell: Cell) -> tuple[str, ...]:
    return cell.benchmark, cell.task, cell.setting, cell.agent.name


def _cell_of(result: Mapping[str, Any]) -> Cell | None:
    """The cell of a result; None if it names an agent or benchmark that is not known here."""
    try:
        facts = result["cell"]
        parts = {name: tuple(Slice(**part) for part in facts[name]) for name in ("policy", "pretrain")}
        BENCHMARKS.get(facts["benchmark"])
        return Cell(facts["benchmark"], facts["task"], facts["setting"], parse_agent(facts["agent_name"]), **parts)
    except (DmcvbError, LookupError, TypeError):
        return None


def _unchanged(release: Release, result: Mapping[str, Any]) -> bool:
    """Return True if the data of a result are those of the release."""
    digests = result["digests"]
    return digests == {name: subset_digest(release[name].commits) for name in digests if name in release.subsets}
