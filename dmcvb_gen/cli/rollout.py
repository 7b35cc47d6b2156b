"""rollout, info, preview, list."""

from __future__ import annotations

import contextlib
import os
import shlex
import textwrap
from pathlib import Path

import click

from dmcvb_gen import commands
from dmcvb_gen.cli.common import (
    OutPath,
    format_bytes,
    format_duration,
    json_option,
    print_json,
    print_table,
    remote_option,
)
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.cli.slurm import script_for_slurm
from dmcvb_gen.cli.unused_options import check_exclusive_options
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.storage.remote import is_url, public
from dmcvb_gen.text import pluralize

OPTION_GROUPS = {
    "What": ("recipe", "only", "levels", "behaviour", "sample", "independent", "seed"),
    "Distractors": ("distractors", "difficulty", "intensity", "vary", "video_count", "correlated"),
    "Mazes": ("goals", "fixed_goals", "episodes_per_goal", "layouts", "reward"),
    "How many": ("episodes", "steps", "max_steps", "episode_range", "episodes_per_shard"),
    "Images": ("size", "renderer", "samples", "device", "backgrounds", "split", "pixels"),
    "Where": ("out", "storage_options", "scratch", "scratch_size"),
    "Workers and many machines": (
        *("workers", "executor", "ray_address", "init", "part", "finishing", "other_versions", "slurm_script"),
    ),
}
"""Heading -> options of `rollout --help`."""


@command_of(commands.rollout, groups=OPTION_GROUPS)
@click.option("--init", is_flag=True, help="Create the release without generating any episodes.")
@click.option("--finish", "finishing", is_flag=True, help="Finish the release: write its digests. Generates nothing.")
@click.option(
    "--slurm-script", type=click.IntRange(1), metavar="N", help="Print a Slurm script for an array of N tasks."
)
@click.option("--dry-run", is_flag=True, help="Show jobs, steps, bytes and time for --workers, and write nothing.")
def rollout(init, finishing, slurm_script, dry_run, as_json, progress, **options):
    """Roll out behaviour policies into a release of episodes.

    Rerun the same command to resume: finished shards are kept. With --recipe, the options TASK, --level, --distractor
    and --goal select a part of the recipe, and other options override its values. Without TASK and --recipe, the
    release at --out resumes from its own manifest.

    On many machines: run --init once, then --part 1/N to --part N/N anywhere, then --finish; see docs/scale.md.

    \b
    dmcvb-gen rollout walker-walk --level random --distractor dynamic --episodes 8
    dmcvb-gen rollout walker-walk cheetah-run --level expert --level medium \\
        --distractor none --distractor static --distractor dynamic --episodes 20 --workers 2 --out releases/mine
    dmcvb-gen rollout --recipe dmcvb-mini --only 'walker-walk/*/static' --out releases/mini
    """
    from dmcvb_gen.generate.plan import describe, finish_site
    from dmcvb_gen.generate.rollout import prepare_rollout, request_of, rollout_plan, site_for

    check_exclusive_options(click.get_current_context())
    request, workers = request_of(options), options["workers"]
    if slurm_script:
        if request:
            describe(request, pixels=options["pixels"])  # or says why each task would be refused; this needs no GPU
        return click.echo(script_for_slurm(slurm_script, workers), nl=False)
    site = site_for(options, request)
    if finishing:
        return _finish(site, finish_site, as_json)
    plan = rollout_plan(options, request, site)
    if request:
        _tell_what_is_asked(request, options)
    if dry_run:
        return _show_plan(plan, workers, as_json)
    shared = init or bool(options["part"])
    _tell_what_is_there(plan, shared)
    plan = prepare_rollout(plan, options, init)
    if init:
        return _tell_begun(plan, as_json)
    _run(plan, workers, as_json, whole=not options["part"])


