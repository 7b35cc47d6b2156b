"""Typed values for the tasks, levels, distractors and goal modes of subsets, and the one place that parses them.

A subset is named "<task>/<level>/<setting>": "walker-walk/expert/dynamic_hard", "ant-maze-easy7x7a/medium/hidden".
The setting is the stored form of two things: the distractor of a locomotion task, or the goal mode of a maze.
`SubsetSpec` keeps them apart.
"""

from __future__ import annotations

import enum
import fnmatch
import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.own_code import DISTRACTORS, allowed

LOCOMOTION, ANT_MAZE = "locomotion", "ant-maze"
"""Families of tasks: what a task may vary in, and so which settings it takes. `Task.family` is one of them."""


class Level(enum.StrEnum):
    """Behaviour policies of a subset (paper, section 3.2); "random" needs no trained policy."""

    EXPERT = "expert"
    MEDIUM = "medium"
    MIXED = "mixed"
    RANDOM = "random"

    @classmethod
    def parse(cls, name: str) -> Level:
        """The level of a name.

        Raises:
          UnknownNameError: there is no such level.
        """
        if name not in LEVELS:
            raise UnknownNameError("level", name, LEVELS)
        return cls(name)


class GoalMode(enum.StrEnum):
    """Treatment of a maze's goal: random and seen (B1), random and left out of the images (B3's pre-training), or
    fixed pairs of start and goal, left out too (B3)."""

    VISIBLE = "visible"
    HIDDEN = "hidden"
    FIXED = "fixed"


TRAINED_LEVELS = ("expert", "medium", "mixed")
MAZE_TRAINED_LEVELS = ("expert", "medium")
"""Levels with a trained policy; the paper's mazes have no mixed one."""
LEVELS = tuple(level.value for level in Level)

DISTRACTOR_KINDS = ("none", "static", "dynamic")
"""DMC-VB's kinds of distractors; `distractor_kinds` has those of users besides."""
DISTRACTOR_ENTRY_POINTS = "dmcvb_gen.distractors"
"""Entry points of other packages' distractors: the kind's name -> its class; see `distractors.registry`."""
DIFFICULTY_SCALES = {"easy": 0.1, "medium": 0.2, "hard": 0.3}
"""Difficulty -> the scale s of every range (Distracting Control Suite); medium is DMC-VB's."""
DIFFICULTY_VIDEOS = {"easy": 4, "medium": 8, "hard": None}
"""Difficulty -> how many background videos are in play; None: all."""
DIFFICULTIES = tuple(DIFFICULTY_SCALES)
SCALED_PARTS = ("camera", "color")
DISTRACTOR_PARTS = (*SCALED_PARTS, "background")
"""The parts of DMC-VB's distractors, each of which can vary alone."""
CUE, LIGHT = "cue", "light"
"""Parts besides, of dynamic distractors alone. A cue's number is its correlation with the action before a frame."""
ALL_PARTS = (*DISTRACTOR_PARTS, LIGHT, CUE)
"""In the order of a difficulty's spelling."""
ALL = "all"
"""In a difficulty, in place of a number of background videos: all of them."""

VISIBLE, HIDDEN, FIXED = GOAL_MODES = tuple(mode.value for mode in GoalMode)
"""The stored names of the goal modes."""


SPLITS = ("train", "val")
"""Which videos and maze styles: for data, or kept for evaluation."""

_MAZE_ID = re.compile(rf"{ANT_MAZE}-(?P<layout>[A-Za-z0-9_]+)(:(?P<rows>[*./ ]+))?")


# -- tasks ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MazeName:
    """The parts of a maze's task id, "ant-maze-<layout>[:<rows>]".

    Attributes:
      layout: the layout's name.
      rows: a layout of the user's own, its rows joined by "/"; None for one that the package has.
    """

    layout: str
    rows: str | None = None

    def __str__(self) -> str:
        return f"{ANT_MAZE}-{self.layout}" + (f":{self.rows}" if self.rows else "")

    @classmethod
    def parse(cls, task_id: str) -> MazeName | None:
        """The parts of a task id, None if it does not name a maze."""
        found = _MAZE_ID.fullmatch(task_id)
        return cls(**found.groupdict()) if found else None


def is_maze(task_id: str) -> bool:
    """Return True if an id names a maze, for callers that have no `Task` at hand."""
    return task_id.startswith(f"{ANT_MAZE}-")


def task_folder(task_id: str) -> str:
    """A task id as a folder name: without a maze's rows, if it carries its own."""
    name = task_id.partition(":")[0] if is_maze(task_id) else task_id
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name)


