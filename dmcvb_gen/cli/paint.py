"""paint."""

from __future__ import annotations

import click

from dmcvb_gen.cli.cluster import executor_option, make_executor, ray_option
from dmcvb_gen.cli.common import OutPath, json_option, print_json
from dmcvb_gen.cli.release import episodes_option, frames_bar, only_option, workers_option
from dmcvb_gen.cli.render_options import override_options, overrides_of, painted_facts, show_painted, tell


@click.command()
@click.argument("path", type=OutPath())
@only_option
@episodes_option
@override_options
@workers_option
@executor_option
@ray_option
@click.option("--device", default="cpu", show_default=True, help="Device that renders: cpu, or cuda with warp.")
@click.option("--backgrounds", metavar="FOLDER", help="Folder of the background videos, if the release has no copies.")
@json_option
@click.pass_context
def paint(
    context, path, only, episodes, size, views, goal, workers, executor, ray_address, device, backgrounds, as_json
):
    """Fill in the pictures of a release that travelled without, and compare them with their known digests.

    What is painted already stays; run again, it goes on. With --size, --views or --goal it becomes another release,
    and its manifest says so. Other distractors or renderers: `dmcvb-gen repaint`. Exit code 1 where pictures differ
    from the known ones.

    \b
    dmcvb-gen rollout walker-walk --level expert --episodes 20 --no-pixels --out releases/light
    dmcvb-gen paint releases/light --workers 2
    """
    from dmcvb_gen.generate.paint import RenderConfig, paint_release
    from dmcvb_gen.generate.request import background_source

    videos = background_source(backgrounds) if backgrounds else None
    executor = make_executor(workers, executor, ray_address)
    with frames_bar(as_json) as bar:
        painter = RenderConfig(overrides_of(size, views, goal), executor, device, videos, bar, tell)
        done = paint_release(path, only, episodes, painter)
    if as_json:
        print_json({"out": path} | painted_facts(done))
    else:
        show_painted(path, done)
    context.exit(1 if done.differing else 0)