def _tell_what_is_asked(request, options):
    """Notes on another renderer than the usual one, and on the use of one's own videos."""
    from dmcvb_gen.distractors.backgrounds import videos_by_split

    device, source, split = options["device"] or "cpu", request.backgrounds, request.split
    if device != "cpu" and not options["recipe"] and not options["renderer"]:
        click.echo(f"Using the warp renderer: native does not support {device.upper()}.", err=True)
    if source != "builtin" and (counts := videos_by_split(source)):
        other = {"train": "evaluation (--split val)", "val": "training (--split train)"}[split]
        click.echo(
            f"{counts[split]} of {sum(counts.values())} videos in {source} are used; the others are kept for {other}. "
            "To choose them yourself, put them into folders named train and val.",
            err=True,
        )


def _tell_what_is_there(plan, shared):
    """Notes on a release that gains subsets or episodes, and on another rollout that works on it."""
    from dmcvb_gen.generate.site import rollouts_at_work

    if plan.growth:
        added = ", ".join(plan.growth[:3]) + (f" and {len(plan.growth) - 3} more" if len(plan.growth) > 3 else "")
        click.echo(f"{plan.site.place} is a release already; this adds {added}.", err=True)
    if not shared and (others := rollouts_at_work(plan.site)):
        click.echo(
            f"Another rollout is writing to {plan.site.place} ({', '.join(others)}), and both make the same shards. To "
            "share the work, stop one and give --part 1/2 and --part 2/2.",
            err=True,
        )


def _tell_begun(plan, as_json):
    if as_json:
        return print_json({"out": plan.site.place, "jobs": len(plan.jobs), "already_done": plan.done})
    click.echo(f"{plan.site.place}: begun, {pluralize(len(plan.jobs), 'jobs')} to do; make them with --part 1/N to N/N")


def _finish(site, finish_site, as_json):
    manifest = finish_site(site)
    missing = [subset.name for subset in manifest.subsets if subset.digest is None]
    if as_json:
        print_json({"out": site.place, "complete": manifest.complete, "incomplete": missing})
    elif missing:
        lacking = pluralize(len(missing), "subsets")
        click.echo(f"{site.place}: not complete; shards are missing in {lacking}, e.g. {missing[0]}")
    else:
        click.echo(f"{site.place}: complete")
    click.get_current_context().exit(0 if manifest.complete else 1)


def _run(plan, workers, as_json, whole=True):
    from dmcvb_gen.generate.rollout import run_plan

    finished = 0

    def count(result):
        nonlocal finished
        finished += sum(commit.episode_count for commit in result.commits)
        bar.set_postfix_str(f"{finished}/{plan.episodes} episodes", refresh=False)

    with _interruption_message(), commands.progress_bar(not as_json, " frames", plan.manifest.name) as bar:
        made = run_plan(plan, workers, bar, finishing=whole, on_result=count)
    manifest, steps, place = made.manifest, made.steps, plan.site.place
    if as_json:
        print_json(
            dict(
                out=place,
                complete=manifest.complete,
                steps=steps,
                seconds=round(made.seconds, 2),
                seconds_by_part={part: round(value, 2) for part, value in made.seconds_by_part.items()},
                already_done=plan.done,
                digests={subset.name: subset.digest for subset in manifest.subsets},
            )
        )
        return
    state = "complete" if manifest.complete else "not complete yet (only a part was asked for)"
    if not whole:
        state = "finished with --finish when all parts are there"
    kept = f", {pluralize(plan.done, 'shards')} there already" if plan.done else ""
    rate = f" at {steps / made.seconds:,.0f} steps/s" if steps else ""
    click.echo(f"{place}: {steps:,} steps in {made.seconds:.0f} s{rate}{kept}; the release is {state}.")
    named = shlex.quote(str(place))
    painted = not is_url(str(place)) and any(record.pixels for record in manifest.subsets)
    click.echo(f"Look at it: dmcvb-gen info {named}" + (f"; dmcvb-gen preview {named}" if painted else ""))


