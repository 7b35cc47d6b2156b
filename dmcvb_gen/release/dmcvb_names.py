"""Names of our views, state fields and subsets in DMC-VB's published data."""

from __future__ import annotations

import re

from dmcvb_gen.spec import ANT_MAZE, FIXED, GOAL_MODES, HIDDEN, VISIBLE, is_maze

_CAMERAS = {
    "top": "lowres_top_camera",
    "egocentric": "walker/egocentric_camera",
    "follow": "walker/follow_camera",
    "overhead": "walker/overhead_camera",
}
_HIDDEN_TARGET = "_hidden_target"
_OF_THE_TASK = ("distance_to_target", "target_position", "target_vector", "target_activated", "walker_position")
"""State fields of mazes that the task observes; the others are the walker's."""
_FOLDERS = {
    "antmaze_random_visible_goal": VISIBLE,
    "antmaze_random_hidden_goal": HIDDEN,
    "antmaze_fixed_hidden_goal": FIXED,
}


def picture_feature(task: str, view: str, hide_goal: bool) -> str:
    """The observation that holds a view's pictures."""
    if not is_maze(task):
        return view
    return _CAMERAS.get(view, view) + (_HIDDEN_TARGET if hide_goal else "")


def state_feature(task: str, field: str) -> str:
    """The observation that holds a field of the state."""
    return f"walker/{field}" if is_maze(task) and field not in _OF_THE_TASK else field


def parse_folder(parts: tuple[str, ...]) -> tuple[str, str, str, int | None] | None:
    """(task, level, setting, seed of fixed goals) of a data set's folder, None if its path does not say it.

    `locomotion/<task>/<level>/<setting>`, `antmaze_random_<visible|hidden>_goal/<layout>/<level>`,
    `antmaze_fixed_hidden_goal/<layout>/<seed>`, and our own exports' `<task>/<level>/<setting>`.
    """
    if parts and re.fullmatch(r"\d+\.\d+\.\d+", parts[-1]):
        parts = parts[:-1]  # TFDS's folder of the version
    if len(parts) < 3:
        return None
    first, second, third = parts[-3:]
    if first in _FOLDERS:
        setting, task = _FOLDERS[first], f"{ANT_MAZE}-{second}"
        if setting == FIXED:
            return (task, "expert", setting, int(third)) if third.isdecimal() else None
        return task, third, setting, None
    task = first.replace("_", "-")
    return (task, second, third, None) if not is_maze(task) or third in GOAL_MODES else None