# -- settings -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DistractorSetting:
    """A kind of distractor at a difficulty (paper, section 3.1); "medium" is left out of its `name`.

    Attributes:
      kind: "none", "static", "dynamic", or one of a user's own.
      difficulty: "easy", "medium" or "hard"; or a scale above 0 and up to 1 ("0.35"); or the parts that vary, each
        with a number of its own if medium's is not meant: "camera0.1-color0.5-background4" (a background's number is
        how many videos are in play). Two parts of dynamic distractors come besides: "light0.3" moves the lamps, and
        "cue0.8" is a spurious cue in the colors that correlates with the last action by 0.8. What amounts to a word is
        turned into it: "0.2" is "medium".

    Raises:
      UnknownNameError: there is no such kind or difficulty. DmcvbError: a number is out of range.
    """

    kind: str = "none"
    difficulty: str = "medium"

    def __post_init__(self) -> None:
        if self.kind not in DISTRACTOR_KINDS and self.kind not in distractor_kinds():
            own = f"one of your own needs {DISTRACTORS}=MODULE:CLASS"
            raise UnknownNameError("distractor", self.kind, distractor_kinds(), own)
        object.__setattr__(self, "difficulty", _canonical(self.difficulty))
        if self.difficulty != "medium" and self.kind == "none":
            raise DmcvbError(f"distractor none has no difficulty; {self.difficulty} is for static or dynamic")
        if self.difficulty[0].isalpha() and self.difficulty not in DIFFICULTIES and self.kind not in DISTRACTOR_KINDS:
            raise DmcvbError(f"distractor {self.kind} has no parts such as {self.difficulty}; give a scale, e.g. 0.35")

        if self.kind != "dynamic" and not set(_strengths(self.difficulty)) <= set(DISTRACTOR_PARTS):
            raise DmcvbError(f"distractor {self.kind} has no {CUE} or {LIGHT}; ask for dynamic_{self.difficulty}")

    @property
    def name(self) -> str:
        """Its stored name: "none", "static", "dynamic_hard", "dynamic_0.35", ..."""
        return self.kind if self.kind == "none" or self.difficulty == "medium" else f"{self.kind}_{self.difficulty}"

    def varies(self, part: str) -> bool:
        """Return True if a part (of `ALL_PARTS`) varies; none does under a user's own kind."""
        return self.kind in DISTRACTOR_KINDS and self.kind != "none" and part in _strengths(self.difficulty)

    @property
    def shows_videos(self) -> bool:
        """Whether the background is a video; a user's own kind may show one."""
        return self.varies("background") or self.kind not in DISTRACTOR_KINDS

    def scale_of(self, part: str) -> float:
        """The scale s of a part's ranges, or the correlation of a cue; 0 if it does not vary."""
        return float(_strengths(self.difficulty)[part] or 0.0) if self.varies(part) else 0.0

    @property
    def scale(self) -> float:
        """The scale s of all ranges; the largest one if parts have their own, 0 without distractors."""
        strengths, parts = _strengths(self.difficulty), (*SCALED_PARTS, LIGHT)
        return 0.0 if self.kind == "none" else max(float(strengths.get(part) or 0.0) for part in parts)

    @property
    def videos(self) -> int | None:
        """Number of background videos in use; None for all."""
        found = _strengths(self.difficulty).get("background")
        return None if found is None else int(found)

    @classmethod
    def parse(cls, name: str) -> DistractorSetting:
        """The distractor of a name such as "dynamic", "dynamic_medium", "static_easy" or "dynamic_0.35".

        Raises:
          UnknownNameError: there is no such kind or difficulty. DmcvbError: a number is out of range.
        """
        kind, said, difficulty = name.partition("_")
        return cls(kind, difficulty if said else "medium")


def _number(value: float) -> str:
    return f"{value:.3f}".rstrip("0").rstrip(".")


def _videos_at(scale: float) -> int | None:
    """Return the number of videos in play at a scale: as many as at the next word above it."""
    return next((DIFFICULTY_VIDEOS[word] for word, top in DIFFICULTY_SCALES.items() if scale <= top), None)


@functools.cache
def _strengths(difficulty: str) -> dict[str, float | None]:
    """Part -> its scale; of the background the number of videos, None for all."""
    if difficulty in DIFFICULTIES:
        scale = DIFFICULTY_SCALES[difficulty]
        return {"camera": scale, "color": scale, "background": DIFFICULTY_VIDEOS[difficulty]}
    if difficulty[:1].isdigit() or difficulty[:1] in ".-":
        scale = _in_range(difficulty, difficulty)
        return {"camera": scale, "color": scale, "background": _videos_at(scale)}
    found: dict[str, float | None] = {}
    for word in difficulty.split("-"):
        part = next((part for part in ALL_PARTS if word.startswith(part)), "")
        number = word[len(part) :]
        if word == CUE:
            raise DmcvbError(f"distractor part {CUE} needs its correlation with the action, e.g. {CUE}0.8")
        if not part or part in found:
            raise UnknownNameError("difficulty", difficulty, DIFFICULTIES)
        if part == "background":
            if number not in ("", ALL) and not re.fullmatch("0*[1-9][0-9]{0,8}", number):
                raise DmcvbError(
                    f"distractor part {word!r}: give a number of videos, e.g. background4, or background{ALL}"
                )
            found[part] = None if number == ALL else int(number or DIFFICULTY_VIDEOS["medium"] or 0)
        else:
            found[part] = _in_range(number, word) if number else DIFFICULTY_SCALES["medium"]
    return found