@contextlib.contextmanager
def _interruption_message():
    try:
        yield
    except KeyboardInterrupt:
        click.echo("\nInterrupted. Finished shards are saved; rerun the same command to resume.", err=True)
        raise


def _show_plan(plan, workers, as_json):
    from dmcvb_gen.generate.estimate import estimate, measurements

    cores, workers = os.cpu_count() or 1, workers if isinstance(workers, int) else 1
    with ProgressBar(not as_json, total=measurements(plan), unit=" measurements", leave=False) as bar:
        cost = estimate(plan, workers, bar.update)
    if as_json:
        rates = {
            name: dict(
                steps_per_second=1 / rate.seconds_per_step,
                bytes_per_step=rate.bytes_per_step,
                steps_per_episode=rate.steps_per_episode,
            )
            for name, rate in cost.rates.items()
        }
        print_json(
            dict(
                jobs=cost.jobs,
                shards_done=cost.done,
                subsets=len(plan.manifest.subsets),
                episodes=cost.episodes,
                steps=cost.steps,
                bytes=round(cost.bytes),
                core_hours=cost.core_seconds / 3600,
                hours=cost.seconds(workers) / 3600,
                workers=workers,
                rates=rates,
            )
        )
        return
    rows: dict[str, list[float]] = {}
    for job in plan.jobs:
        for record in job.subsets:
            rate = cost.rates[record.name]
            steps = len(job.episodes) * rate.steps_per_episode
            row = rows.setdefault(record.name, [0, 0.0, 0.0, 0.0])
            row[0] += len(job.episodes)
            row[1] += steps
            row[2] += steps * rate.bytes_per_step
            row[3] += steps * rate.seconds_per_step / 3600
    print_table(
        ("subset", "episodes", "steps", "bytes", "core-hours"),
        [
            (name, f"{episodes:,}", f"{steps:,.0f}", format_bytes(size), f"{hours:.2f}")
            for name, (episodes, steps, size, hours) in rows.items()
        ],
        title=f"Plan of {plan.manifest.name} {plan.manifest.version}",
    )
    spans = {count: format_duration(cost.seconds(count)) for count in (workers, cores, 64)}
    click.echo(f"release: {plan.site.place}")
    click.echo(
        f"{pluralize(cost.jobs, 'jobs')} to do, {pluralize(cost.done, 'shards')} done; "
        f"{cost.steps:,} steps, {format_bytes(cost.bytes)}"
    )
    click.echo(
        f"{cost.core_seconds / 3600:.2f} core-hours: {spans[workers]} with --workers {workers}, "
        f"{spans[cores]} with the {cores} cores here, {spans[64]} with 64"
    )


@click.command()
@click.argument("path", metavar="RELEASE|URL")
@remote_option
@json_option
def info(path, options, as_json):
    """Show the subsets, episodes, bytes and returns of a release beside the paper's.

    \b
    dmcvb-gen info releases/demo
    """
    from dmcvb_gen.generate.info import describe_release

    facts = describe_release(path, options)
    if as_json:
        return print_json(facts)
    statistics = ("mean", "std", "min", "p25", "median", "p75", "max")
    rows = []
    for subset in facts["subsets"]:
        planned = "" if subset["complete"] else f"/{subset['episodes_planned']:,}"
        mark = " *" if subset["paper"] and subset["shorter"] else ""
        rows.append(
            (
                subset["name"] + mark,
                f"{subset['episodes']:,}{planned}",
                f"{subset['steps']:,}",
                format_bytes(subset["bytes"]),
                f"{subset['bytes_per_step']:,.0f}",
                *(f"{subset['returns'][key]:.1f}" for key in statistics),
            )
        )
        if paper := subset["paper"]:
            numbers = (f"{paper[key]:.1f}" for key in statistics)
            rows.append(("  DMC-VB paper", "", f"{paper['steps']:,.0f}", "", "", *numbers))
    print_table(
        ("subset", "episodes", "steps", "size", "B/step", *statistics),
        rows,
        title=f"{facts['name']} {facts['version']}" + ("" if facts["complete"] else " (not complete)"),
        optional=(("B/step",), ("p25", "p75"), ("min", "max"), ("size",), ("median",)),
    )
    click.echo(f"{facts['steps']:,} steps, {format_bytes(facts['bytes'])}; made by {facts['generator']}")
    if any(subset["paper"] and subset["shorter"] for subset in facts["subsets"]):
        click.echo("* Episodes end sooner than the paper's, so their returns do not compare.")
    if facts["digest"]:
        click.echo(f"digest {facts['digest']}")


