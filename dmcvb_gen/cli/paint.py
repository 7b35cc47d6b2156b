"""paint, fetch."""

from __future__ import annotations

import dataclasses

import click

from dmcvb_gen import commands, making
from dmcvb_gen.cli.common import answer, moved_files
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.text import pluralize


@command_of(making.paint)
def paint(release, as_json, **options):
    """Render the images of a release stored without pixels, and compare them with their known digests.

    Rerun the command to resume. With --size, --views or --goal it becomes another release,
    and its manifest says so. Other distractors or renderers: `dmcvb-gen repaint`. Exit code 1 if images differ
    from the known ones.

    \b
    dmcvb-gen rollout walker-walk --level expert --episodes 20 --no-pixels --out releases/light
    dmcvb-gen paint releases/light --workers 2
    """
    done = making.paint(release, notify=_tell, **options)
    facts = {"out": release} | _painted_facts(done)
    answer(as_json, facts, *_painted(release, done), code=1 if done.differing else 0)


@command_of(commands.fetch)
def fetch(as_json, **options):
    """Download a published release, or a part of it. Rerun the command to resume or to add more.

    With --paint, images are rendered during the download; the exit code is 1 if they differ from the published ones.

    \b
    dmcvb-gen fetch s3://bucket/dmcvb-mini --only 'walker-walk/expert/*' --range 0:200 --out data/mini
    dmcvb-gen fetch s3://bucket/dmcvb-mini-light --paint --size 84 --out data/mini84
    """
    moved, done = commands.download(options, notify=_tell)
    out, episodes = options["out"], options["episode_range"]
    facts = dataclasses.asdict(moved) | (_painted_facts(done) if done else {})
    lines = [f"{out}: {moved_files(moved)}", *(_whole_shards(out, episodes) if episodes else ())]
    lines += _painted(out, done) if done else ()
    answer(as_json, facts, *lines, code=1 if done and done.differing else 0)


def _whole_shards(out, episodes):
    """A line if shards brought more episodes than were asked for."""
    from dmcvb_gen.dataset.gate import Release

    first, last = episodes
    for name, subset in Release.open(out).subsets.items():
        here = subset.episodes
        if len(here) and (here[0] < first or here[-1] >= last):
            span = f"{here[0]}:{here[-1] + 1}"
            yield f"Shards are fetched whole: {name} has the episodes {span}; you asked for {first}:{last}."
            return


def _tell(text):
    """Say beside the output what is other here than where the release was made."""
    click.echo(f"note: {text}", err=True)


def _painted_facts(done):
    """Return the result of painting for programs."""
    return dict(
        shards=done.shards,
        known=done.known,
        differing=list(done.differing),
        drift=list(done.drift),
        complete=not done.release.shortfalls,
        digest=done.release.digest,
    )


def _painted(place, done):
    """Yield the result of painting in lines."""
    painted = f"{pluralize(done.shards, 'shards')} painted; {_compared(done)}."
    yield f"{place}: {painted if done.shards else 'every shard that is here has its images already.'}"
    yield from (f"  differs: {name}" for name in done.differing[:10])
    if done.differing:
        yield (
            "  what differs here is noted above" if done.drift else "  versions and processor are those of the release"
        )


def _compared(done) -> str:
    if not done.known:
        return "no digests of these images were known"
    if done.differing:
        return f"{len(done.differing)} of {done.known} differ from the known digests"
    return f"equal to the known digests ({done.known} of {done.shards})"
