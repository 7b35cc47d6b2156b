"""rollout, cluster."""

from __future__ import annotations

import dataclasses
import time

import click

from dmcvb_gen import making
from dmcvb_gen.cli.common import answer, print_json, print_table
from dmcvb_gen.cli.options import command_of, parse_part
from dmcvb_gen.options import progress_bar
from dmcvb_gen.storage.places import is_url
from dmcvb_gen.text import format_bytes, pluralize, quoted

OPTION_GROUPS = {
    "What": ("recipe", "only", "levels", "distractors", "goals", "behaviour", "sample", "independent", "seed"),
    "How many": ("episodes", "max_steps", "action_repeat", "episode_range", "episodes_per_shard"),
    "Images": ("size", "renderer", "samples", "backgrounds", "split", "pixels"),
    "Where": ("out", "storage_options"),
}
"""Heading -> options of `rollout --help`."""
DISTRACTORS = """
\b
Distractors:
  none                      the model's own colors, camera and sky
  static                    drawn once an episode, at strength medium (0.2)
  dynamic                   changes in every frame
  dynamic_easy              strength 0.1 and 4 background videos
  dynamic_hard              strength 0.3 and all background videos
  dynamic_0.35              any strength up to 1
  dynamic_camera0.1         only this part varies, with its own strength;
                            parts: camera, color, background, light
  static_color-background4  two parts; of a background, the number of videos
  dynamic_color-cue0.8      a cue that correlates with the last action
"""


@command_of(making.rollout, groups=OPTION_GROUPS, epilog=DISTRACTORS)
@click.option("--dry-run", is_flag=True, help="List finished and remaining shards; write nothing.")
def rollout(dry_run, as_json, progress, workers, other_versions, **options):
    """Roll out behaviour policies into a release of episodes.

    Rerun the same command to resume: finished shards are kept. With --recipe, TASK, --level, --distractor and
    --goal select a part of the recipe, and other options override its values. Without TASK and --recipe, the
    release at --out resumes from its own recipes. On many machines: `dmcvb-gen cluster`.

    \b
    dmcvb-gen rollout walker-walk --distractor dynamic --episodes 8
    dmcvb-gen rollout walker-walk cheetah-run --level expert --level medium \\
        --distractor none --distractor dynamic --out releases/mine
    dmcvb-gen rollout --recipe dmcvb-mini --only 'walker-walk/*/static'
    """
    from dmcvb_gen.generate.counts import check_room
    from dmcvb_gen.generate.plan import start

    plan = _plan(options)
    if dry_run:
        return _show_plan(plan, as_json)
    check_room(plan)
    start(plan, other_versions)
    _run(plan, workers, as_json)


@click.group()
def cluster():
    """Make a release on many machines: begin it once, make its parts anywhere, finish it.

    \b
    dmcvb-gen cluster begin --recipe dmcvb-v1 --out s3://bucket/mine
    dmcvb-gen cluster part s3://bucket/mine 1/64    # 1/64 to 64/64, anywhere
    dmcvb-gen cluster finish s3://bucket/mine
    """


NOT_BEGUN = {"only", "episode_range"}  # whole recipes are begun
BEGUN = {heading: tuple(one for one in names if one not in NOT_BEGUN) for heading, names in OPTION_GROUPS.items()}
BEGIN = ("tasks", "other_versions", *sum(BEGUN.values(), ()))


@command_of(making.rollout, groups=BEGUN, only=BEGIN, epilog=DISTRACTORS)
def begin(as_json, progress, other_versions, **options):
    """Create a release without generating any episodes. The options are those of `rollout`."""
    from dmcvb_gen.generate.plan import start

    plan = _plan(options | {"only": (), "episode_range": None})
    start(plan, other_versions, command="cluster begin")
    place = quoted(plan.release.place)
    same = " (with the same --option)" if options["storage_options"] else ""
    begun = f"begun, {pluralize(len(plan.works), 'shards')} to make: dmcvb-gen cluster part {place} 1/N to N/N{same}"
    answer(as_json, {"out": plan.release.place, "shards": len(plan.works)}, f"{plan.release.place}: {begun}")


@command_of(making.rollout, only=("only", "episode_range", "workers", "storage_options", "other_versions"))
@click.argument("release", metavar="RELEASE|URL")
@click.argument("part", metavar="K/N")
def part(release, part, as_json, workers, other_versions, only, episode_range, storage_options, progress):
    """Make part K of N of a begun release.

    A part is every N-th shard, starting with the K-th.
    """
    from dmcvb_gen.generate.plan import make_plan, start
    from dmcvb_gen.storage.store import open_store

    store = open_store(release, storage_options)
    plan = make_plan(None, store, only or (), episode_range, parse_part("PART", part))
    start(plan, other_versions, "cluster part")
    same = " (with the same --option)" if storage_options else ""
    _run(plan, workers, as_json, then=f"`dmcvb-gen cluster finish {quoted(store.place)}`{same}")


