"""paint."""

from __future__ import annotations

import click

from dmcvb_gen.cli.common import background_source, json_option, local_folder, print_json
from dmcvb_gen.cli.release import frames_bar


@click.command()
@click.argument("path")
@click.option("--only", multiple=True, metavar="PATTERN", help="Only these subsets, e.g. 'walker-walk/expert/*'.")
@click.option("--episodes", "episode_range", metavar="A:B", help="Only the shards that hold episodes A to B - 1.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda, for warp.")
@click.option("--backgrounds", metavar="FOLDER", help="Where the videos are, if the release has no copies.")
@json_option
@click.pass_context
def paint(context, path, only, episode_range, workers, device, backgrounds, as_json):
    """Fill in the pictures of a release that travelled without, and compare them with their known digests.

    What is painted already stays; run again, it goes on. Other sizes, distractors or renderers: `dmcvb-gen repaint`.
    Exit code 1 where pictures differ from the known ones.

    \b
    dmcvb-gen rollout walker-walk --level expert --episodes 20 --no-pixels --out releases/light
    dmcvb-gen paint releases/light --workers 2
    """
    from dmcvb_gen.cli.rollout import parse_range
    from dmcvb_gen.release.paint import paint_release

    folder = local_folder(path)
    videos = background_source(backgrounds) if backgrounds else None
    with frames_bar(as_json) as bar:
        done = paint_release(folder, only, parse_range(episode_range), workers, device, videos, bar.update)
    if as_json:
        print_json(
            dict(
                out=str(folder),
                shards=done.shards,
                known=done.known,
                differing=list(done.differing),
                drift=list(done.drift),
                complete=done.manifest.complete,
                digest=done.manifest.digest,
            )
        )
    else:
        for text in done.drift:
            click.echo(f"note: {text}")
        click.echo(f"{folder}: {done.shards} shards painted; {_compared(done)}.")
        for name in done.differing[:10]:
            click.echo(f"  differs: {name}")
    context.exit(1 if done.differing else 0)


def _compared(done) -> str:
    if not done.known:
        return "no digests of these pictures were known"
    if done.differing:
        return f"{len(done.differing)} of {done.known} differ from the known digests"
    return f"all {done.known} known ones have their digests"
