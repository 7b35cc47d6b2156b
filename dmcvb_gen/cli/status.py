"""status."""

from __future__ import annotations

import click

from dmcvb_gen.cli.common import format_duration, json_option, print_json, print_table, remote_option


@click.command()
@click.argument("place", metavar="RELEASE|URL")
@remote_option
@json_option
def status(place, options, as_json):
    """Show the progress of a release that is being made: shards done and late, steps/s, time left.

    It reads the commit records, so it works from any machine.

    \b
    dmcvb-gen status s3://bucket/mine
    """
    from dmcvb_gen.generate.progress import progress_of
    from dmcvb_gen.generate.site import site_of

    found = progress_of(site_of(place, options))
    if as_json:
        return print_json(found.facts())
    print_table(
        ("subset", "done", "late", "open"),
        [
            (subset.name, f"{subset.done:,}", f"{subset.late:,}", f"{subset.total - subset.done:,}")
            for subset in found.subsets
        ],
        title=f"{found.name}: {found.done:,} of {found.total:,} shards",
    )
    if found.steps_per_second:
        last, left = format_duration(found.silence), format_duration(found.seconds_left)
        rate = f"{found.steps_per_second:,.0f} steps/s"
        click.echo(f"{found.steps:,} steps; {rate}, last shard {last} ago; {left} left")
    if found.late:
        click.echo(
            f"{found.late} shards are late: later ones are done. They are still in progress or their worker died; "
            "rerun the same command to make them"
        )
    if found.done == found.total:
        click.echo("complete" if found.complete else "All shards are done; finish the release with --finish.")
