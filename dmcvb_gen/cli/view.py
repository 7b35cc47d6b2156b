"""view."""

from __future__ import annotations

import functools
import webbrowser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import click

from dmcvb_gen.cli.common import OutPath, json_option, print_json, remote_option
from dmcvb_gen.cli.unused_options import refuse
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.text import format_bytes, pluralize

HOST = "127.0.0.1"


@click.command()
@click.argument("path", metavar="RELEASE|URL")
@click.option("--only", multiple=True, metavar="PATTERN", help="Show only these subsets. Repeatable.")
@click.option("--episodes", type=click.IntRange(1), help="Episodes of each subset.  [default: 12 in all]")
@click.option("--size", type=click.IntRange(8, 1024), help="Paint the images at this size instead of the stored one.")
@click.option("--max-mb", type=click.FloatRange(0.1), default=20.0, show_default=True, help="Largest file.")
@click.option("--open/--no-open", "open_it", default=None, help="Open the file.  [default: if there is a browser]")
@click.option("--serve", is_flag=True, help=f"Serve the file on {HOST}, for example through an SSH tunnel.")
@click.option("--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="Port for --serve.")
@click.option("--out", metavar="FILE", type=OutPath(), help="The file.  [default: RELEASE/preview/viewer.html]")
@remote_option
@json_option
@click.pass_context
def view(context, path, only, episodes, size, max_mb, open_it, serve, port, out, options, as_json):
    """Write one HTML file that plays episodes: images, reward, actions, states and distractor labels.

    The file works without a network. Images that the release does not store are painted for it.

    \b
    dmcvb-gen view releases/demo
    dmcvb-gen view releases/demo --only 'walker-walk/expert/*' --size 256
    dmcvb-gen view releases/demo --serve
    """
    from dmcvb_gen.release.viewer import view as write

    if serve and open_it:
        refuse(context, ("open_it",), "--serve opens no file")
    if not serve:
        refuse(context, ("port",), "without --serve nothing is served")

    given = dict(only=only, episodes=episodes, size=size, max_bytes=int(max_mb * 1e6), storage_options=options)
    with ProgressBar(not as_json, unit=" episodes") as bar:
        written = write(path, out, **given, progress=bar)
    if as_json:
        print_json(vars(written))
    else:
        shows = f"{pluralize(written.episodes, 'episodes')} of {pluralize(written.subsets, 'subsets')}"
        left_out = f", one image in {written.stride}" if written.stride > 1 else ""
        click.echo(f"{written.path}: {shows}{left_out}, {format_bytes(written.bytes)}")
    if serve:
        _serve(written.path, port)
    elif open_it or (open_it is None and not as_json and _has_browser()):
        webbrowser.open(written.path.resolve().as_uri())


def _has_browser() -> bool:
    """Return True if there is a graphical browser; one in the terminal would take the terminal."""
    try:
        return not isinstance(webbrowser.get(), webbrowser.GenericBrowser)
    except webbrowser.Error:
        return False


class OneFile(SimpleHTTPRequestHandler):
    """Serves a single file at "/" and nothing else."""

    def __init__(self, *arguments, file: Path, **options):
        self.file = file
        super().__init__(*arguments, directory=str(file.parent), **options)

    def translate_path(self, path):
        return str(self.file) if path.split("?")[0] == "/" else str(self.file.parent / ".not-served")

    def log_message(self, *arguments):
        """Print nothing for each request."""


def _serve(file: Path, port: int) -> None:
    """Serve the file on this machine alone until Ctrl-C."""
    try:
        server = ThreadingHTTPServer((HOST, port), functools.partial(OneFile, file=file.resolve()))
    except OSError as error:
        raise click.UsageError(f"port {port} cannot be used ({error.strerror}): give another --port") from None
    with server:
        click.echo(f"http://{HOST}:{server.server_port}/ (Ctrl-C stops)")
        server.serve_forever()
