"""verify, regenerate, repaint, publish, export."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from dmcvb_gen import making
from dmcvb_gen.cli.common import answer, moved_files
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.dataset.manifest import RECIPES, VIDEOS
from dmcvb_gen.release.export import export as run_export
from dmcvb_gen.release.issue import NOT_PART
from dmcvb_gen.release.publish import publish as run_publish
from dmcvb_gen.release.verify import verify as run_verify
from dmcvb_gen.storage.places import is_url, local_path, shown, unpinned
from dmcvb_gen.text import pluralize, quoted


@command_of(run_verify)
def verify(release, as_json, **options):
    """Check a release: digests, shapes, values, physics, pixels, returns.

    At a URL nothing is downloaded: the manifest and its lists are checked, and a sample of files by digest.

    Exit codes: 0: complete, and all checks passed. 1: a check failed. 2: bad usage. 3: all checks passed, but a part
    is missing (an unfinished rollout, or a fetched part) or could not be checked on this machine.

    \b
    dmcvb-gen verify releases/demo
    """
    result = run_verify(release, **options)
    facts = {name: getattr(result, name) for name in ("sound", "complete", "digest", "compared", "checked")}
    facts |= {"findings": [dataclasses.asdict(finding) for finding in result.findings], "incomplete": result.incomplete}
    facts |= {"unchecked": [dataclasses.asdict(issue) for issue in result.unchecked]}
    code = 1 if not result.sound else 0 if result.complete else 3
    answer(as_json, facts, *_verified(release, result), code=code)


def _verified(path, result):
    """Yield the result of verify in lines."""
    yield from (f"FAIL {finding}" for finding in result.findings[:50])
    if len(result.findings) > 50:
        yield f"... and {len(result.findings) - 50} more"
    yield from (f"NOT CHECKED {issue.subset}: {issue.message}" for issue in result.unchecked)
    named = {name: counts for name, counts in result.incomplete.items() if counts[0] or len(result.incomplete) <= 10}
    yield from (f"{name}: {here:,} of {planned:,} episodes are complete" for name, (here, planned) in named.items())
    if absent := len(result.incomplete) - len(named):
        yield f"{absent:,} of {pluralize(len(result.incomplete), 'incomplete subsets')} have no local episodes."
    checked = ", ".join(pluralize(count, name) for name, count in result.checked.items())
    if result.checked["files"] < result.covered:
        checked += f" of {result.covered:,}"
    verdict = "All checks passed" if result.sound else pluralize(len(result.findings), "findings")
    if result.incomplete:
        verdict += f", incomplete: {pluralize(len(result.incomplete), 'subsets')}"
    elif result.sound and not result.finished:
        verdict += f", not finished: dmcvb-gen cluster finish {quoted(path)}"
    yield f"{path}: {verdict} ({checked})"
    if result.digest:
        yield f"digest {result.digest}"
        if not result.compared:
            yield "The digest was not compared; give the one that you expect: RELEASE@sha256:DIGEST"
    damaged = [found for found in result.findings if found.check == "files" and NOT_PART not in found.message]
    yield from _cures(path, {found.subset for found in damaged})


def _cures(path, places):
    """Yield the commands that repair damaged places: layers, or files of none."""
    path = unpinned(path)
    if places and is_url(path):
        yield f"`dmcvb-gen publish FOLDER {quoted(path)} --repair` replaces damaged and missing files."
        return
    videos = {place for place in places if place.startswith(VIDEOS)}
    if any(place.startswith(RECIPES) for place in places):
        yield f"`dmcvb-gen fetch SOURCE --out {quoted(path)} --repair` brings recipes back."
    if any(not place.startswith((VIDEOS, RECIPES)) for place in places):
        yield f"`dmcvb-gen regenerate {quoted(path)}` repairs damaged and missing shards."
    if videos:
        yield f"`dmcvb-gen regenerate {quoted(path)} --backgrounds FOLDER` restores the videos from FOLDER."


@command_of(making.regenerate)
def regenerate(release, out, as_json, **options):
    """Regenerate a release's shards from its manifest alone, bit for bit.

    Without --check and --out it repairs damaged and missing shards in place; of a fetched part, those of the part.
    Exit code 1 if a shard has another digest: the output lists the differences of the environment and of the values.
    With --check, exit code 3 if all local shards match, but others are missing.

    \b
    dmcvb-gen regenerate releases/mini --only '*/expert/*' --range 0:50 --check
    dmcvb-gen regenerate releases/mini
    dmcvb-gen regenerate --manifest quickstart --range 0:3 --out data/part
    """
    outcome = making.regenerate(release, out=out, **options)
    facts = {"sound": outcome.sound, "shards": [dataclasses.asdict(shard) for shard in outcome.shards]}
    facts |= {"environment": outcome.environment, "not_here": outcome.left, "restored": outcome.restored}
    code = 1 if not outcome.sound else 3 if outcome.left else 0
    answer(as_json, facts, *_regenerated(out or release, outcome), code=code)


def _regenerated(place, outcome):
    """Yield the result of regenerate in lines."""
    yield from outcome.shards
    if any(shard.equal is False for shard in outcome.shards):
        for name, (there, here) in outcome.environment.items():
            yield f"environment: {name} was {there} and is {here} on this machine"
        if not outcome.environment:
            yield "environment: no difference is known"
    if outcome.restored:
        files = pluralize(len(outcome.restored), "other files")
        yield f"{place}: restored {files}, e.g. {outcome.restored[0]}"
    if outcome.shards:
        left = f"; {outcome.left} others have no local files" if outcome.left else ""
        yield f"{place}: regenerated {pluralize(len(outcome.shards), 'shards')}{left}"
    elif not outcome.restored:
        yield f"{place}: {'this copy has none of these shards' if outcome.left else 'no shard is damaged or missing'}"


@command_of(making.repaint)
def repaint(release, out, as_json, **options):
    """Render stored episodes from their physics states into a new release. Nothing is simulated.

    \b
    dmcvb-gen repaint releases/mini --only '*/*/none' --distractor static \\
        --size 84 --renderer opengl --out releases/mini84
    """
    release = making.repaint(release, out=out, **options)
    subsets = release.manifest.subsets
    facts = {"out": out, "complete": not release.shortfalls, "subsets": [subset.name for subset in subsets]}
    made = (f"{subset.name}: {subset.size} pixels, {subset.renderer['name']}" for subset in subsets)
    answer(as_json, facts, *made, f"{out}: rendered; look at it: dmcvb-gen preview {quoted(out)}")


@command_of(run_publish, "release", "url")
def publish(release, url, as_json, **options):
    """Upload a complete release: every file is checked, and the manifest comes last.

    A published version never changes. Rerun the command to resume. Add --repair to replace files that `verify URL`
    found damaged. Credentials come from the environment.

    \b
    dmcvb-gen publish releases/mini s3://bucket/dmcvb-mini
    dmcvb-gen publish releases/mini s3://bucket/dmcvb-mini-light --no-pixels
    """
    moved = run_publish(release, url, **options)
    answer(as_json, dataclasses.asdict(moved), f"{shown(url)}: {moved_files(moved)}")


@command_of(run_export)
def export(release, to, out, as_json, **options):
    """Write subsets in another format: a folder for each subset. Rerun the command to resume.

    An incomplete subset is refused, unless --range selects episodes that exist.

    \b
    dmcvb-gen export releases/mini --to hdf5 --only '*/*/none' --out exports/h5
    """
    folders = run_export(release, to, out, **options)
    shown = [str(Path(out) / folder.relative_to(local_path(out).absolute())) for folder in folders]  # as --out has it
    answer(as_json, shown, *shown)
