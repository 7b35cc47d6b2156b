"""verify, regenerate, repaint, publish, fetch, card, export."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import click

from dmcvb_gen.cli.cluster import executor_option, make_executor, ray_option
from dmcvb_gen.cli.common import (
    OutPath,
    ProgressBar,
    format_bytes,
    json_option,
    print_json,
    remote_option,
)
from dmcvb_gen.cli.unused_options import given_options, refuse
from dmcvb_gen.spec import DIFFICULTIES, LABEL_TYPES, SPLITS
from dmcvb_gen.text import pluralize


@click.command()
@click.argument("path", metavar="RELEASE|URL")
@click.option("--all", "everything", is_flag=True, help="At a URL: read every file instead of a sample.")
@click.option("--backgrounds", metavar="FOLDER", help="Folder of the background videos, if it has moved.")
@click.option(
    "--workers", type=click.IntRange(1), help="Worker processes; at a URL: parallel downloads.  [default: 1; 8]"
)
@executor_option
@ray_option
@remote_option
@json_option
@click.pass_context
def verify(context, path, everything, backgrounds, workers, executor, ray_address, options, as_json):
    """Check that a release is what it says: digests, shapes, values, physics, pixels, returns.

    At a URL nothing is downloaded: manifest, index and commit records are checked, and a sample of files by digest.

    Exit code 0 when sound and complete, 1 when a check fails, 2 on bad usage, 3 when what is here is sound but is not
    the whole release (a rollout that is not finished, or a part that was fetched).

    \b
    dmcvb-gen verify releases/demo
    """
    from dmcvb_gen.release.verify import verify as run
    from dmcvb_gen.release.verify_url import WORKERS, verify_url
    from dmcvb_gen.storage.remote import is_url

    given = given_options(context)
    if is_url(path):
        refuse(context, given, ("backgrounds", "executor", "ray_address"), "at a URL nothing is painted or simulated")
        with ProgressBar(as_json, unit=" files") as bar:
            result = verify_url(path, options, everything, bar, workers or WORKERS)
    else:
        refuse(context, given, ("everything", "options"), f"{path} is no URL, and is read whole")
        with ProgressBar(as_json, unit=" checks") as bar:
            executor = make_executor(workers or 1, executor, ray_address)
            result = run(path, backgrounds, bar, executor)
    if as_json:
        findings = [dataclasses.asdict(finding) for finding in result.findings]
        facts = {"sound": result.sound, "complete": result.complete, "digest": result.digest}
        print_json(facts | {"checked": result.checked, "findings": findings, "incomplete": result.incomplete})
    else:
        _tell_verified(path, result)
    context.exit(1 if not result.sound else 0 if result.complete else 3)


def _tell_verified(path, result):
    for finding in result.findings[:50]:
        click.echo(f"FAIL {finding}")
    if len(result.findings) > 50:
        click.echo(f"... and {len(result.findings) - 50} more")
    for name, (here, planned) in result.incomplete.items():
        click.echo(f"{name}: {here:,} of {planned:,} episodes")
    checked = ", ".join(pluralize(count, name) for name, count in result.checked.items())
    verdict = "sound" if result.sound else pluralize(len(result.findings), "findings")
    if result.incomplete:
        here = result.checked["episodes"]
        planned = here + sum(planned - count for count, planned in result.incomplete.values())
        verdict = ("" if result.sound else f"{verdict}, ") + f"incomplete: {here:,} of {planned:,} episodes"
    elif result.sound and not result.finished:
        verdict = f"sound, not finished: dmcvb-gen rollout --out {path} --finish"
    click.echo(f"{path}: {verdict} ({checked})")
    if result.digest:
        click.echo(f"digest {result.digest}")


def parse_episodes(context, parameter, text):
    """ "100:150" -> (100, 150); a click callback."""
    from dmcvb_gen.cli.rollout import parse_range

    try:
        return parse_range(text)
    except click.UsageError as error:
        raise click.UsageError(error.message.replace("--range", "--episodes")) from None


only_option = click.option("--only", multiple=True, metavar="PATTERN", help="Use only these subsets. Repeatable.")
episodes_option = click.option(
    "--episodes", metavar="A:B", callback=parse_episodes, help="Use only the shards with episodes A to B - 1."
)
workers_option = click.option(
    "--workers", type=click.IntRange(1), default=1, show_default=True, help="Worker processes."
)


def frames_bar(as_json):
    """A progress bar of painted frames."""
    return ProgressBar(as_json, unit=" frames", unit_scale=True)


@click.command()
@click.argument("path", metavar="[RELEASE]", required=False)
@click.option("--manifest", metavar="NAME|FILE", help="A shipped manifest or a manifest's file, instead of a release.")
@only_option
@episodes_option
@click.option("--check", is_flag=True, help="Compare digests and change nothing.")
@click.option("--out", metavar="FOLDER", type=OutPath(), help="Write the shards to this folder instead.")
@click.option("--backgrounds", metavar="FOLDER", help="Folder of the background videos, if it has moved.")
@click.option("--device", help="Render on cpu or cuda instead of the manifest's device.")
@workers_option
@executor_option
@ray_option
@json_option
@click.pass_context
def regenerate(
    context, path, manifest, only, episodes, check, out, backgrounds, device, workers, executor, ray_address, as_json
):
    """Make a release's shards again from its manifest alone, bit for bit.

    Repairs damaged and missing shards in place, unless --check or --out is given; of a part that was fetched, what was
    fetched. Exit code 1 when a shard comes out otherwise; what differs in the environment, and how far the values are,
    is said then. With --check, 3 when all that are here came out right, and others are not here.

    \b
    dmcvb-gen regenerate releases/mini --only 'walker-walk/expert/dynamic' --episodes 100:150 --check
    dmcvb-gen regenerate releases/mini
    dmcvb-gen regenerate --manifest quickstart --only '*/*/dynamic' --episodes 0:3 --out data/part
    """
    from dmcvb_gen.generate.regenerate import Regeneration
    from dmcvb_gen.generate.shipped import manifest_source

    if (path is None) == (manifest is None):
        raise click.UsageError("Give a RELEASE, or a manifest with --manifest.")
    if manifest and not out:
        raise click.UsageError("A manifest alone has no shards to repair; add --out FOLDER.")
    if check and out:
        raise click.UsageError("Give --check or --out, not both.")
    with manifest_source(manifest) if manifest else contextlib.nullcontext(path) as source, frames_bar(as_json) as bar:
        work = Regeneration(source, only, episodes, backgrounds, device, make_executor(workers, executor, ray_address))
        outcome = work.remake(out, bar) if out else (work.check if check else work.repair)(bar)
    if as_json:
        print_json(
            {
                "sound": outcome.sound,
                "shards": [dataclasses.asdict(shard) for shard in outcome.shards],
                "environment": outcome.environment,
                "not_here": outcome.left,
                "restored": outcome.restored,
            }
        )
    else:
        for shard in outcome.shards:
            click.echo(shard)
        if any(shard.equal is False for shard in outcome.shards):
            for name, (there, here) in outcome.environment.items():
                click.echo(f"environment: {name} was {there}, is {here}")
            if not outcome.environment:
                click.echo("environment: the same versions and processor as when the release was made")
        made = pluralize(len(outcome.shards), "shards")
        left = f"; {outcome.left} more not here" if outcome.left else ""
        nothing = "none of these shards is here" if outcome.left else "nothing is damaged or missing"
        if outcome.restored:
            files = pluralize(len(outcome.restored), "other files")
            click.echo(f"{path}: {files} put back, e.g. {outcome.restored[0]}")
        if outcome.shards or not outcome.restored:
            click.echo(f"{out or path}: {made} made again{left}" if outcome.shards else f"{path}: {nothing}")
    context.exit(1 if not outcome.sound else 3 if outcome.left else 0)


@click.command()
@click.argument("path", metavar="RELEASE")
@only_option
@click.option("--distractor", help="none, static or dynamic.  [default: as each subset has]")
@click.option("--difficulty", type=click.Choice(DIFFICULTIES), help="[default: as each subset has]")
@click.option("--size", type=int, help="Width and height in pixels.  [default: as each subset has]")
@click.option("--renderer", help="native, warp or opengl.  [default: as each subset has]")
@click.option("--samples", type=click.IntRange(1, 8), help="Samples per pixel: 1, 2, 4 or 8.")
@click.option(
    "--backgrounds", metavar="FOLDER", help="Background videos: builtin, or a folder.  [default: the recipe's]"
)
@click.option("--split", type=click.Choice(SPLITS), help="Background videos and maze styles.  [default: the recipe's]")
@click.option(
    "--label",
    "labels",
    multiple=True,
    type=click.Choice(list(LABEL_TYPES)),
    help="Also store depth or segmentation. Repeatable.",
)
@click.option("--device", default="cpu", show_default=True, help="Device that renders: cpu, or cuda with warp.")
@click.option("--name", help="Name of the new release.  [default: NAME-repainted]")
@click.option("--out", metavar="FOLDER", type=OutPath(), required=True, help="Folder of the new release.")
@workers_option
@executor_option
@ray_option
@json_option
def repaint(path, out, as_json, backgrounds, workers, executor, ray_address, **options):
    """Give episodes new pixels, from their stored physics states: nothing is simulated.

    \b
    dmcvb-gen repaint releases/mini --only '*/*/none' --distractor static --size 84 --renderer opengl \\
        --out releases/mini84
    """
    from dmcvb_gen.generate.repaint import Repainting
    from dmcvb_gen.generate.repaint import repaint as run
    from dmcvb_gen.generate.request import background_source

    request = Repainting(path, out, backgrounds=backgrounds and background_source(backgrounds), **options)
    with frames_bar(as_json) as bar:
        manifest = run(request, make_executor(workers, executor, ray_address), bar)
    if as_json:
        return print_json({"out": out, "complete": manifest.complete, "subsets": [s.name for s in manifest.subsets]})
    for subset in manifest.subsets:
        click.echo(f"{subset.name}: {subset.size} pixels, {subset.renderer['name']}")
    click.echo(f"{out}: repainted; look at it: dmcvb-gen preview {out}")


transfers_option = click.option(
    "--workers", type=click.IntRange(1), default=8, show_default=True, help="Parallel transfers."
)


@click.command()
@click.argument("path", metavar="RELEASE")
@click.argument("url")
@remote_option
@click.option("--take-over", is_flag=True, help="Publish even if another upload has claimed the URL.")
@transfers_option
@click.option("--no-pixels", is_flag=True, help="Publish without images; `paint` renders them again.")
@json_option
def publish(path, url, options, take_over, workers, no_pixels, as_json):
    """Put a complete release at a URL: every file checked, the manifest last, a published version never changed.

    Run again after an interruption, it goes on. Credentials come from the environment. Of an export (`export`), the
    files alone go there; one of LeRobot gets its tag on the Hub.

    \b
    dmcvb-gen publish releases/mini s3://bucket/dmcvb-mini
    dmcvb-gen publish releases/mini s3://bucket/dmcvb-mini-light --no-pixels
    """
    from dmcvb_gen.release.publish import publish_folder
    from dmcvb_gen.storage.remote import public

    with ProgressBar(as_json, unit=" files") as bar:
        given = dict(pixels=not no_pixels, take_over=take_over, options=options, workers=workers, tick=bar)
        moved = publish_folder(path, url, **given)
    if as_json:
        return print_json(dataclasses.asdict(moved))
    click.echo(f"{public(url)}: {moved.files} files, {format_bytes(moved.bytes)}; {moved.moved} of them moved now")


@click.command()
@click.argument("path", metavar="RELEASE")
@click.option("--check", is_flag=True, help="Compare the card with the release and write nothing.")
@click.option("--out", metavar="FOLDER", type=OutPath(), help="Folder of the card.  [default: the release]")
@click.option("--url", help="URL of the published release.  [default: the card's]")
@json_option
@click.pass_context
def card(context, path, check, out, url, as_json):
    """Write a release's card: README.md (with a Hugging Face header), croissant.json, pictures, CHANGELOG.md, a table.

    The table, card/episodes.parquet, has a row an episode with its first frame; `datasets.load_dataset` reads it.

    With --check, exit code 1 when the card does not fit the data, 3 when it fits the part that was fetched.

    \b
    dmcvb-gen card releases/mini
    """
    from dmcvb_gen.release.card import check_card, left_unchecked, write_card

    if check:
        if out:
            raise click.UsageError("Give --check or --out, not both.")
        findings, left = check_card(path), left_unchecked(path)
        if as_json:
            print_json(findings)
        else:
            fits = f"the episodes that are here; {left:,} are not" if left else "the release"
            click.echo("\n".join(findings) or f"{path}: the card fits {fits}")
        context.exit(1 if findings else 3 if left else 0)
    files = write_card(path, out, url)
    if as_json:
        return print_json([str(file) for file in files])
    click.echo("\n".join(str(file) for file in files))


@click.command()
@click.argument("path", metavar="RELEASE|URL")
@click.option("--to", required=True, help="Format, for example hdf5, minari, lerobot, rlds or rerun.")
@only_option
@click.option("--episodes", metavar="A:B", callback=parse_episodes, help="Export only episodes A to B - 1.")
@click.option("--merge", is_flag=True, help="lerobot: write all subsets as the tasks of one data set.")
@click.option("--video", is_flag=True, help="lerobot: store images as mp4 (smaller, lossy) instead of PNG.")
@click.option(
    "--workers", type=click.IntRange(1), default=1, show_default=True, help="Worker processes, one subset each."
)
@executor_option
@ray_option
@click.option("--out", metavar="FOLDER", type=OutPath(), required=True, help="Output folder, one folder per subset.")
@remote_option
@json_option
def export(path, to, only, episodes, merge, video, workers, executor, ray_address, out, options, as_json):
    """Write subsets in another format: a folder a subset, nothing is written over. Run again, it goes on.

    A subset that is not whole is refused, unless --episodes names what is there.

    \b
    dmcvb-gen export releases/mini --to hdf5 --only 'walker-walk/*/none' --out exports/mini
    """
    from dmcvb_gen.release.export import export as run

    executor = make_executor(workers, executor, ray_address)
    with ProgressBar(as_json, unit=" episodes") as bar:
        given = dict(merge=merge, video=video, workers=executor, storage_options=options, tick=bar)
        folders = run(path, to, out, only, episodes, **given)
    shown = [str(Path(out) / folder.relative_to(Path(out).absolute())) for folder in folders]  # as --out names them
    if as_json:
        return print_json(shown)
    click.echo("\n".join(shown))


@click.command("import")
@click.argument("folder")
@click.option("--task", help="Task of a folder whose path does not name it.")
@click.option("--level", help="Level of such a folder.")
@click.option("--setting", help="Setting of such a folder: none, static_medium, dynamic_medium, ...")
@click.option("--name", default="dmc-vb-original", show_default=True, help="Name of the new release.")
@click.option("--partial", is_flag=True, help="Import the files that are there, even if some are missing.")
@click.option("--out", metavar="FOLDER", type=OutPath(), required=True, help="Folder of the new release.")
@json_option
def import_command(folder, task, level, setting, name, partial, out, as_json):
    """Import DMC-VB's published TFDS folders (locomotion and mazes) into a release, without TensorFlow.

    Run again, it goes on where it stopped.

    \b
    dmcvb-gen import dmc_vb/locomotion --out releases/original
    """
    from dmcvb_gen.release.import_tfds import import_tfds

    with ProgressBar(as_json, unit=" episodes") as bar:
        given = dict(task=task, level=level, setting=setting, name=name, partial=partial, progress=bar)
        manifest = import_tfds(folder, out, **given)
    if as_json:
        return print_json({"out": out, "subsets": [subset.name for subset in manifest.subsets]})
    for subset in manifest.subsets:
        click.echo(f"{subset.name}: {pluralize(subset.episodes, 'episodes')}")


@click.command("diff")
@click.argument("one", metavar="RELEASE|URL")
@click.argument("other", metavar="RELEASE|URL")
@remote_option
@json_option
@click.pass_context
def diff_command(context, one, other, options, as_json):
    """Say which subsets, episodes and digests differ between two releases, by their manifests and commit records.

    Exit code 0 when nothing differs, 1 when something does.

    \b
    dmcvb-gen diff releases/mini s3://bucket/dmcvb-mini
    """
    from dmcvb_gen.release.diff import diff

    found = diff(one, other, options)
    if as_json:
        print_json([dataclasses.asdict(difference) for difference in found])
    else:
        click.echo("\n".join(str(difference) for difference in found) or "no difference")
    context.exit(1 if found else 0)
