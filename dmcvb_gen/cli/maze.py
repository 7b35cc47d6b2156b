"""show-maze."""

from __future__ import annotations

from pathlib import Path

import click

from dmcvb_gen.cli.common import OutPath, answer, json_option


def _cell(context, parameter, value):
    if value is None:
        return None
    parts = value.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise click.BadParameter(f"{value!r} is not ROW,COLUMN, e.g. 1,5")
    return int(parts[0]), int(parts[1])


@click.command("show-maze")
@click.argument("layout")
@click.option("--start", callback=_cell, metavar="ROW,COLUMN", help="A floor cell.  [default: the farthest]")
@click.option("--goal", callback=_cell, metavar="ROW,COLUMN", help="A floor cell.  [default: the farthest]")
@click.option("--out", type=OutPath(path_type=Path), help="The picture.  [default: LAYOUT.png]")
@json_option
def show_maze(layout, start, goal, out, as_json):
    """Write a picture of a layout, its distances to a goal and the path there.

    LAYOUT is a name (empty7x7, medium7x7a, ...), a maze's task id, or a text file of '*' and spaces.

    \b
    dmcvb-gen show-maze medium7x7a
    dmcvb-gen show-maze my_maze.txt --start 1,1 --goal 3,5 --out my_maze.png
    """
    from dmcvb_gen.tasks.ant_maze.layouts import find_layout
    from dmcvb_gen.tasks.ant_maze.picture import save_maze_picture

    chosen = find_layout(layout)
    out = out or Path(f"{chosen.name}.png")
    facts = save_maze_picture(chosen, out, start, goal)
    path = f"{out}: path of {facts['path_m']:.1f} m from {tuple(facts['start'])} to {tuple(facts['goal'])}"
    facts |= {"layout": chosen.name, "rows": list(chosen.rows), "picture": str(out)}
    answer(as_json, facts, *chosen.rows, path)
