"""view."""

from __future__ import annotations

import webbrowser

import click

from dmcvb_gen.cli.common import OutPath, json_option, print_json, remote_option
from dmcvb_gen.cli.options import Finite
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.text import format_bytes, pluralize


@click.command()
@click.argument("path", metavar="RELEASE|URL")
@click.option("--only", multiple=True, metavar="PATTERN", help="Show only these subsets. Repeatable.")
@click.option("--episodes", type=click.IntRange(1), help="Episodes of each subset.  [default: 12 in all]")
@click.option("--size", type=click.IntRange(8, 1024), help="Render the images at this size instead of the stored one.")
@click.option("--max-mb", type=Finite(0.1), default=20.0, show_default=True, help="Largest file.")
@click.option("--open/--no-open", "open_it", default=None, help="Open the file.  [default: if there is a browser]")
@click.option("--out", metavar="FILE", type=OutPath(), help="The file.  [default: RELEASE/preview/viewer.html]")
@remote_option
@json_option
def view(path, only, episodes, size, max_mb, open_it, out, options, as_json):
    """Write one HTML file that plays episodes: images, reward, actions, states and distractor labels.

    The file works without a network. Images that the release does not store are rendered for it.

    \b
    dmcvb-gen view releases/demo
    dmcvb-gen view releases/demo --only 'walker-walk/expert/*' --size 256
    """
    from dmcvb_gen.release.viewer import view as write

    given = dict(only=only, episodes=episodes, size=size, max_bytes=int(max_mb * 1e6), storage_options=options)
    with ProgressBar(not as_json, unit=" episodes") as bar:
        written = write(path, out, **given, progress=bar)
    if as_json:
        print_json(vars(written))
    else:
        shows = f"{pluralize(written.episodes, 'episodes')} of {pluralize(written.subsets, 'subsets')}"
        left_out = f", one image in {written.stride}" if written.stride > 1 else ""
        click.echo(f"{written.path}: {shows}{left_out}, {format_bytes(written.bytes)}")
    if open_it or (open_it is None and not as_json and _has_browser()):
        webbrowser.open(written.path.resolve().as_uri())


def _has_browser() -> bool:
    """Return True if there is a graphical browser; one in the terminal would take the terminal."""
    try:
        return not isinstance(webbrowser.get(), webbrowser.GenericBrowser)
    except webbrowser.Error:
        return False