@click.command()
@click.argument("path")
@click.option("--only", multiple=True, metavar="PATTERN", help="Show only these subsets.")
@click.option("--out", type=OutPath(path_type=Path), help="Output folder.  [default: PATH/preview]")
@click.option("--episodes", type=click.IntRange(1), default=4, show_default=True, help="Episodes per subset.")
@click.option("--scale", type=click.IntRange(1, 8), help="Enlarge the images.  [default: 2; videos of 512 pixels]")
@click.option(
    "--frames", type=click.IntRange(1), default=200, show_default=True, help="Frames of the video, at 20 per second."
)
@click.option("--episode", type=click.IntRange(0), help="Episode of the video.  [default: the first of each subset]")
@click.option(
    "--video",
    type=click.Choice(["mp4", "webp", "gif"]),
    help="Format of the video.  [default: mp4, or webp without imageio-ffmpeg]",
)
@json_option
def preview(path, only, out, as_json, **options):
    """Write a contact sheet (PNG) and a video of a release.

    \b
    dmcvb-gen preview releases/demo
    """
    from dmcvb_gen.generate.preview import write_preview

    files = write_preview(path, out, only=only, **options)
    if as_json:
        return print_json([str(file) for file in files])
    for file in files:
        click.echo(file)


@click.command("list")
@click.option("--remote", metavar="URL", help="List the releases at a URL instead.")
@remote_option
@json_option
def list_command(remote, options, as_json):
    """List tasks, levels, distractors, bundled policies, recipes and the renderers that work here."""
    from dmcvb_gen.generate.info import describe_package

    if remote:
        return _list_remote(remote, options, as_json)
    facts = describe_package()
    if as_json:
        return print_json(facts)
    print_table(
        ("task", "state", "action", "steps", "<views", "<bundled behaviours"),
        [
            (
                task["id"],
                str(task["state"]),
                str(task["action"]),
                str(task["max_steps"]),
                ", ".join(task["views"]),
                ", ".join(task["behaviours"]) or "-",
            )
            for task in facts["tasks"]
        ],
        title="tasks",
        optional=(("views",),),
    )
    for heading, names in (
        ("tasks of dm_control's suite", facts["suite_tasks"]),
        ("levels", facts["levels"]),
        ("distractors", facts["distractors"]),
        ("difficulties", [*facts["difficulties"], "or a scale up to 1 (dynamic_0.35)"]),
        ("maze goals", facts["maze_settings"]),
        ("recipes", facts["recipes"]),
        ("manifests", facts["manifests"]),
    ):
        click.echo(textwrap.fill(f"{heading}: {', '.join(names)}", 80, break_on_hyphens=False))
    for name, reason in facts["renderers"].items():
        click.echo(f"renderer {name}: {'usable' if reason is None else 'not usable here: ' + reason}")


def _list_remote(url, options, as_json) -> None:
    from dmcvb_gen.dataset.catalog import releases_at

    found = releases_at(url, options)
    if as_json:
        return print_json(found)
    shown = ("url", "name", "version", "subsets", "episodes", "complete")
    print_table(
        ("release", "<name", "<version", "subsets", "episodes", "complete", "<digest"),
        [(*(str(facts[key]) for key in shown), (facts["digest"] or "-")[:12]) for facts in found],
        title=public(url),
        optional=(("subsets",), ("name",)),
    )
