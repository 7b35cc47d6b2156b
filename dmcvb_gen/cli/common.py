"""What the commands share: the --json option, folders and tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from dmcvb_gen.errors import DmcvbError

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs instead of tables.")


def print_json(value: Any) -> None:
    """Print a value as JSON; numpy numbers and paths are turned into plain ones."""
    click.echo(json.dumps(value, indent=2, default=_plain))


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


class OutPath(click.Path):
    """A folder or file of this machine to write to; refuses URLs."""

    def convert(self, value, param, ctx):
        from dmcvb_gen.store.remote import local_path

        try:
            local_path(value)
        except DmcvbError as error:
            self.fail(f"{error}.", param, ctx)
        return super().convert(value, param, ctx)


def background_source(given: str) -> str:
    """--backgrounds as a recipe has it: "builtin", or an absolute folder."""
    return given if given == "builtin" else str(Path(given).resolve())


def format_bytes(count: float) -> str:
    """1536 -> "1.5 kB" (powers of 1000)."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if abs(count) < 1000 or unit == "TB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    raise AssertionError("unreachable")


def format_duration(seconds: float) -> str:
    """5400 -> "90 min"."""
    for limit, unit, size in ((120, "s", 1), (7200, "min", 60), (172800, "h", 3600)):
        if seconds < limit:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.1f} days"


SECRETS = ("key", "secret", "token", "password", "credential")


def parse_options(context, parameter, pairs):
    """("endpoint_url=http://...",) -> {"endpoint_url": "http://..."}; a click callback that takes no secrets."""
    options = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise click.UsageError(f"--option {name!r} is not NAME=VALUE, e.g. endpoint_url=http://localhost:9000")
        if any(word in name.lower() for word in SECRETS):
            raise click.UsageError(f"Give {name} in the environment: others can read the command line.")
        options[name] = {"true": True, "false": False}.get(value.lower(), value)
    return options


remote_option = click.option(
    "--option",
    "options",
    multiple=True,
    metavar="NAME=VALUE",
    callback=parse_options,
    help="Of the file system (fsspec), e.g. endpoint_url=http://localhost:9000. Repeatable.",
)