@command_of(making.rollout, only=("storage_options",))
@click.argument("release", metavar="RELEASE|URL")
def finish(release, storage_options, as_json, progress):
    """Write the manifest of all finished shards. Exit code 1 while shards are missing."""
    from dmcvb_gen.dataset.gate import Release
    from dmcvb_gen.dataset.writer import finish as write
    from dmcvb_gen.errors import StoreError
    from dmcvb_gen.storage.store import open_store

    store = open_store(release, storage_options)
    Release.in_making(store)  # or says that nothing was begun there
    if Release.read_copy(store) is not None:
        raise StoreError(f"{store.place} is a copy of a release, which was finished where it was made")
    done = write(store)
    missing = list(done.unfinished)
    state = "complete"
    if missing:
        state = f"not complete; shards are missing in {pluralize(len(missing), 'subsets')}, e.g. {missing[0]}"
    facts = {"out": store.place, "complete": not missing, "incomplete": missing, "digest": done.digest}
    answer(as_json, facts, f"{store.place}: {state}", code=1 if missing else 0)


for subcommand in (begin, part, finish):
    cluster.add_command(subcommand)


def _plan(options):
    """The plan of a command line, with a note on videos that it leaves out."""
    from dmcvb_gen.distractors.backgrounds import videos_by_split
    from dmcvb_gen.generate.plan import plan_of

    plan = plan_of(options)
    source, split = options["backgrounds"] or "builtin", options["split"] or "train"
    if source != "builtin" and (counts := videos_by_split(source)):
        other = {"train": "evaluation (--split val)", "val": "training (--split train)"}[split]
        click.echo(
            f"{source}: {counts[split]} of {sum(counts.values())} videos used; the rest is kept for {other}. "
            "To choose them yourself, put them into folders named train and val.",
            err=True,
        )
    return plan


def _run(plan, workers, as_json, then=None):
    """Run a plan and tell its result; `then`: the command that finishes a release of which this is a part."""
    from dmcvb_gen.generate.plan import run_plan

    with progress_bar(not as_json, f" {plan.unit}", plan.release.manifest.name) as bar:
        started = time.monotonic()
        release, steps = run_plan(plan, workers, bar, finishing=not then)
    seconds, place = time.monotonic() - started, plan.release.place
    complete = not then and not release.unfinished
    facts = dict(out=place, complete=complete, digest=release.digest, steps=steps, seconds=round(seconds, 2))
    named = quoted(place)
    state = "complete" if complete else f"not complete yet (dmcvb-gen rollout --out {named} --dry-run shows the rest)"
    if then:
        state = f"finished with {then} when all parts are done"
    rate = f" at {steps / seconds:,.0f} steps/s" if steps else ""
    done = f"{place}: {steps:,} steps in {seconds:.0f} s{rate}; the release is {state}."
    images = not is_url(str(place)) and any(layer.kind == "images" for layer in release.layers.values())
    look = f"Look at it: dmcvb-gen info {named}" + (f"; dmcvb-gen preview {named}" if images else "")
    answer(as_json, facts, done, *([] if then else [look]))


def _show_plan(plan, as_json):
    from dmcvb_gen.generate.counts import count

    counts = count(plan)
    left, frames, raw = (sum(getattr(subset, name) for subset in counts) for name in ("left", "frames", "raw_bytes"))
    facts = dict(out=plan.release.place, shards=len(plan.works), episodes=left, frames=frames, raw_bytes=raw)
    if as_json:
        return print_json(facts | dict(subsets=[dataclasses.asdict(subset) for subset in counts]))
    print_table(
        ("subset", "done", "to make", "images", "uncompressed"),
        [(c.name, f"{c.done:,}", f"{c.left:,}", f"{c.frames:,}", format_bytes(c.raw_bytes)) for c in counts],
        title=f"Plan of {plan.release.manifest.name} {plan.release.manifest.version}",
    )
    click.echo(f"release: {plan.release.place}")
    click.echo(
        f"{pluralize(len(plan.works), 'shards')} to make; {pluralize(left, 'episodes')}, {frames:,} images, at most "
        f"{format_bytes(raw)} before compression"
    )