def _in_range(number: str, told: str) -> float:
    try:
        value = round(float(number), 3)
    except ValueError:
        raise UnknownNameError("difficulty", told, DIFFICULTIES) from None
    if not 0 < value <= 1:
        raise DmcvbError(
            f"distractor scale {told!r} is not above 0 and up to 1; without distractors is the setting none"
        )
    return value


@functools.cache
def _canonical(difficulty: str) -> str:
    """The one spelling of a difficulty: a word if there is one, else a scale, else its parts in their order."""
    strengths = _strengths(difficulty)
    scales = [strengths.get(part) for part in SCALED_PARTS]
    if set(strengths) == set(DISTRACTOR_PARTS) and scales[0] == scales[1] and scales[0] is not None:
        words = [word for word in DIFFICULTIES if _strengths(word) == strengths]
        if words:
            return words[0]
        if strengths["background"] == _videos_at(scales[0]):
            return _number(scales[0])
    numbers = {part: _number(value) for part, value in strengths.items() if part != "background" and value}
    if "background" in strengths:
        count = strengths["background"]
        numbers["background"] = ALL if count is None else str(int(count))
    return "-".join(f"{part}{numbers[part]}" for part in ALL_PARTS if part in numbers)


def distractor_kinds() -> tuple[str, ...]:
    """All kinds of distractors: DMC-VB's, then those that users named, then those of packages."""
    from importlib import metadata  # slow to import, and `--help` needs no distractors

    installed = [point.name for point in metadata.entry_points(group=DISTRACTOR_ENTRY_POINTS)]
    named = [kind_of(name) for name in allowed(DISTRACTORS)]
    return tuple(dict.fromkeys([*DISTRACTOR_KINDS, *named, *installed]))


def kind_of(name: str) -> str:
    """The kind of a user's own distractor "<module>:<Class>": its class's name in lower case."""
    return name.partition(":")[2].lower()


def parse_setting(task_id: str, setting: str) -> tuple[DistractorSetting, GoalMode | None]:
    """The distractor and the goal mode that a task's setting stands for ("dynamic_medium", "hidden").

    Mazes vary in style and have no other distractors; locomotion tasks have no goal mode.

    Raises:
      UnknownNameError: the task has no such setting.
    """
    if not is_maze(task_id):
        return DistractorSetting.parse(setting), None
    if setting not in GOAL_MODES:
        raise UnknownNameError(f"goal setting of {task_id}", setting, GOAL_MODES)
    return DistractorSetting(), GoalMode(setting)


# -- subsets --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SubsetSpec:
    """The identity of a subset.

    Attributes:
      task: the task's id.
      level: the behaviour policies.
      distractor: "none" for mazes.
      goal: None for tasks without a goal.
    """

    task: str
    level: Level
    distractor: DistractorSetting = DistractorSetting()
    goal: GoalMode | None = None

    @classmethod
    def parse(cls, task_id: str, level: str, setting: str) -> SubsetSpec:
        """The subset of three names.

        Raises:
          UnknownNameError: there is no such level, or the task has no such setting.
        """
        return cls(task_id, Level.parse(level), *parse_setting(task_id, setting))

    @property
    def setting(self) -> str:
        """The stored name of distractor and goal mode."""
        return self.distractor.name if self.goal is None else self.goal.value

    @property
    def name(self) -> str:
        """The name of the subset in a release, "<task>/<level>/<setting>"."""
        return subset_name(self.task, self.level, self.setting)

    @property
    def hides_goal(self) -> bool:
        """True if the images leave a goal out."""
        return self.goal not in (None, GoalMode.VISIBLE)

    @property
    def camera_moves(self) -> bool:
        """True if the camera moves: it follows the ant in mazes, and wanders in dynamic distractors."""
        return self.goal is not None or (self.distractor.kind == "dynamic" and self.distractor.varies("camera"))


def subset_name(task_id: str, level: str, setting: str) -> str:
    """The name of a subset, "<task>/<level>/<setting>"."""
    return f"{task_folder(task_id)}/{level}/{setting}"


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Return True if a subset's name fits one of the patterns: "walker-walk/*/static", "walker-walk/expert", "*"."""
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
