"""Name the picture arrays of a subset, in their order, from its setting and views.

A task with one view stores `pixels`; one with several stores a pair of arrays a view::

    pixels/<view>               the goal seen
    pixels_hidden_goal/<view>   the goal left out

A subset whose setting hides the goal (`hidden`, `fixed`) has both, and shows the second alone: the first would give
the answer away. Views come in the task's order, which the subset's record keeps; environments, policies and
channels stacked of several views all follow it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.text import as_names

ONE_VIEW = ("pixels",)
"""The views of a task with one."""
SHOWN, HIDDEN = "pixels", "pixels_hidden_goal"
"""Folders of the pictures with the goal, and without it."""
NOT_TRAINED_ON = ("overhead",)
"""Views that are collected, but that no agent sees (paper, section 3.2)."""


@dataclass(frozen=True)
class Pictures:
    """The pictures of a subset that people may look at.

    Attributes:
      views: views in the task's order; ("pixels",) for a task with one.
      hide_goal: True if the goal is left out of them.
    """

    views: tuple[str, ...]
    hide_goal: bool = False

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of the picture arrays, one a view: ("pixels",), or ("pixels/top", ...)."""
        return picture_arrays(self.views, self.hide_goal)

    def select(self, views: str | Sequence[str] | None) -> Pictures:
        """The asked views alone, in the asked order; all if none are asked for (None).

        Args:
          views: names of views ("top"), or of picture arrays ("pixels/top"), but of no array that shows what these
            pictures hide.

        Raises:
          UnknownNameError: no such view here.
        """
        if views is None:
            return self
        names, views = dict(zip(self.arrays, self.views, strict=True)), as_names(views)
        names |= {view: view for view in self.views}
        for view in views:
            if view not in names:
                raise UnknownNameError("view", view, self.views)
        return Pictures(tuple(names[view] for view in views), self.hide_goal)


def picture_arrays(views: Sequence[str], hide_goal: bool = False) -> tuple[str, ...]:
    """Names of the picture arrays of views: ("pixels",), or ("pixels/top", ...), ("pixels_hidden_goal/top", ...)."""
    return view_arrays(HIDDEN if hide_goal and tuple(views) != ONE_VIEW else SHOWN, views)


def view_arrays(folder: str, views: Sequence[str]) -> tuple[str, ...]:
    """Names of arrays that there are of each view: (folder,) for a task with one, or ("<folder>/<view>", ...)."""
    return (folder,) if tuple(views) == ONE_VIEW else tuple(f"{folder}/{view}" for view in views)


def picture_of(array: str) -> tuple[str, bool] | None:
    """(view, goal hidden) of a picture array's name; None for the name of another array."""
    folder, _, view = array.partition("/")
    if folder not in (SHOWN, HIDDEN):
        return None
    return view or ONE_VIEW[0], folder == HIDDEN


def shown(subset: Any, views: Sequence[str] | Literal["agents"] | None = None) -> Pictures:
    """The pictures that a subset shows: all its views, in the task's order, the goal hidden if its setting says so;
    whether they are stored or not.

    Args:
      subset: the `Subset`, or another thing with its `record`.
      views: only these views, in this order; "agents": those that agents are trained on, all but the overhead view.

    Raises:
      UnknownNameError: no such view.
    """
    record = subset.record
    if views == "agents":
        views = [view for view in record.views if view not in NOT_TRAINED_ON]
    return Pictures(record.views, record.hidden_goal).select(views)
