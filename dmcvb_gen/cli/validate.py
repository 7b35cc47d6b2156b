"""validate."""

from __future__ import annotations

import json
from collections.abc import Iterator

import click

from dmcvb_gen.benchmarks.validate import validate as run
from dmcvb_gen.cli.common import answer
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.parallel import ignore
from dmcvb_gen.progress import ProgressBar


@command_of(run)
@click.option("--strict", is_flag=True, help="Exit with 1 on warnings (data unlike the paper's).")
def validate(strict, as_json, **options):
    """Check a release, run the paper's benchmarks on it and compare the scores with the paper's.

    Exit code 0: the release is complete and all checks passed. 1: a check or a cell failed, or episodes are missing.
    2: bad usage. Rerun the command to resume.

    \b
    dmcvb-gen validate releases/mini --profile smoke
    dmcvb-gen validate releases/mini --profile quick --agents bc,id+bc
    """
    result = run(on_score=ignore if as_json else _show_score, **options)
    code = 0 if result.sound and result.complete and not (strict and result.warnings) else 1
    facts = json.loads(result.facts.read_text())
    answer(as_json, facts, *_validated(result, facts), code=code)


def _show_score(budget, cell, facts) -> None:
    """Print a cell's score as soon as it is known."""
    if "error" in facts:
        return  # told at the end, where it is not overlooked
    score, paper = facts["score"], facts["paper"]
    shown = paper and budget.scores  # noise is never set beside the paper's numbers
    beside = f", paper {paper['mean']:.0f} +- {paper['stderr']:.0f}" if shown else ""
    goal = "" if score["success"] is None else f", success {100 * score['success']:.0f} %"
    goal += "" if score["speed"] is None else f" at {score['speed']:.2f} m/s"
    score = f"{score['mean']:.1f} +- {score['stderr']:.1f} [{budget.name}]"
    with ProgressBar.external_write_mode():
        click.echo(f"{cell.place} {cell.agent.name}: {score}{goal}{beside}")


def _validated(result, facts) -> Iterator[str]:
    """Yield the result of validate in lines."""
    from dmcvb_gen.benchmarks.report import verdict

    yield from (f"FAIL {finding}" for finding in result.structure.findings[:50])
    yield from (f"FAIL {cell.id}: {error}" for cell, error in result.failed)
    yield from (f"warning: {finding}" for finding in result.warnings)
    for entry in facts["missing"]:
        yield f"{entry['benchmark']}: not in the release: {', '.join(entry['subsets'])}"
    yield verdict(facts)["text"]
    if result.results:
        yield f"Profile {facts['budget']['note']}"
    yield f"Report: {result.report}"
