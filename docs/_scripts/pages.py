"""Pages that the site makes: its first page from README.md, one for each command, and their index."""

from __future__ import annotations

import html
import inspect
import re
import tomllib
from pathlib import Path

import click
import mkdocs_gen_files

from dmcvb_gen.cli import COMMANDS, main

ROOT = Path(__file__).parents[2]


def home_page() -> str:
    """README.md, whose links to docs/ are links of the site and whose other links lead to the repository."""
    repository = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]["Repository"]

    def target(link: re.Match) -> str:
        path = link[1]
        return f"]({path.removeprefix('docs/')}" if path.startswith("docs/") else f"]({repository}/blob/main/{path}"

    return re.sub(r"\]\((?!https?:)([^)]+)", target, (ROOT / "README.md").read_text())


def cell(text: str) -> str:
    """Text for a cell of a Markdown table, in which nothing is a link or ends the cell."""
    return html.escape(" ".join(text.split()), quote=False).replace("|", "&#124;").replace("[", "&#91;")


def help_text(command: click.Command) -> str:
    """A command's help as Markdown: a paragraph that starts with \\b is an example and keeps its lines."""
    paragraphs = []
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        example = paragraph.startswith("\b")
        paragraphs.append(f"```text\n{paragraph.strip(chr(8)).strip()}\n```" if example else paragraph)
    return "\n\n".join(paragraphs)


def option_table(command: click.Command, context: click.Context) -> str:
    """Every option with its help, as `--help` prints them."""
    records = [parameter.get_help_record(context) for parameter in command.get_params(context)]
    rows = [f"| <code>{cell(names)}</code> | {cell(text)} |" for names, text in filter(None, records) if text]
    return "\n".join(["| option | meaning |", "|---|---|", *rows])


def command_page(name: str, command: click.Command) -> str:
    context = click.Context(command, info_name=f"dmcvb-gen {name}")
    usage = " ".join(command.collect_usage_pieces(context))
    return (
        f"# dmcvb-gen {name}\n\n```text\ndmcvb-gen {name} {usage}\n```\n\n{help_text(command)}\n\n"
        f"## Options\n\n{option_table(command, context)}\n"
    )


def write_pages() -> None:
    with mkdocs_gen_files.open("index.md", "w") as index:
        index.write(home_page())
    group = click.Context(main, info_name="dmcvb-gen")
    lines = ["# Commands", ""]
    for name in main.list_commands(group):
        command = main.get_command(group, name)
        assert command is not None
        lines.append(f"- [`dmcvb-gen {name}`]({name}.md): {COMMANDS[name][1]}")
        with mkdocs_gen_files.open(f"cli/{name}.md", "w") as page:
            page.write(command_page(name, command))
    with mkdocs_gen_files.open("cli/index.md", "w") as index:
        index.write("\n".join(lines) + "\n")


write_pages()
