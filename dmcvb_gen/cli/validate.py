"""validate, claims."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from pathlib import Path

import click

from dmcvb_gen import commands
from dmcvb_gen.cli.common import answer, json_option, print_json
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.cli.unused_options import refuse
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.text import pluralize


@command_of(commands.validate)
@click.option("--agent", "own", multiple=True, metavar="MODULE:NAME", help="Also score your own agent. Repeatable.")
@click.option("--strict", is_flag=True, help="Exit with 1 on warnings (data unlike the paper's).")
def validate(own, strict, as_json, **options):
    """Check a release and run the paper's benchmarks on it, scores set beside the paper's.

    Exit code 0 when sound and complete, 1 when a check or a cell fails or episodes are missing, 2 on bad usage. Rerun
    the command to resume.

    \b
    dmcvb-gen validate releases/mini --profile smoke
    dmcvb-gen validate releases/mini --profile quick --benchmark b1 --agents bc,state-bc,id+bc --out reports/mini
    """
    context = click.get_current_context()
    if options["checks_only"]:
        refuse(context, (*commands.TRAINING, "own"), "--checks-only trains nothing")
    options["agents"] = _agents(options["agents"], own, options["benchmarks"])
    from dmcvb_gen.benchmarks.setup import kept_precision

    setup = commands.validation_setup(options)
    if options["precision"] == "auto" and not options["checks_only"]:
        why = "as before" if kept_precision(setup.out, setup.device) else "the faster one here"
        click.echo(f"Networks that see images compute in {setup.precision}, {why}.", err=True)
    on_score = (lambda *_: None) if as_json else functools.partial(_show_score, setup)
    result = commands.run_validation(setup, options, on_score)
    code = 0 if result.sound and result.complete and not (strict and result.warnings) else 1
    answer(as_json, json.loads(result.facts.read_text()), *_validated(result, setup.profile), code=code)


def _show_score(setup, cell, facts) -> None:
    """A cell's score, as soon as it is there, and whether it is one of an earlier run by a user's own code."""
    from dmcvb_gen.spec import task_folder

    if "error" in facts:
        return  # told at the end, where it is not overlooked
    profile, score, paper = setup.profile, facts["score"], facts["paper"]
    shown = paper and profile.scores  # noise is never set beside the paper's numbers
    beside = f", paper {paper['mean']:.0f} +- {paper['stderr']:.0f}" if shown else ""
    where = f"{task_folder(cell.task)} {cell.policy_label}/{cell.setting}"
    goal = "" if score["success"] is None else f", success {100 * score['success']:.0f} %"
    goal += "" if score["speed"] is None else f" at {score['speed']:.2f} m/s"
    score = f"{score['mean']:.1f} +- {score['stderr']:.1f} [{profile.name}]"
    with ProgressBar.external_write_mode():
        click.echo(f"{where} {cell.agent.name}: {score}{goal}{beside}")
        if facts.get("kept"):
            path = setup.cells / f"{cell.id}.json"
            click.echo(
                f"  This is the score of an earlier run, as the code is the same; to train again, delete {path}."
            )


def _agents(names: tuple[str, ...] | None, own: tuple[str, ...], benchmarks: tuple[str, ...]) -> list[str]:
    """The agents asked for; one's own alone are set beside BC from states, in benchmarks that take it."""
    from dmcvb_gen.agents.catalog import OWN
    from dmcvb_gen.benchmarks.suites import BENCHMARKS

    for name in own:
        if not OWN.fullmatch(name):
            raise click.UsageError(f"--agent {name} is not MODULE:NAME; the paper's agents are chosen with --agents.")
    beside = own and not names and any(not BENCHMARKS.get(name).compares_encoders for name in benchmarks)
    return [*(names or ()), *(["state-bc"] if beside else []), *own]


