"""The vocabulary: texts that name tasks, levels, settings and subsets in, checked names and their parts out.

A subset is named "<task>/<level>/<setting>": "walker-walk/expert/dynamic_hard", "ant-maze-easy7x7a/medium/hidden".
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dmcvb_gen.errors import UnknownNameError

LOCOMOTION, ANT_MAZE = "locomotion", "ant-maze"
FAMILIES = (LOCOMOTION, ANT_MAZE)
"""Families of tasks: what a task may vary in, and so which settings it takes. `Task.family` is one of them."""

TRAINED_LEVELS = ("expert", "medium", "mixed")
MAZE_TRAINED_LEVELS = ("expert", "medium")
"""Levels with a trained policy; the paper's mazes have no mixed one."""
LEVELS = (*TRAINED_LEVELS, "random")

DISTRACTOR_KINDS = ("none", "static", "dynamic")
DIFFICULTY_SCALES = {"easy": 0.1, "medium": 0.2, "hard": 0.3}
"""Difficulty -> the scale s of every range (Distracting Control Suite); medium is DMC-VB's."""
DIFFICULTY_VIDEOS = {"easy": 4, "medium": 8, "hard": None}
"""Difficulty -> how many background videos are in play; None: all."""
DIFFICULTIES = tuple(DIFFICULTY_SCALES)

VISIBLE, HIDDEN, FIXED = "visible", "hidden", "fixed"
GOAL_MODES = (VISIBLE, HIDDEN, FIXED)
"""Settings of mazes: a random goal that is seen (B1) or left out of the pictures (B3's pre-training), and fixed
pairs of start and goal, left out too (B3)."""

GOAL_PICTURES = (VISIBLE, HIDDEN)
"""The two kinds of a maze's pictures: with the goal, and without it."""

REWARDS = ("saturated", "geodesic")
"""How a maze's reward measures the distance to the goal: DMC-VB's way first, then the shortest path's length."""

SPLITS = ("train", "val")
"""Which videos and maze styles: for data, or kept for evaluation."""

LABEL_TYPES = {"depth": "float32", "segmentation": "int16"}
"""Labels that can be painted a pixel each -> dtype: depth in meters (0: sky), segmentation by geom id (-1: sky)."""

_MAZE_ID = re.compile(rf"{ANT_MAZE}-(?P<layout>[A-Za-z0-9_]+)(:(?P<rows>[*./ ]+))?(@(?P<reward>\w+))?")


# -- tasks ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MazeName:
    """The parts of a maze's task id, "ant-maze-<layout>[:<rows>][@<reward>]".

    Attributes:
      layout: the layout's name.
      rows: a layout of the user's own, its rows joined by "/"; None for one that the package has.
      reward: how the distance to the goal is measured, of `REWARDS`; None for DMC-VB's.
    """

    layout: str
    rows: str | None = None
    reward: str | None = None

    def __str__(self) -> str:
        rows = f":{self.rows}" if self.rows else ""
        return f"{ANT_MAZE}-{self.layout}{rows}" + (f"@{self.reward}" if self.reward else "")

    @classmethod
    def parse(cls, task_id: str) -> MazeName | None:
        """The parts of a task id, None where it does not name a maze."""
        found = _MAZE_ID.fullmatch(task_id)
        return cls(**found.groupdict()) if found else None


def family_of(task_id: str) -> str:
    """The family of the task that an id names (`Task.family`, for those who have the id alone)."""
    return ANT_MAZE if task_id.startswith(f"{ANT_MAZE}-") else LOCOMOTION


def task_folder(task_id: str) -> str:
    """A task id as a folder name: without a maze's rows, if it carries its own."""
    if family_of(task_id) != ANT_MAZE:
        return re.sub(r"[^A-Za-z0-9_.-]", "-", task_id)
    head, _, reward = task_id.partition("@")
    return re.sub(r"[^A-Za-z0-9_.-]", "-", head.split(":")[0] + (f"-{reward}" if reward else ""))


