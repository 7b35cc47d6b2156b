"""Options and messages that `paint` and `fetch --paint` share."""

from __future__ import annotations

import click

from dmcvb_gen.spec import GOAL_PICTURES
from dmcvb_gen.text import pluralize

_OPTIONS = (
    click.option("--size", type=click.IntRange(1), help="Width and height in pixels.  [default: the manifest's]"),
    click.option("--views", metavar="A,B", help="Mazes: render only these views, e.g. egocentric.  [default: all]"),
    click.option(
        "--goal",
        type=click.Choice(GOAL_PICTURES),
        help="Mazes: render only images with, or without, the goal.  [default: both]",
    ),
)


def override_options(command):
    """--size, --views and --goal."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def overrides_of(size, views, goal):
    """The `RenderOverrides` that the options ask for."""
    from dmcvb_gen.generate.paint import RenderOverrides

    return RenderOverrides(size, tuple(name.strip() for name in views.split(",")) if views else None, goal)


def tell(text):
    """Say beside the output what is other here than where the release was made."""
    click.echo(f"note: {text}", err=True)


def painted_facts(done):
    """What painting gave, for programs."""
    return dict(
        shards=done.shards,
        known=done.known,
        differing=list(done.differing),
        drift=list(done.drift),
        complete=done.manifest.complete,
        digest=done.manifest.digest,
    )


def show_painted(place, done):
    """What painting gave, for people."""
    painted = f"{pluralize(done.shards, 'shards')} painted; {_compared(done)}."
    click.echo(f"{place}: {painted if done.shards else 'every shard that is here has its pictures already.'}")
    for name in done.differing[:10]:
        click.echo(f"  differs: {name}")
    if done.differing:
        click.echo(
            "  what differs here is noted above" if done.drift else "  versions and processor are those of the release"
        )


def _compared(done) -> str:
    if not done.known:
        return "no digests of these pictures were known"
    if done.differing:
        return f"{len(done.differing)} of {done.known} differ from the known digests"
    return f"equal to the known digests ({done.known} of {done.shards})"
