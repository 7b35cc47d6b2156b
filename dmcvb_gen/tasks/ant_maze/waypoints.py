"""Way-points: from where an ant is, the place a little further down the way to its goal, clear of walls.

An ant that can walk straight to a goal in an open maze gets through any maze when it is shown way-points
instead of the goal. They need the layout, so no behaviour policy sees them; teachers do (`behaviours.guided`).
"""

from __future__ import annotations

import functools

import numpy as np

from dmcvb_gen.tasks.ant_maze.distance import PIXELS, floor_pixels, saturated_field
from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout

_AROUND = tuple((row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column)


@functools.cache
def _downhill(layout: Layout, goal_cell: tuple[int, int]) -> np.ndarray:
    """(pixel,) int: flat index of the neighbor down which the saturated field falls fastest, itself in the goal cell.

    The saturated field is fast in the middle of corridors, so the way keeps clear of walls.
    """
    floor, _ = floor_pixels(layout)
    values = np.where(floor, saturated_field(layout, goal_cell).values, np.inf)
    padded = np.pad(values, 1, constant_values=np.inf)
    height, width = values.shape
    best, slope = np.arange(values.size).reshape(values.shape), np.zeros_like(values)
    for row, column in _AROUND:
        there = padded[1 + row : 1 + row + height, 1 + column : 1 + column + width]
        falls = np.where(floor & np.isfinite(there), values, 0.0) - np.where(np.isfinite(there), there, 0.0)
        falls = np.where(floor & np.isfinite(there), falls / np.hypot(row, column), 0.0)
        index = np.arange(values.size).reshape(values.shape) + row * width + column
        best, slope = np.where(falls > slope, index, best), np.maximum(slope, falls)
    return best.ravel()


def way_points(layout: Layout, positions: np.ndarray, goals: np.ndarray, ahead: float) -> np.ndarray:
    """Where to head for.

    Args:
      positions: (n, 2) x and y of the ants, meters; one in a wall counts as on the nearest floor.
      goals: (n, 2) x and y of the goals, meters.
      ahead: how far down the way, meters; rounded to pixels of 0.25 m.

    Returns:
      (n, 2) meters: the goal itself where the way-point lies in its cell.

    Raises:
      LayoutError: a goal is in a wall.
    """
    floor, nearest = floor_pixels(layout)
    height, width = floor.shape
    cells = np.rint(layout.grid(goals)).astype(int)
    pixel = np.clip(((layout.grid(positions) + 0.5) * PIXELS).astype(int), 0, [height - 1, width - 1])
    row, column = nearest[:, pixel[:, 0], pixel[:, 1]]
    index = row * width + column
    next_ = np.stack([_downhill(layout, (int(row), int(column))) for row, column in cells])
    each = np.arange(len(index))
    for _ in range(round(ahead / (CELL / PIXELS))):
        index = next_[each, index]
    found = np.stack([index // width, index % width], axis=1)
    points = layout.world((found + 0.5) / PIXELS - 0.5)
    return np.where((found // PIXELS == cells).all(axis=1)[:, None], goals, points)
