"""validate, claims."""

from __future__ import annotations

import json
from pathlib import Path

import click

from dmcvb_gen.cli.cluster import executor_option, make_executor, ray_option
from dmcvb_gen.cli.common import OutPath, ProgressBar, json_option, print_json
from dmcvb_gen.cli.unused_options import given_options, refuse
from dmcvb_gen.text import pluralize

TRAINING = (
    *("benchmarks", "agents", "own", "profile", "scale", "seed"),
    *("train_unsound", "threads", "device", "precision", "compile", "dino_weights"),
)
"""Options of `validate` that say what is trained, and how."""


@click.command()
@click.argument("path")
@click.option("--profile", default="smoke", show_default=True, help="Budget: smoke (no scores), brief, quick or paper.")
@click.option("--scale", type=click.FloatRange(0, min_open=True), default=1.0, help="Multiply the profile's steps.")
@click.option("--benchmark", "benchmarks", multiple=True, help="b1, b2, b3, ablations. Repeatable.  [default: b1]")
@click.option("--agents", default="", metavar="A,B", help="Agents to train, e.g. bc,state-bc,id+bc.  [default: all]")
@click.option("--agent", "own", multiple=True, metavar="MODULE:NAME", help="Also score your own agent. Repeatable.")
@click.option("--only", multiple=True, metavar="PATTERN", help="Use only these subsets, e.g. 'walker-walk/expert/*'.")
@click.option(
    "--out", type=OutPath(path_type=Path, file_okay=False), help="Folder of the report.  [default: reports/NAME]"
)
@click.option("--checks-only", is_flag=True, help="Check the structure and train nothing.")
@click.option("--strict", is_flag=True, help="Exit with 1 on warnings (data unlike the paper's).")
@click.option("--train-unsound", is_flag=True, help="Run the benchmarks even if a check fails.")
@click.option("--workers", type=click.IntRange(1), help="Cells side by side.  [default: 2, on one core 1]")
@executor_option
@ray_option
@click.option("--threads", type=click.IntRange(1), help="Threads of each worker.  [default: cores / workers]")
@click.option("--device", type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True)
@click.option(
    "--precision",
    type=click.Choice(["auto", "float32", "bfloat16"]),
    default="auto",
    show_default=True,
    help="Precision of networks that see images; auto times both.",
)
@click.option("--compile", is_flag=True, help="Compile the losses with torch.compile (for CUDA and long runs).")
@click.option(
    "--memory", type=click.FloatRange(0), metavar="GB", help="Memory of all workers; ray: of each.  [default: half]"
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
@click.option("--dino-weights", type=click.Path(path_type=Path), help="Safetensors file with the weights of dino+bc.")
@click.option("--backgrounds", metavar="FOLDER", help="Folder of the background videos, if it has moved.")
@json_option
@click.pass_context
def validate(
    context, path, out, profile, scale, benchmarks, agents, own, only, checks_only, strict, as_json, **options
):
    """Check a release and run the paper's benchmarks on it, scores set beside the paper's.

    Exit code 0 when sound and complete, 1 when a check or a cell fails or episodes are missing, 2 on bad usage. The
    same command goes on where it stopped.

    \b
    dmcvb-gen validate releases/mini --profile smoke
    dmcvb-gen validate releases/mini --profile quick --benchmark b1 --agents bc,state-bc,id+bc --out reports/mini
    """
    from dmcvb_gen.benchmarks.run import default_workers
    from dmcvb_gen.benchmarks.validate import Progress, make_setup
    from dmcvb_gen.benchmarks.validate import validate as run

    if checks_only:
        refuse(context, given_options(context), TRAINING, "--checks-only trains nothing")
    workers = options.pop("workers") or default_workers(options["device"])
    executor = make_executor(workers, options.pop("executor"), options.pop("ray_address"))
    train_unsound = options.pop("train_unsound")
    given = dict(out=out, profile=profile, scale=scale, workers=executor, training=not checks_only, **options)
    setup = make_setup(path, **given)
    if options["precision"] == "auto" and not checks_only:
        click.echo(f"Networks that see images compute in {setup.precision}, the faster one here.", err=True)
    with ProgressBar(as_json, unit=" checks", desc="structure") as bar:
        progress = Progress(
            checking=bar,
            total=lambda steps: (setattr(bar, "unit", " steps"), bar.reset(steps)),
            training=lambda what, steps: (bar.set_description(what, refresh=False), bar.update(steps)),
            done=lambda cell, facts: None if as_json else _show_score(cell, facts, setup.profile),
        )
        result = run(
            path,
            setup,
            benchmarks=() if checks_only else benchmarks or ("b1",),
            agents=_agents(agents, own),
            patterns=only,
            workers=executor,
            train_unsound=train_unsound,
            progress=progress,
        )
    if as_json:
        print_json(json.loads(result.facts.read_text()))
    else:
        _show(result, setup.profile)
    context.exit(0 if result.sound and result.complete and not (strict and result.warnings) else 1)


def _show_score(cell, facts, profile) -> None:
    """A cell's score, as soon as it is there."""
    from dmcvb_gen.spec import task_folder

    if "error" in facts:
        return  # told at the end, where it is not overlooked
    score, paper = facts["score"], facts["paper"]
    shown = paper and profile.scores  # noise is never set beside the paper's numbers
    beside = f", paper {paper['mean']:.0f} +- {paper['stderr']:.0f}" if shown else ""
    where = f"{task_folder(cell.task)} {cell.policy_label}/{cell.setting}"
    goal = "" if score["success"] is None else f", success {100 * score['success']:.0f} %"
    goal += "" if score["speed"] is None else f" at {score['speed']:.2f} m/s"
    score = f"{score['mean']:.1f} +- {score['stderr']:.1f} [{profile.name}]"
    with ProgressBar.external_write_mode():
        click.echo(f"{where} {cell.agent.name}: {score}{goal}{beside}")


def _agents(names: str, own: tuple[str, ...]) -> list[str]:
    """The agents asked for; one's own alone are set beside BC from states."""
    from dmcvb_gen.agents.catalog import OWN, split_agents

    for name in own:
        if not OWN.fullmatch(name):
            raise click.UsageError(f"--agent {name} is not MODULE:NAME; the paper's agents are chosen with --agents.")
    return [*(split_agents(names) or (["state-bc"] if own else [])), *own]


def _show(result, profile) -> None:
    for finding in result.structure.findings[:50]:
        click.echo(f"FAIL {finding}")
    for cell, error in result.failed:
        click.echo(f"FAIL {cell.id}: {error}")
    for finding in result.warnings:
        click.echo(f"warning: {finding}")
    for entry in result.missing:
        if entry.subsets:
            names = ", ".join(entry.subsets)
            click.echo(f"{entry.benchmark}: not in the release: {names}; to get them: {entry.command}")
        if entry.left_out:
            click.echo(f"{entry.benchmark}: left out by --only: {', '.join(entry.left_out)}")
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
    click.echo(f"{'; '.join(verdict)} ({checked}){note}")
    click.echo(f"Report: {result.report}")


@click.command()
@click.argument("reports", nargs=-1, required=True, type=click.Path(path_type=Path))
@json_option
def claims(reports, as_json):
    """Test the paper's claims on reports that validate wrote.

    Is none above static above dynamic? Does BC(state) stay near its data? Does ID+BC beat the others? Does more data
    help? Reports that differ in their seed are taken together. A difference counts from two standard errors on (of the
    episodes, or of the seeds' means if these lie further apart); what lies nearer is open. Last comes Spearman's rho
    between the scores and the paper's, as shares of their data's returns, with a 95 % bootstrap interval.

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
        for answer in found:
            click.echo(f"  {answer.answer:>4}  {answer.where}: {answer.numbers}")
    if ranks:
        click.echo("\nAre scores ranked as in the paper? Spearman's rho [95 % interval]")
    for one in ranks:
        click.echo(f"  {one.task}: {one}")
    if not answers:
        click.echo("These reports hold no scores that test any claim: use --profile brief, quick or paper.")
