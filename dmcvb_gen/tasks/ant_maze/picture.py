"""Write pictures of mazes: a layout and the paths that ants walked in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks.ant_maze.arena import GOAL_RADIUS
from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout


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
    try:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=110)
    except (OSError, ValueError) as error:
        raise DmcvbError(f"cannot write {out} ({error}); give another place, ending in .png") from None
