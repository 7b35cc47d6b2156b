"""Options, progress bars and tables that the commands share."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Sequence
from typing import Any

import click
from tqdm import tqdm

from dmcvb_gen.errors import DmcvbError

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs instead of tables.")


class GroupedCommand(click.Command):
    """A command whose --help lists its options under headings.

    Args:
      option_groups: heading -> names of the options below it, as the function's parameters. Options that no heading
        names come last, under "Other".
    """

    def __init__(self, *arguments: Any, option_groups: dict[str, tuple[str, ...]], **options: Any):
        super().__init__(*arguments, **options)
        self.option_groups = option_groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        options = [parameter for parameter in self.get_params(ctx) if isinstance(parameter, click.Option)]
        records = {option.name: record for option in options if (record := option.get_help_record(ctx)) is not None}
        for heading, names in self.option_groups.items():
            with formatter.section(heading):
                formatter.write_dl([records.pop(name) for name in names])
        with formatter.section("Other"):
            formatter.write_dl(list(records.values()))


def print_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", optional: Sequence[tuple[str, ...]] = ()
) -> None:
    """Print a table that no terminal cuts: names on the left, numbers on the right.

    A table that is wider than the terminal (80 columns in a pipe) loses groups of `optional` columns, the first
    group first, and says so. If it is still too wide, the first column gets a line of its own above the others.

    Args:
      columns: headings; "<name" aligns a column to the left, as the first one always is.
      rows: texts, one for each column. A row whose first text begins with a space is printed dim.
    """
    from rich.console import Console
    from rich.text import Text

    console, heads = Console(highlight=False), [column.removeprefix("<") for column in columns]
    left = {i for i, column in enumerate(columns) if i == 0 or column.startswith("<")}
    lines, shown, stacked = [list(map(str, row)) for row in rows], list(range(len(heads))), False
    widths = [max(len(line[i]) for line in [heads, *lines]) for i in range(len(heads))]

    def width() -> int:
        cells = [widths[i] for i in shown[stacked:]]
        return sum(cells) + 2 * (len(cells) - 1) + 2 * stacked

    hidden = []
    for names in optional:
        if width() > console.width:
            shown = [i for i in shown if heads[i] not in names]
            hidden += [name for name in names if name in heads]
    stacked = width() > console.width

    def line_of(line: Sequence[str]) -> str:
        cells = [line[i].ljust(widths[i]) if i in left else line[i].rjust(widths[i]) for i in shown[stacked:]]
        return ("  " * stacked + "  ".join(cells)).rstrip()

    def put(line: Sequence[str], style: str) -> None:
        for text in ([line[0]] if stacked else []) + [line_of(line)]:
            console.print(Text(text, style), soft_wrap=True)

    if title:
        console.print(Text(title, "bold"), soft_wrap=False)
    put(heads, "bold")
    for line in lines:
        put(line, "dim" if line[0].startswith(" ") else "")
    if hidden:
        console.print(Text(f"(not shown: {', '.join(hidden)}; a wider terminal or --json shows them)", "dim"))


def print_json(value: Any) -> None:
    """Print a value as JSON; numpy numbers and paths are turned into plain ones."""
    click.echo(json.dumps(value, indent=2, default=_plain))


LOG_SECONDS = 60.0  # between two lines of progress where nobody watches a bar


class ProgressBar(tqdm):
    """tqdm's bar on a terminal; in a log (a batch job's file, a pipe) a line a minute, the first after a minute.

    A log keeps every state of a bar, so there it has to be rare, and ends in a newline instead of a carriage return.
    """

    def __init__(self, as_json: bool = False, **options: Any) -> None:
        self._logged = not sys.stderr.isatty()
        self._told = time.monotonic()
        if self._logged:
            line = "{l_bar} {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
            options |= dict(file=_Lines(), delay=LOG_SECONDS, mininterval=LOG_SECONDS, miniters=1, bar_format=line)
        super().__init__(disable=as_json, **options)

    def __call__(self, done: int | str = 1) -> None:
        """Progress callback: how much was done since the last call, or the name of the item in progress."""
        if isinstance(done, str):
            self.set_description(done, refresh=False)
        self.update(1 if isinstance(done, str) else done)

    def expect(self, count: float) -> None:
        """Set the expected total, which may change later."""
        self.total = count

    def refresh(self, *args: Any, **options: Any) -> bool | None:
        if self._logged:
            if time.monotonic() < self._told + LOG_SECONDS:
                return None
            self._told = time.monotonic()
        return super().refresh(*args, **options)


class _Lines:
    """A stream that turns each state of a bar into a line of standard error."""

    def write(self, text: str) -> None:
        if text.strip():
            click.echo(text.strip(), err=True)

    def flush(self) -> None:
        sys.stderr.flush()


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


class OutPath(click.Path):
    """A folder or file of this machine to write to; refuses URLs."""

    def convert(self, value, param, ctx):
        from dmcvb_gen.storage.remote import local_path

        try:
            local_path(value)
        except DmcvbError as error:
            self.fail(f"{error}.", param, ctx)
        return super().convert(value, param, ctx)


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
    help="Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000. Repeatable.",
)
