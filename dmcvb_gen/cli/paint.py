"""paint, fetch."""

from __future__ import annotations

import dataclasses

from dmcvb_gen import making
from dmcvb_gen.cli.common import answer, moved_files
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.release.fetch import download
from dmcvb_gen.release.fetch import fetch as run_fetch
from dmcvb_gen.text import pluralize


@command_of(making.paint)
def paint(release, as_json, **options):
    """Render the images of a release stored without pixels, and compare them with their known digests.

    Rerun the command to resume. With --size or --views a release grows, and its digest changes; that of a fetched
    part stays. Other distractors or renderers: `dmcvb-gen repaint`. Exit code 1 if images differ from the known ones.

    \b
    dmcvb-gen rollout walker-walk --no-pixels --out releases/light
    dmcvb-gen paint releases/light --workers 2
    """
    done = making.paint(release, **options)
    facts = {"out": release} | _painted_facts(done)
    answer(as_json, facts, *_painted(release, done), code=1 if done.differing else 0)


@command_of(run_fetch)
def fetch(as_json, **options):
    """Download a published release, or a part of it. Rerun the command to resume or to add more.

    With --paint, images are rendered after the download; the exit code is 1 if they differ from the published ones.

    \b
    dmcvb-gen fetch s3://bucket/mini --only 'walker-walk/*' --out data/mini
    dmcvb-gen fetch s3://bucket/light --paint --out data/light
    """
    moved, done = download(options)
    out = options["out"]
    facts = dataclasses.asdict(moved) | (_painted_facts(done) if done else {})
    lines = [f"{out}: {moved_files(moved)}", *(_painted(out, done) if done else ())]
    answer(as_json, facts, *lines, code=1 if done and done.differing else 0)


def _painted_facts(done):
    """Return the result of painting for programs."""
    return dict(
        shards=done.shards,
        known=done.known,
        differing=list(done.differing),
        drift=list(done.drift),
        complete=not any(each.missing(layer).any() for each in done.release.subsets.values() for layer in each.layers),
        digest=done.release.digest,
    )


def _painted(place, done):
    """Yield the result of painting in lines."""
    compared = f"{done.known} of {done.shards} have the digests of the release"
    if not done.known:
        compared = "This release has no image digests to compare with"
    elif done.differing:
        compared = f"MISMATCH: {len(done.differing)} of {done.known} shards have other digests than the release"
    rendered = f"Rendered {pluralize(done.shards, 'shards')}. {compared}."
    there = any(map(len, done.release.subsets.values()))
    nothing = "All local shards have images already." if there else "No episodes are here yet."
    yield f"{place}: {rendered if done.shards else nothing}"
    yield from (f"  differs: {name}" for name in done.differing[:10])
