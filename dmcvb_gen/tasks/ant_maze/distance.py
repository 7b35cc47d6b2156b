"""Compute fields of shortest-path distance to the goal of a maze (scikit-fmm).

Two measures. "saturated" is DMC-VB's, the reward's: travel times of a wave from the whole goal cell, on a grid of 10
pixels a cell, as fast as another wave's travel time from the walls, up to 5 pixels (the "saturated fast marching
square"), looked up at the ant's pixel. "geodesic" is the shortest path itself: unit speed, from the goal's
exact position, interpolated between pixels.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import skfmm

from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout

PIXELS = 10
"""Pixels a cell's side."""
SATURATION = 5
"""Travel time from the walls, in pixels, from which on the wave is as fast as it gets."""


class DistanceField(NamedTuple):
    """Distances to a goal on the pixels of a layout.

    Attributes:
      values: (row, column) float64 at pixel centers, meters ("geodesic") or seconds of a wave that moves one meter
        a second far from walls ("saturated"); inside walls, the value of the nearest floor pixel.
      largest: the largest value on the floor, d_max.
    """

    values: np.ndarray
    largest: float


@functools.cache
def floor_of(layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The floor of a layout, by pixels.

    Returns:
      (row, column) bool, the floor; (row, column) float64, the saturated speed there; (2, row, column) int, row and
      column of the floor pixel nearest to each.
    """
    floor = np.kron(~layout.walls, np.ones((PIXELS, PIXELS), bool))
    from_walls = np.asarray(skfmm.travel_time(floor.astype(float), np.ones(floor.shape), dx=1.0))
    from scipy import ndimage  # scipy takes a fifth of a second, which commands that list or show need not wait for

    nearest = ndimage.distance_transform_edt(~floor, return_distances=False, return_indices=True)
    return floor, np.minimum(from_walls, SATURATION) / SATURATION, nearest


def _finish(times: np.ndarray, layout: Layout) -> DistanceField:
    floor, _, nearest = floor_of(layout)
    filled = np.ma.filled(times, np.nan)
    return DistanceField(filled[tuple(nearest)], float(np.nanmax(filled[floor])))


@functools.cache
def saturated_field(layout: Layout, goal_cell: tuple[int, int]) -> DistanceField:
    """DMC-VB's measure; 0 in the whole goal cell.

    Raises:
      LayoutError: the goal is in a wall.
    """
    layout.check_cell(goal_cell, "goal")
    floor, speed, _ = floor_of(layout)
    row, column = (index * PIXELS for index in goal_cell)
    inside = np.zeros_like(floor)
    inside[row : row + PIXELS, column : column + PIXELS] = True
    phi = np.ma.MaskedArray(np.where(inside, 0.0, 1.0), ~floor)
    times = skfmm.travel_time(phi, np.where(floor, speed, 1.0), dx=CELL / PIXELS)
    return _finish(np.ma.where(inside, 0.0, times), layout)


def geodesic_field(layout: Layout, goal: np.ndarray) -> DistanceField:
    """The shortest path's length, meters, from the goal's position (x, y)."""
    floor, _, _ = floor_of(layout)
    centers = (np.moveaxis(np.indices(floor.shape), 0, -1) + 0.5) / PIXELS - 0.5
    away = np.linalg.norm(layout.world(centers) - np.asarray(goal)[:2], axis=-1)
    start = 2 * CELL / PIXELS  # straight lines this near: a wave from a single pixel would be square
    times = skfmm.travel_time(np.ma.MaskedArray(away - start, ~floor), np.ones_like(away), dx=CELL / PIXELS)
    return _finish(np.ma.where(away <= start, away, times + start), layout)


def look_up(layout: Layout, fields: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """DMC-VB's distances of many episodes at once, each from its own saturated field.

    Args:
      fields: (n, row, column) values.
      positions: (n, 2) x and y, meters; anywhere, also outside of the maze.

    Returns:
      (n,) float64, finite.
    """
    height, width = fields.shape[1:]
    index = np.rint((layout.grid(positions) + 0.5) * PIXELS - 1).astype(int)  # pixel i covers [i, i + 1)
    row, column = np.clip(index[:, 0], 0, height - 1), np.clip(index[:, 1], 0, width - 1)
    return fields[np.arange(len(fields)), row, column]


def blend(layout: Layout, fields: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Do as `look_up`, blended between the pixels of geodesic fields."""
    from scipy import ndimage

    row, column = ((layout.grid(positions) + 0.5) * PIXELS - 0.5).T
    return ndimage.map_coordinates(fields, [np.arange(len(fields)), row, column], order=1, mode="nearest")
