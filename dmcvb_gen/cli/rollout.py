"""rollout."""

from __future__ import annotations

import dataclasses
import shlex

import click

from dmcvb_gen import commands
from dmcvb_gen.cli.common import answer, print_json, print_table
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.cli.slurm import script_for_slurm
from dmcvb_gen.cli.unused_options import check_exclusive_options
from dmcvb_gen.storage.remote import check_place, is_url
from dmcvb_gen.text import format_bytes, pluralize

OPTION_GROUPS = {
    "What": ("recipe", "only", "levels", "behaviour", "sample", "independent", "seed"),
    "Distractors": ("distractors", "difficulty", "intensity", "vary", "video_count", "correlated"),
    "Mazes": ("goals", "fixed_goals", "episodes_per_goal", "layouts", "reward"),
    "How many": ("episodes", "steps", "max_steps", "episode_range", "episodes_per_shard"),
    "Images": ("size", "renderer", "samples", "backgrounds", "split", "pixels"),
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
@click.option("--dry-run", is_flag=True, help="Show what is there and what would be made, and write nothing.")
def rollout(init, finishing, slurm_script, dry_run, as_json, progress, **options):
    """Roll out behaviour policies into a release of episodes.

    Rerun the same command to resume: finished shards are kept. With --recipe, TASK, --level, --distractor and
    --goal select a part of the recipe, and other options override its values. Without TASK and --recipe, the
    release at --out resumes from its own manifest.

    On many machines: run --init once, then --part 1/N to --part N/N anywhere, then --finish; see docs/scale.md.

    \b
    dmcvb-gen rollout walker-walk --level random --distractor dynamic --episodes 8
    dmcvb-gen rollout walker-walk cheetah-run --level expert --level medium \\
        --distractor none --distractor static --distractor dynamic --episodes 20 --workers 2 --out releases/mine
    dmcvb-gen rollout --recipe dmcvb-mini --only 'walker-walk/*/static' --out releases/mini
    """
    from dmcvb_gen.generate.plan import describe, finish_target
    from dmcvb_gen.generate.rollout import prepare_rollout, request_of, rollout_plan, target_for

    check_exclusive_options(click.get_current_context())
    request, workers = request_of(options), options["workers"]
    if slurm_script:
        check_place(options["out"] or "")
        if not request and target_for(options, request).manifest() is None:
            raise click.UsageError(f"{options['out']} holds no release to go on with; give TASKs or --recipe.")
        if request:
            describe(request, pixels=options["pixels"])  # or says why each task would be refused; this needs no GPU
        return click.echo(script_for_slurm(slurm_script, workers), nl=False)
    target = target_for(options, request)
    if finishing:
        begun = target.manifest() is not None
        if begun and request and (more := rollout_plan(options, request, target).growth):
            raise click.UsageError(
                f"{target.place} does not have {', '.join(more[:3])}, and --finish makes nothing; remove --finish."
            )
        return _finish(target, finish_target, as_json)
    plan = rollout_plan(options, request, target)
    if request:
        _tell_what_is_asked(request)
    _tell_what_is_there(plan, shared=dry_run or init or bool(options["part"]))
    _tell_what_stays(plan, options)
    if dry_run:
        return _show_plan(plan, as_json)
    plan = prepare_rollout(plan, options, init)
    if init:
        return _tell_begun(plan, as_json)
    _run(plan, workers, as_json, whole=not options["part"])


def _tell_what_is_asked(request):
    """A note on the use of one's own videos."""
    from dmcvb_gen.distractors.backgrounds import videos_by_split

    source, split = request.backgrounds, request.split
    if source != "builtin" and (counts := videos_by_split(source)):
        other = {"train": "evaluation (--split val)", "val": "training (--split train)"}[split]
        click.echo(
            f"{source}: {counts[split]} of {sum(counts.values())} videos used; the rest is kept for {other}. "
            "To choose them yourself, put them into folders named train and val.",
            err=True,
        )


def _tell_what_is_there(plan, shared):
    """Notes on a release that gains subsets or episodes, and on another rollout that works on it."""
    from dmcvb_gen.generate.target import rollouts_at_work

    if plan.growth:
        added = ", ".join(plan.growth[:3]) + (f" and {len(plan.growth) - 3} more" if len(plan.growth) > 3 else "")
        there = plan.target.manifest()
        click.echo(f"{plan.target.place} holds {there.name} {there.version} already; this adds {added}.", err=True)
    if not shared and (others := rollouts_at_work(plan.target)):
        click.echo(
            f"Another rollout is writing to {plan.target.place} ({', '.join(others)}), and both may make the same "
            "shards. To share work, stop one and give --part 1/2 and --part 2/2.",
            err=True,
        )


def _tell_what_stays(plan, options):
    """Notes on how new episodes of subsets that are there are stored, if it is not as the options say."""
    there, asked = plan.target.manifest() if plan.jobs else None, {record.name for record in plan.manifest.subsets}
    records = [record for record in there.subsets if record.name in asked] if there else []
    if records and not options["pixels"] and any(record.pixels for record in records):
        click.echo(f"{plan.target.place} has images, so its new episodes get images, too.", err=True)
    given = options["episodes_per_shard"]
    for record in [record for record in records if given and given > record.episodes_per_shard][:1]:
        kept = pluralize(record.episodes_per_shard, "episodes")
        click.echo(f"{record.name} keeps its shards of {kept}.", err=True)


def _tell_begun(plan, as_json):
    begun = f"begun, {pluralize(len(plan.jobs), 'jobs')} to do; make them with --part 1/N to N/N"
    facts = {"out": plan.target.place, "jobs": len(plan.jobs), "already_done": plan.done}
    answer(as_json, facts, f"{plan.target.place}: {begun}")


def _finish(target, finish_target, as_json):
    manifest = finish_target(target)
    missing = [subset.name for subset in manifest.subsets if subset.digest is None]
    state = "complete"
    if missing:
        state = f"not complete; shards are missing in {pluralize(len(missing), 'subsets')}, e.g. {missing[0]}"
    facts = {"out": target.place, "complete": manifest.complete, "incomplete": missing}
    answer(as_json, facts, f"{target.place}: {state}", code=0 if manifest.complete else 1)


def _run(plan, workers, as_json, whole=True):
    from dmcvb_gen.generate.rollout import run_plan

    finished = 0

    def count(result):
        nonlocal finished
        finished += sum(commit.episode_count for commit in result.commits)
        bar.set_postfix_str(f"{finished}/{plan.episodes} episodes", refresh=False)

    with commands.progress_bar(not as_json, f" {plan.unit}", plan.manifest.name) as bar:
        made = run_plan(plan, workers, bar, finishing=whole, on_result=count)
    manifest, steps, place = made.manifest, made.steps, plan.target.place
    facts = dict(out=place, complete=manifest.complete, steps=steps, seconds=round(made.seconds, 2))
    facts |= dict(seconds_by_part={part: round(value, 2) for part, value in made.seconds_by_part.items()})
    facts |= dict(already_done=plan.done, digests={subset.name: subset.digest for subset in manifest.subsets})
    named = shlex.quote(str(place))
    state = "complete" if manifest.complete else f"not complete yet (dmcvb-gen status {named} says what is missing)"
    if not whole:
        state = "finished with --finish when all parts are there"
    kept = f", {pluralize(plan.done, 'shards')} there already" if plan.done else ""
    rate = f" at {steps / made.seconds:,.0f} steps/s" if steps else ""
    done = f"{place}: {steps:,} steps in {made.seconds:.0f} s{rate}{kept}; the release is {state}."
    painted = not is_url(str(place)) and any(record.pixels for record in manifest.subsets)
    look = f"Look at it: dmcvb-gen info {named}" + (f"; dmcvb-gen preview {named}" if painted else "")
    answer(as_json, facts, done, look)


def _show_plan(plan, as_json):
    from dmcvb_gen.generate.counts import count

    counts = count(plan)
    left, frames, raw = (sum(getattr(subset, name) for subset in counts) for name in ("left", "frames", "raw_bytes"))
    facts = dict(out=plan.target.place, jobs=len(plan.jobs), shards_done=plan.done, episodes=left, frames=frames)
    if as_json:
        return print_json(facts | dict(raw_bytes=raw, subsets=[dataclasses.asdict(subset) for subset in counts]))
    print_table(
        ("subset", "done", "to make", plan.unit, "uncompressed"),
        [(c.name, f"{c.done:,}", f"{c.left:,}", f"{c.frames:,}", format_bytes(c.raw_bytes)) for c in counts],
        title=f"Plan of {plan.manifest.name} {plan.manifest.version}",
    )
    click.echo(f"release: {plan.target.place}")
    click.echo(
        f"{pluralize(len(plan.jobs), 'jobs')} to do, {pluralize(plan.done, 'shards')} done; {left:,} episodes, "
        f"{frames:,} {plan.unit}, at most {format_bytes(raw)} before compression"
    )
