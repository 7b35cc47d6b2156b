"""fetch."""

from __future__ import annotations

import dataclasses
import os

import click

from dmcvb_gen.cli.common import OutPath, ProgressBar, format_bytes, json_option, print_json, remote_option
from dmcvb_gen.cli.release import episodes_option, only_option, transfers_option
from dmcvb_gen.cli.render_options import override_options, overrides_of, painted_facts, show_painted, tell


@click.command()
@click.argument("url")
@only_option
@episodes_option
@click.option("--paint", "painting", is_flag=True, help="Render the images of each shard as it arrives.")
@override_options
@click.option("--out", metavar="FOLDER", type=OutPath(), required=True, help="Local folder for the release.")
@remote_option
@transfers_option
@json_option
@click.pass_context
def fetch(context, url, only, episodes, painting, size, views, goal, out, options, workers, as_json):
    """Download a published release, or a part of it. Rerun the command to resume or to add more.

    With --paint, images are rendered during the download; the exit code is 1 if they differ from the published ones.

    \b
    dmcvb-gen fetch s3://bucket/dmcvb-mini --only 'walker-walk/expert/*' --episodes 0:200 --out data/mini
    dmcvb-gen fetch s3://bucket/dmcvb-mini-light --paint --size 84 --out data/mini84
    """
    from dmcvb_gen.release.fetch import fetch as run

    given = dict(options=options, workers=workers)
    if not painting:
        if size or views or goal:
            raise click.UsageError("--size, --views and --goal say what to --paint.")
        with ProgressBar(as_json, unit="B", unit_scale=True) as bar:
            moved, done = run(url, out, only, episodes, tick=bar, **given), None
    else:
        moved, done = _fetch_painted(url, out, only, episodes, overrides_of(size, views, goal), given, as_json)
    if as_json:
        print_json(dataclasses.asdict(moved) | (painted_facts(done) if done else {}))
    else:
        click.echo(f"{out}: {moved.files} files, {format_bytes(moved.bytes)}; {moved.moved} of them moved now")
        if episodes:
            _tell_whole_shards(out, episodes)
        if done:
            show_painted(out, done)
    context.exit(1 if done and done.differing else 0)


def _tell_whole_shards(out, episodes):
    """Say so if shards brought more episodes than were asked for."""
    from dmcvb_gen.dataset import open_release

    here = {name: len(subset.episodes) for name, subset in open_release(out).subsets.items()}
    name = max(here, key=here.get, default=None)
    if name and here[name] > (asked := episodes[1] - episodes[0]):
        click.echo(f"Shards come whole: {name} has {here[name]} episodes here, and {asked} were asked for.")


def _fetch_painted(url, out, only, episodes, overrides, given, as_json):
    from dmcvb_gen.generate.paint import RenderConfig
    from dmcvb_gen.release.fetch import fetch_and_paint

    with (
        ProgressBar(as_json, unit="B", unit_scale=True, desc="fetched") as bytes_bar,
        ProgressBar(as_json, unit=" frames", unit_scale=True, desc="painted") as frames,
    ):
        painter = RenderConfig(overrides=overrides, workers=os.cpu_count() or 1, progress=frames, notify=tell)
        return fetch_and_paint(url, out, only, episodes, painter=painter, tick=bytes_bar, **given)
