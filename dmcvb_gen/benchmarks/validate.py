"""Validation: a release in, a report out: structure checks, then benchmarks, then one page that says it all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmcvb_gen.benchmarks.checks import Structure, check_structure
from dmcvb_gen.benchmarks.report import write_report
from dmcvb_gen.benchmarks.run import Setup, default_threads, planned_steps, run_cells
from dmcvb_gen.benchmarks.tables import Cell, Missing, plan_benchmark
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.release.verify import Finding
from dmcvb_gen.rollout.recipe import select
from dmcvb_gen.store import Release, open_release

STATE_BC_SHARE = 0.9
"""Of the data's mean return that BC(state) should reach on expert data; less draws a warning."""


@dataclass(frozen=True)
class Validation:
    """What a validation found.

    Attributes:
      structure: of the release.
      results: (cell, result) of every cell; a result of {"error": ...} failed.
      missing: what the benchmarks would need besides.
      report: the page. facts: the JSON file beside it.
    """

    structure: Structure
    results: tuple[tuple[Cell, dict[str, Any]], ...]
    missing: tuple[Missing, ...]
    warnings: tuple[Finding, ...]
    report: Path
    facts: Path

    @property
    def failed(self) -> tuple[tuple[Cell, str], ...]:
        return tuple((cell, result["error"]) for cell, result in self.results if "error" in result)

    @property
    def sound(self) -> bool:
        return self.structure.sound and not self.failed


@dataclass(frozen=True)
class Progress:
    """Who is told how a validation goes on.

    Attributes:
      checking: called with the subset that is checked.
      total: called with the number of Adam steps to come.
      training: called with what is trained and the steps made.
      done: called with each cell and its result.
    """

    checking: Callable[[str], None] = field(default=lambda subset: None)
    total: Callable[[int], None] = field(default=lambda steps: None)
    training: Callable[[str, int], None] = field(default=lambda what, steps: None)
    done: Callable[[Cell, dict[str, Any]], None] = field(default=lambda cell, result: None)


def only(release: Release, patterns: Sequence[str]) -> Release:
    """A release with the subsets that match, e.g. "walker-walk/expert/*".

    Raises:
      DmcvbError: a pattern matches none.
    """
    names = select([record.name for record in release.manifest.subsets], list(patterns))
    records = tuple(record for record in release.manifest.subsets if record.name in names)
    manifest = release.manifest.model_copy(update={"subsets": records})
    return Release(release.root, manifest, {name: subset for name, subset in release.subsets.items() if name in names})


def validate(
    path: str | Path,
    setup: Setup,
    *,
    benchmarks: Sequence[str] = ("b1",),
    agents: Sequence[str] = (),
    patterns: Sequence[str] = (),
    workers: int = 1,
    train_unsound: bool = False,
    progress: Progress | None = None,
) -> Validation:
    """Check a release, run benchmarks on it and write the report.

    Args:
      path: the release's folder.
      setup: profile, report folder, device.
      benchmarks: names out of `tables.BENCHMARKS`; none: structure checks alone.
      agents: instead of each benchmark's own.
      patterns: only these subsets.
      workers: cells side by side.
      train_unsound: run the benchmarks even where a structure check fails.

    Raises:
      DmcvbError: there is no release, or a name is unknown, or the release has no data for any benchmark asked for.
    """
    started, progress = time.perf_counter(), progress or Progress()
    release = open_release(path)
    chosen = only(release, patterns)
    if not chosen.subsets:
        raise DmcvbError(f"{path} has no committed episodes yet; run the rollout first")
    left_out = release.subsets.keys() - chosen.subsets.keys()
    cells: list[Cell] = []
    missing: list[Missing] = []
    for name in benchmarks:
        found, lacking = plan_benchmark(name, chosen, agents, left_out)
        if not found:
            needs = [f"roll out {', '.join(m.subsets[:4])}: {m.command}" for m in lacking if m.subsets]
            needs += [f"let --only take {', '.join(m.left_out[:4])}" for m in lacking if m.left_out]
            cure = "; ".join(needs) or "roll out a locomotion task"
            raise DmcvbError(f"benchmark {name} has no data in {path}; {cure}")
        cells += found
        missing += lacking
    structure = check_structure(chosen, setup.backgrounds, progress.checking)
    results = []
    if structure.sound or train_unsound:
        progress.total(planned_steps(setup.profile, cells))
        for cell, result in run_cells(setup, cells, workers, progress.training):
            progress.done(cell, result)
            results.append((cell, result))
    order = {cell: index for index, cell in enumerate(cells)}
    results.sort(key=lambda pair: order[pair[0]])
    warnings = (*structure.warnings, *_learning_warnings(setup, results))
    report, facts = write_report(
        setup=setup,
        release=chosen,
        structure=structure,
        cells=cells,
        results=results,
        missing=missing,
        warnings=warnings,
        seconds=time.perf_counter() - started,
    )
    return Validation(structure, tuple(results), tuple(missing), warnings, report, facts)


def _learning_warnings(setup: Setup, results) -> list[Finding]:
    """Expert data that BC on states cannot learn from is odd."""
    found = []
    for cell, result in results:
        if not setup.profile.scores or "error" in result or cell.agent.name != "state-bc":
            continue
        score, data = result["score"]["mean"], result["data_return"]
        if cell.policy_label == "expert" and data > 0 and score < STATE_BC_SHARE * data:
            found.append(
                Finding(
                    "learning",
                    cell.policy[0].subset,
                    f"BC(state) returns {score:.0f}, {100 * score / data:.0f} % of the data's {data:.0f} "
                    f"[{setup.profile.name}]",
                )
            )
    return found


__all__ = ["Progress", "Setup", "Validation", "default_threads", "only", "validate"]
