"""Pictures of mazes: a layout, its distance field, paths through it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dmcvb_gen.errors import DmcvbError, LayoutError
from dmcvb_gen.spec import REWARDS
from dmcvb_gen.tasks.ant_maze.arena import GOAL_RADIUS
from dmcvb_gen.tasks.ant_maze.distance import center_pixel, descend, floor_pixels, geodesic_field, make_field
from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout


def farthest_cells(layout: Layout) -> tuple[tuple[int, int], tuple[int, int]]:
    """A start and a goal cell with the longest shortest path between them."""
    best, pair = -1.0, (layout.free[0], layout.free[-1])
    for goal in layout.free:
        field = geodesic_field(layout, layout.world(goal))
        for start in layout.free:
            value = field.values[center_pixel(start)]
            if value > best:
                best, pair = value, (start, goal)
    return pair


def farthest_from(layout: Layout, cell: tuple[int, int]) -> tuple[int, int]:
    """The floor cell with the longest shortest path from a floor cell, which is as long the other way."""
    field = geodesic_field(layout, layout.world(cell))
    return max(layout.free, key=lambda other: field.values[center_pixel(other)])


def _start_and_goal(
    layout: Layout, start: tuple[int, int] | None, goal: tuple[int, int] | None
) -> tuple[tuple[int, int], tuple[int, int]]:
    """The cells that are given, and for one that is not the farthest from the other."""
    for cell, what in ((start, "start"), (goal, "goal")):
        if cell is not None:
            layout.check_cell(cell, what)
    if start is not None and start == goal:
        raise LayoutError(f"start and goal are both {start}; give two floor cells, or one for the farthest from it")
    if start is not None:
        return start, goal or farthest_from(layout, start)
    if goal is not None:
        return farthest_from(layout, goal), goal
    return farthest_cells(layout)


def save_paths_picture(layout: Layout, panels: dict[str, list[tuple[np.ndarray, np.ndarray]]], out: str | Path) -> None:
    """Write a PNG of a layout with paths that ants walked, a panel for each entry of `panels`.

    Args:
      panels: title -> (path (point, 2), goal (2)) of each episode, x and y in meters. A dot marks the start, a ring
        the goal.

    Raises:
      DmcvbError: the file cannot be written.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    rows, columns = layout.shape
    extent = (-columns * CELL / 2, columns * CELL / 2, -rows * CELL / 2, rows * CELL / 2)
    figure = Figure(figsize=(5 * len(panels), 5.3), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (title, episodes) in zip(axes, panels.items(), strict=True):
        axis.imshow(np.where(layout.walls, 0.3, 1.0), cmap="gray", vmin=0, vmax=1, extent=extent)
        for number, (path, goal) in enumerate(episodes):
            color = colormaps["tab10"](number % 10)
            axis.plot(*path.T, color=color, linewidth=1.2)
            axis.plot(*path[0], "o", color=color)
            axis.add_patch(Circle(tuple(goal), GOAL_RADIUS, color=color, fill=False, linewidth=2))
        axis.set_title(title)
        axis.set_xlabel("x (m)")
    axes[0].set_ylabel("y (m)")
    _write(figure, out)


def _write(figure, path: str | Path) -> None:
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise DmcvbError(f"cannot write {path} ({error}); give another place, ending in .png") from None


def save_maze_picture(
    layout: Layout, path: str | Path, start: tuple[int, int] | None = None, goal: tuple[int, int] | None = None
) -> dict:
    """Write a PNG of a layout with the distance field of each reward to a goal, and the path down it.

    Args:
      start, goal: (row, column) cells; the farthest from the other by default, without both the farthest pair.

    Returns:
      start, goal, length of the shortest path (m) and largest distance (m).

    Raises:
      LayoutError: a start or a goal in a wall, or both the same.
      DmcvbError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    start, goal = _start_and_goal(layout, start, goal)
    rows, columns = layout.shape
    extent = (-columns * CELL / 2, columns * CELL / 2, -rows * CELL / 2, rows * CELL / 2)
    floor, _ = floor_pixels(layout)
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    axes = figure.subplots(1, 1 + len(REWARDS))
    axes[0].imshow(np.where(floor, 1.0, 0.3), cmap="gray", vmin=0, vmax=1, extent=extent)
    for row, column in layout.free:
        x, y = layout.world((row, column))
        axes[0].text(x, y, f"{row},{column}", ha="center", va="center", fontsize=8)
    axes[0].set_title(f"{layout.name}: {len(layout.free)} floor cells (row, column)")
    facts = {}
    for axis, reward in zip(axes[1:], REWARDS, strict=True):
        field = make_field(reward, layout, layout.world(goal))
        shown = np.ma.MaskedArray(-field.values / field.largest, ~floor)
        image = axis.imshow(shown, extent=extent, cmap="viridis", vmin=-1, vmax=0)
        axis.contour(np.flipud(shown), levels=12, extent=extent, colors="white", linewidths=0.4, linestyles="solid")
        walked = descend(layout, field, layout.world(start))
        axis.plot(*walked.T, color="red", linewidth=2)
        axis.plot(*layout.world(start), "o", color="red")
        axis.plot(*layout.world(goal), "o", color="lime", markersize=10)
        axis.set_title(f"reward {reward}")
        figure.colorbar(image, ax=axis, label="reward of a control step", shrink=0.8)
        facts[reward] = field
    for axis in axes:
        axis.set_xlabel("x (m)")
        axis.set_facecolor("0.3")
    axes[0].set_ylabel("y (m)")
    _write(figure, path)
    geodesic = facts["geodesic"]
    length = float(geodesic.values[center_pixel(start)])
    return {"start": list(start), "goal": list(goal), "path_m": length, "largest_m": geodesic.largest}
