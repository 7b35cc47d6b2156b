"""Maze layouts: walls, free cells and their places in the world, from rows of text.

A layout is a rectangle of `*` (wall) and space or `.` (floor). The outer cells are walls, all floor is
connected. Row 0 is the north side (largest y).
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dmcvb_gen.errors import LayoutError

CELL = 2.5
"""Meters a side of a cell (paper, appendix on the ant maze)."""
MAX_CELLS = 31
"""Cells a side that a layout may have."""

LAYOUTS = {
    "empty7x7": "*******/*     */*     */*     */*     */*     */*******",
    "easy7x7a": "*******/** *  */*  *  */*  *  */*     */*    **/*******",
    "easy7x7b": "*******/*     */*  *  */* **  */*  ** */*     */*******",
    "easy7x7c": "*******/*     */* *   */* *   */* *** */*     */*******",
    "medium7x7a": "*******/*  *  */*    **/*  *  */* * * */*     */*******",
    "medium7x7b": "*******/*     */*** * */*     */*  ** */*     */*******",
    "medium7x7c": "*******/*  *  */** *  */*     */* **  */*    **/*******",
}
"""DMC-VB's seven layouts, rows joined by "/" (the authors' benchmark code)."""


@dataclass(frozen=True)
class Layout:
    """A checked layout.

    Attributes:
      name: letters, digits and underscores.
      rows: its rows, "*" and ".".
    """

    name: str
    rows: tuple[str, ...]

    @functools.cached_property
    def walls(self) -> np.ndarray:
        """(row, column) bool."""
        return np.array([[character == "*" for character in row] for row in self.rows])

    @functools.cached_property
    def free(self) -> tuple[tuple[int, int], ...]:
        """(row, column) of every floor cell, in reading order."""
        return tuple((row, column) for row, column in np.argwhere(~self.walls).tolist())

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return len(self.rows), len(self.rows[0])

    @property
    def entity_layer(self) -> str:
        """Return the layout as labmaze reads it."""
        return "".join(row.replace(".", " ") + "\n" for row in self.rows)

    @property
    def text(self) -> str:
        """Rows joined by "/"."""
        return "/".join(self.rows)

    def world(self, cells: ArrayLike) -> np.ndarray:
        """(..., row and column) -> (..., x and y) of the cells' centers, meters."""
        (rows, columns), places = self.shape, np.asarray(cells, float)
        x, y = (places[..., 1] - (columns - 1) / 2) * CELL, ((rows - 1) / 2 - places[..., 0]) * CELL
        return np.stack([x, y], axis=-1)

    def grid(self, positions: np.ndarray) -> np.ndarray:
        """(..., x and y) meters -> (..., row and column), whole numbers at the cells' centers."""
        positions, (rows, columns) = np.asarray(positions, float), self.shape
        return np.stack(
            [(rows - 1) / 2 - positions[..., 1] / CELL, (columns - 1) / 2 + positions[..., 0] / CELL], axis=-1
        )

    def check_cell(self, cell: tuple[int, int], what: str) -> None:
        """Raises LayoutError if a start or a goal is not on the floor."""
        if tuple(cell) not in self.free:
            raise LayoutError(
                f"{what} {tuple(cell)} is no floor cell of layout {self.name!r}; "
                f"floor: {', '.join(map(str, self.free))}"
            )


def make_layout(name: str, text: str) -> Layout:
    """A layout from its text (rows on lines, or joined by "/").

    Raises:
      LayoutError: a wrong character, ragged rows, a hole in the outer wall, floor that is not connected.
    """
    rows = re.split(r"\r?\n|/", text.strip("\r\n/"))
    width = max((len(row) for row in rows), default=0)
    for number, row in enumerate(rows):
        wrong = set(row) - set("* .")
        if wrong:
            raise LayoutError(
                f"layout {name!r}, row {number}: {sorted(wrong)[0]!r}; rows hold '*' (wall) and ' ' (floor)"
            )
        if len(row) != width:
            raise LayoutError(f"layout {name!r}, row {number} has {len(row)} cells, others have {width}")
    if len(rows) < 3 or width < 3 or max(len(rows), width) > MAX_CELLS:
        raise LayoutError(f"layout {name!r} is {len(rows)} x {width} cells; give 3 to {MAX_CELLS} a side")
    layout = Layout(name, tuple(row.replace(" ", ".") for row in rows))
    edge = np.ones(layout.shape, bool)
    edge[1:-1, 1:-1] = False
    if (edge & ~layout.walls).any():
        row, column = np.argwhere(edge & ~layout.walls)[0]
        raise LayoutError(
            f"layout {name!r} has a hole in its outer wall at row {row}, column {column}; close it with '*'"
        )
    from scipy import ndimage  # scipy takes a fifth of a second, which commands that list or show need not wait for

    labels, parts = ndimage.label(~layout.walls)
    if parts == 0 or len(layout.free) < 2:
        raise LayoutError(f"layout {name!r} needs two floor cells at least, a start and a goal")
    if parts > 1:
        row, column = np.argwhere(labels == 2)[0]
        raise LayoutError(
            f"layout {name!r} has floor that cannot be reached (row {row}, column {column}); connect all floor cells"
        )
    return layout


@functools.cache
def get_layout(name: str) -> Layout:
    """One of DMC-VB's seven layouts."""
    return Layout(name, tuple(LAYOUTS[name].replace(" ", ".").split("/")))  # sound, as a test says


def load_layout(path: str | Path) -> Layout:
    """A layout from the user's text file, named after the file.

    Raises:
      LayoutError: the file cannot be read or is no layout.
    """
    path = Path(path)
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise LayoutError(f"cannot read layout {path} ({error}); give a text file of '*' and ' '") from None
    name = re.sub(r"[^A-Za-z0-9_]", "_", path.stem).lstrip("_") or "layout"
    return make_layout(name, text)


def fixed_pairs(layout: Layout, count: int, seed: int) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """`count` different (start, goal) pairs of cells, from a seed (benchmark B3); more pairs begin with fewer.

    Raises:
      LayoutError: the layout has fewer pairs.
    """
    cells = len(layout.free)
    if count > cells * (cells - 1):
        raise LayoutError(
            f"layout {layout.name!r} has {cells * (cells - 1)} (start, goal) pairs, {count} are asked for; "
            "give fewer fixed goals"
        )
    rng = np.random.default_rng([seed, 0xF1ED])
    chosen = rng.permutation(cells * (cells - 1))[:count]
    places = (divmod(number, cells - 1) for number in chosen.tolist())
    return [(layout.free[start], layout.free[goal + (goal >= start)]) for start, goal in places]
