"""Options, progress bars and tables that the commands share."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

import click

from dmcvb_gen.text import format_bytes, printable

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs instead of tables.")

INTERRUPTED = 130
"""Exit code after Ctrl-C or SIGTERM, as shells have it; 1 means that a check failed."""


class GroupedCommand(click.Command):
    """A command whose --help lists its options under headings.

    Args:
      option_groups: heading -> names of the options below it, as the function's parameters. Options that no heading
        names come last.
    """

    def __init__(self, *arguments: Any, option_groups: dict[str, tuple[str, ...]] | None = None, **options: Any):
        super().__init__(*arguments, **options)
        self.option_groups = option_groups or {}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        try:
            *_, order = self.make_parser(ctx).parse_args(args=list(args))
        except click.UsageError as error:
            error.ctx = error.ctx or ctx  # names the command whose --help to read
            raise
        single = [each for each in order if isinstance(each, click.Option) and not (each.multiple or each.is_flag)]
        if twice := [each for number, each in enumerate(single) if each in single[:number]]:
            raise click.UsageError(f"{twice[0].opts[0]} is given twice, and takes one value; give one of them", ctx)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        options = [parameter for parameter in self.get_params(ctx) if isinstance(parameter, click.Option)]
        records = {option.name: record for option in options if (record := option.get_help_record(ctx)) is not None}
        for heading, names in self.option_groups.items():
            with formatter.section(heading):
                formatter.write_dl([records.pop(name) for name in names])
        with formatter.section("Other" if self.option_groups else "Options"):
            formatter.write_dl(list(records.values()))


def print_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", optional: Sequence[tuple[str, ...]] = ()
) -> None:
    """Print a table: names on the left, numbers on the right.

    A table that is wider than the terminal (80 columns in a pipe) loses groups of `optional` columns, the first
    group first, and says so.

    Args:
      columns: headings; "<name" aligns a column to the left, as the first one always is.
      rows: texts, one for each column. A row whose first text begins with a space is printed dim.
    """
    from rich.console import Console
    from rich.text import Text

    console, heads = Console(highlight=False), [printable(column.removeprefix("<")) for column in columns]
    left = {i for i, column in enumerate(columns) if i == 0 or column.startswith("<")}
    lines, shown = [[printable(str(cell)) for cell in row] for row in rows], list(range(len(heads)))
    widths = [max(len(line[i]) for line in [heads, *lines]) for i in range(len(heads))]

    hidden = []
    for names in optional:
        if sum(widths[i] + 2 for i in shown) - 2 > console.width:
            shown = [i for i in shown if heads[i] not in names]
            hidden += [name for name in names if name in heads]

    def put(line: Sequence[str], style: str) -> None:
        cells = [line[i].ljust(widths[i]) if i in left else line[i].rjust(widths[i]) for i in shown]
        console.print(Text("  ".join(cells).rstrip(), style), soft_wrap=True)

    if title:
        console.print(Text(printable(title), "bold"), soft_wrap=False)
    if lines:
        put(heads, "bold")
    for line in lines:
        put(line, "dim" if line[0].startswith(" ") else "")
    if hidden:
        console.print(Text(f"(not shown: {', '.join(hidden)}; a wider terminal or --json shows them)", "dim"))


def answer(as_json: bool, facts: Any, *lines: Any, code: int = 0) -> None:
    """Print facts as JSON for programs, or lines for people, and end the command.

    Args:
      code: exit code.
    """
    if as_json:
        print_json(facts)
    else:
        for line in lines:
            click.echo(printable(str(line)))
    if code:
        click.get_current_context().exit(code)


def print_json(value: Any) -> None:
    """Print a value as JSON; numpy numbers and paths are turned into plain ones."""
    click.echo(json.dumps(value, indent=2, default=lambda it: it.tolist() if hasattr(it, "tolist") else str(it)))


def moved_files(moved: Any) -> str:
    """Say what a publish or fetch moved."""
    return f"{moved.files} files, {format_bytes(moved.bytes)}; {moved.moved} of them copied now"


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