# -- settings -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DistractorSetting:
    """A kind of distractor at a difficulty; `name` is "none", "static", "dynamic_hard", ... (medium is not named)."""

    kind: str = "none"
    difficulty: str = "medium"

    def __post_init__(self) -> None:
        if self.kind not in DISTRACTOR_KINDS:
            raise UnknownNameError("distractor", self.kind, DISTRACTOR_KINDS)
        if self.difficulty not in DIFFICULTIES:
            raise UnknownNameError("difficulty", self.difficulty, DIFFICULTIES)

    @property
    def name(self) -> str:
        return self.kind if self.kind == "none" or self.difficulty == "medium" else f"{self.kind}_{self.difficulty}"

    @property
    def scale(self) -> float:
        return 0.0 if self.kind == "none" else DIFFICULTY_SCALES[self.difficulty]

    @property
    def videos(self) -> int | None:
        """How many videos are in play, None for all."""
        return DIFFICULTY_VIDEOS[self.difficulty]

    @classmethod
    def parse(cls, name: str) -> DistractorSetting:
        """The setting of a name such as "dynamic", "dynamic_medium" or "static_easy"."""
        kind, _, difficulty = name.partition("_")
        return cls(kind, difficulty or "medium")


def normalize_setting(task_id: str, setting: str) -> str:
    """The setting's canonical name ("dynamic_medium" -> "dynamic").

    Raises:
      UnknownNameError: the task has no such setting.
    """
    if family_of(task_id) == ANT_MAZE:
        if setting not in GOAL_MODES:
            raise UnknownNameError(f"goal setting of {task_id}", setting, GOAL_MODES)
        return setting
    return DistractorSetting.parse(setting).name


def distractor_of(task_id: str, setting: str) -> DistractorSetting:
    """The distractors of a subset's setting; mazes have none but their styles."""
    return DistractorSetting() if family_of(task_id) == ANT_MAZE else DistractorSetting.parse(setting)


def hides_goal(setting: str) -> bool:
    """Whether a setting's pictures are those without the goal: a maze's "hidden" and "fixed"."""
    return setting in (HIDDEN, FIXED)


def setting_moves(setting: str) -> bool:
    """Whether the camera of a setting moves (mazes' cameras follow the ant)."""
    return setting in GOAL_MODES or DistractorSetting.parse(setting).kind == "dynamic"


def check_level(level: str) -> str:
    """`level`.

    Raises:
      UnknownNameError: there is no such level.
    """
    if level not in LEVELS:
        raise UnknownNameError("level", level, LEVELS)
    return level


# -- subsets --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SubsetName:
    """The parts of a subset's name; `task` is a folder name (`task_folder`), the task's id for all but own mazes."""

    task: str
    level: str
    setting: str

    def __str__(self) -> str:
        return f"{self.task}/{self.level}/{self.setting}"

    @classmethod
    def parse(cls, name: str) -> SubsetName:
        """The parts of "<task>/<level>/<setting>".

        Raises:
          UnknownNameError: not three parts.
        """
        parts = name.split("/")
        if len(parts) != 3 or not all(parts):
            raise UnknownNameError("subset", name, ("<task>/<level>/<setting>",))
        return cls(*parts)


def subset_name(task_id: str, level: str, setting: str) -> str:
    """The name of a subset, "<task>/<level>/<setting>"."""
    return str(SubsetName(task_folder(task_id), level, setting))


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Whether a subset's name fits one of the patterns: "walker-walk/*/static", "walker-walk/expert", "*"."""
    return any(
        fnmatch.fnmatchcase(name, pattern) or fnmatch.fnmatchcase(name, f"{pattern.rstrip('/')}/*")
        for pattern in patterns
    )


def select(names: Sequence[str], patterns: Sequence[str]) -> list[str]:
    """The names that fit the patterns (all of them when there are no patterns).

    Raises:
      UnknownNameError: a pattern that fits nothing.
    """
    for pattern in patterns:
        if not any(matches(name, [pattern]) for name in names):
            raise UnknownNameError("subset pattern", pattern, names)
    return [name for name in names if not patterns or matches(name, patterns)]


def pluralize(count: int, noun: str) -> str:
    """A number with its noun, given in the plural: 1, "shards" -> "1 shard"; 1200 -> "1,200 shards"."""
    return f"{count:,} {noun.removesuffix('s') if count == 1 else noun}"