def _validated(result, profile) -> Iterator[str]:
    """Yield the result of validate in lines."""
    yield from (f"FAIL {finding}" for finding in result.structure.findings[:50])
    yield from (f"FAIL {cell.id}: {error}" for cell, error in result.failed)
    yield from (f"warning: {finding}" for finding in result.warnings)
    for entry in result.missing:
        if entry.subsets:
            names = ", ".join(entry.subsets)
            yield f"{entry.benchmark}: not in the release: {names}; to get them: {entry.command}"
        if entry.left_out:
            yield f"{entry.benchmark}: left out by --only: {', '.join(entry.left_out)}"
    checked = ", ".join(pluralize(count, name) for name, count in result.structure.checked.items())
    found = len(result.structure.findings) + len(result.failed)
    verdict = ["sound" if result.sound else pluralize(found, "findings")]
    if not result.complete:
        there, asked = result.episodes
        verdict = [
            f"incomplete: {there:,} of {asked:,} episodes",
            "what is there is sound" if result.sound else verdict[0],
        ]
    note = f"; {profile.note}" if result.results else ""
    yield f"{'; '.join(verdict)} ({checked}){note}"
    if result.kept:
        yield f"The scores of an earlier run are kept: {result.kept}"
    yield f"Report: {result.report}"


@click.command()
@click.argument("reports", nargs=-1, required=True, type=click.Path(path_type=Path))
@json_option
def claims(reports, as_json):
    """Test the paper's claims on reports that validate wrote.

    Is none above static above dynamic? Does BC(state) stay near its data? Does ID+BC beat the others? Does more data
    help? Reports that differ in their seed are taken together. A difference counts if it is at least two standard
    errors; a smaller one stays open. Last comes Spearman's rho between the scores and the paper's, as shares of their
    data's returns, with a 95 % bootstrap interval.

    \b
    dmcvb-gen validate releases/mini --profile quick --agents bc,state-bc,id+bc --seed 0 --out reports/seed0
    dmcvb-gen validate releases/mini --profile quick --agents bc,state-bc,id+bc --seed 1 --out reports/seed1
    dmcvb-gen claims reports/seed0 reports/seed1
    """
    from dataclasses import asdict

    from dmcvb_gen.benchmarks.agreement import rank_agreement, shared_cells
    from dmcvb_gen.benchmarks.claims import claim_words, judge, pool, read_reports

    results = read_reports(reports)
    answers, pooled, ranks = judge(results), pool(results), rank_agreement(shared_cells(results))
    if as_json:
        scores = [asdict(place) | asdict(score) for place, score in pooled.items()]
        ranked = [asdict(one) for one in ranks]
        print_json({"scores": scores, "answers": [asdict(answer) for answer in answers], "agreement": ranked})
        return
    for place, score in pooled.items():
        seeds = ", ".join(f"{mean:.1f}" for mean in score.seeds)
        where = f"{place.benchmark} {place.task} {place.learns_from}, {place.setting}"
        click.echo(f"{where}, {place.agent}: {score} (seeds: {seeds}); data {score.data:.1f}")
    for name, words in claim_words().items():
        found = [answer for answer in answers if answer.claim == name]
        if found:
            click.echo(f"\n{words}")
        for one in found:
            click.echo(f"  {one.answer:>4}  {one.where}: {one.numbers}")
    if ranks:
        click.echo("\nAre scores ranked as in the paper? Spearman's rho [95 % interval]")
    for one in ranks:
        click.echo(f"  {one.task}: {one}")
    if not answers:
        click.echo(_no_answer(results))


def _no_answer(results) -> str:
    """Why results test no claim."""
    if not results:
        return "These reports hold no results: their checks failed, or nothing was trained; see the reports."
    if not any(result["profile"]["scores"] for result in results):
        return "These reports hold no scores that test any claim: use --profile brief, quick or paper."
    return (
        "No two scores of these reports answer a claim: add agents, settings or levels, see `dmcvb-gen claims --help`."
    )
