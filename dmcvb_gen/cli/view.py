"""preview, view, card, import."""

from __future__ import annotations

import click

from dmcvb_gen.cli.common import answer
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.generate.preview import write_preview
from dmcvb_gen.options import refuse
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.import_tfds import import_tfds
from dmcvb_gen.release.viewer import view as write_viewer
from dmcvb_gen.text import format_bytes, pluralize


@command_of(write_preview)
def preview(as_json, progress, **options):
    """Write a contact sheet (PNG) and a video (WebP) of a release.

    \b
    dmcvb-gen preview releases/demo
    """
    files = list(map(str, write_preview(**options)))
    answer(as_json, files, *files)


@command_of(write_viewer)
def view(as_json, **options):
    """Write one HTML file that plays episodes: images, reward, actions, states and distractor labels.

    The file works without a network. Images that the release does not store are rendered for it.

    \b
    dmcvb-gen view releases/demo
    dmcvb-gen view releases/demo --only 'walker-walk/expert/*' --size 256
    """
    written = write_viewer(**options)
    shows = f"{pluralize(written.episodes, 'episodes')} of {pluralize(written.subsets, 'subsets')}"
    left_out = f", one image in {written.stride}" if written.stride > 1 else ""
    answer(as_json, vars(written), f"{written.path}: {shows}{left_out}, {format_bytes(written.bytes)}")


@command_of(write_card)
@click.option("--check", is_flag=True, help="Compare the card with the release and write nothing.")
def card(release, check, out, url, as_json, progress):
    """Write a release's card: README.md (with a Hugging Face header), croissant.json, images, a table.

    The table, card/episodes.parquet, has one row for each episode, with its first frame. `datasets.load_dataset` reads
    it.

    With --check, exit code 1 if the card does not match the data; of a fetched part, the table's rows are compared.

    \b
    dmcvb-gen card releases/mini
    """
    if check:
        refuse("--check writes no card", out=out, url=url)
        findings = check_card(release)
        lines = findings or [f"{release}: the card matches the data"]
        return answer(as_json, findings, *lines, code=1 if findings else 0)
    files = list(map(str, write_card(release, out, url)))
    answer(as_json, files, *files)


@command_of(import_tfds)
def import_command(out, as_json, **options):
    """Import DMC-VB's published TFDS folders (locomotion and mazes) into a release, without TensorFlow.

    Rerun the command to resume.

    \b
    dmcvb-gen import dmc_vb/locomotion --out releases/original
    """
    manifest = import_tfds(out=out, **options).manifest
    made = (f"{subset.name}: {pluralize(subset.episodes, 'episodes')}" for subset in manifest.subsets)
    answer(as_json, {"out": out, "subsets": [subset.name for subset in manifest.subsets]}, *made)
