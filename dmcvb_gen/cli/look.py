"""list, info."""

from __future__ import annotations

import textwrap

import click

from dmcvb_gen import making
from dmcvb_gen.cli.common import json_option, print_json, print_table
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.storage.places import is_url, shown, unpinned
from dmcvb_gen.text import format_bytes, pluralize, quoted


@command_of(making.rollout, only=("storage_options",))
@click.argument("path", metavar="RELEASE|URL")
def info(path, storage_options, as_json, progress):
    """Show the subsets, episodes, bytes and returns of a release, and the paper's returns.

    \b
    dmcvb-gen info releases/demo
    """
    from dmcvb_gen.generate.info import STATISTICS, describe_release

    facts = describe_release(path, storage_options)
    if as_json:
        return print_json(facts)
    rows = []
    for subset in facts["subsets"]:
        planned = "" if subset["complete"] else f"/{subset['episodes_planned']:,}"
        rows.append(
            (
                subset["name"],
                f"{subset['episodes']:,}{planned}",
                f"{subset['steps']:,}",
                format_bytes(subset["bytes"]),
                *(f"{subset['returns'][key]:.1f}" for key in STATISTICS),
                "" if subset["normalized"] is None else f"{subset['normalized']:.0f}",
            )
        )
        if (paper := subset["paper"]) and not subset["other_length"]:  # others earn other returns
            numbers = (f"{paper[key]:.1f}" for key in STATISTICS)
            rows.append(("  DMC-VB paper", "", f"{paper['steps']:,.0f}", "", *numbers, ""))
    title = f"{facts['name']} {facts['version']}"
    if facts["part"]:
        title = f"part of {title} ({facts['digest'][:12]})"
    elif not facts["complete"]:
        title += " (not complete)"
    print_table(
        ("subset", "episodes", "steps", "size", *STATISTICS, "score"),
        rows,
        title=title,
        optional=(("p25", "p75"), ("min", "max"), ("score",), ("size",), ("median",)),
    )
    click.echo(f"{facts['steps']:,} steps, {format_bytes(facts['bytes'])}")
    if facts["missing"]:
        count = len(facts["missing"])
        click.echo(f"no local episodes: {count:,} of {pluralize(count + len(facts['subsets']), 'subsets')}")
    for line in dict.fromkeys(line for subset in facts["subsets"] for line in _look_of(subset)):
        click.echo(line)
    policies = dict.fromkeys(name for subset in facts["subsets"] for name in subset["policies"])
    if policies:
        click.echo(textwrap.fill(f"policies: {', '.join(policies)}", 80, break_on_hyphens=False))
    if facts["subsets"] and not any(subset["images"] for subset in facts["subsets"]):
        paint = f"fetch {shown(path)} --paint --out FOLDER" if is_url(str(path)) else f"paint {quoted(unpinned(path))}"
        click.echo(f"No images are stored; add them: dmcvb-gen {paint}")
    if facts["digest"]:
        click.echo(f"digest {facts['digest']}")
        if facts["shipped"]:
            click.echo(f"The digest is that of the {facts['shipped']} that the package ships.")
        elif not facts["compared"]:
            click.echo("The digest was not compared; give the one that you expect: RELEASE@sha256:DIGEST")


def _look_of(subset) -> list[str]:
    """Lines on size, renderer and videos of a subset's images."""
    samples = f", {subset['samples']} samples a pixel" if subset["samples"] else ""
    sizes = ", ".join(f"{size} x {size}" for size in subset["sizes"] or [subset["size"]])
    lines = [f"images: {sizes} pixels, {subset['renderer']}{samples}"]
    if videos := subset["videos"]:
        lines.append(f"videos: {videos['source']} ({videos['split']})")
    return lines


@click.command("list")
@json_option
def list_command(as_json):
    """List tasks, levels, distractors, bundled policies, recipes and the renderers that work here."""
    from dmcvb_gen.generate.info import describe_package

    facts = describe_package()
    if as_json:
        return print_json(facts)
    columns, rows = ("task", "state", "action", "steps", "<views", "<bundled behaviours"), []
    for task in facts["tasks"]:
        sizes = (task[name] for name in ("state", "action", "max_steps"))
        rows.append((task["id"], *sizes, ", ".join(task["views"]), ", ".join(task["behaviours"]) or "-"))
    print_table(columns, rows, title="tasks", optional=(("views",),))
    for heading, names in (
        ("tasks of dm_control's suite", facts["suite_tasks"]),
        ("of these with bundled expert, medium and mixed", facts["suite_behaviours"]),
        ("levels", facts["levels"]),
        ("distractors", facts["distractors"]),
        ("difficulties", [*facts["difficulties"], "or a scale up to 1 (dynamic_0.35)"]),
        ("maze goals", facts["maze_settings"]),
        ("recipes", facts["recipes"]),
        ("manifests", facts["manifests"]),
    ):
        click.echo(textwrap.fill(f"{heading}: {', '.join(names)}", 80, break_on_hyphens=False))
    for name, reason in facts["renderers"].items():
        click.echo(f"renderer {name}: {'usable' if reason is None else 'not usable here: ' + reason}")
