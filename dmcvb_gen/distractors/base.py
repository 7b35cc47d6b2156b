"""What varies in a picture and nowhere else: the setting's name in, its ranges and videos out."""

from __future__ import annotations

from dataclasses import dataclass

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.tasks.base import Task

KINDS = ("none", "static", "dynamic")
SCALES = {"easy": 0.1, "medium": 0.2, "hard": 0.3}
"""Difficulty -> the scale s of every range (Distracting Control Suite); medium is DMC-VB's."""
VIDEOS = {"easy": 4, "medium": 8, "hard": None}
"""Difficulty -> how many background videos are in play; None: all."""


@dataclass(frozen=True)
class DistractorSetting:
    """A kind of distractor at a difficulty; `name` is "none", "static", "dynamic_hard", ... (medium is not named)."""

    kind: str = "none"
    difficulty: str = "medium"

    def __post_init__(self):
        if self.kind not in KINDS:
            raise UnknownNameError("distractor", self.kind, KINDS)
        if self.difficulty not in SCALES:
            raise UnknownNameError("difficulty", self.difficulty, SCALES)

    @property
    def name(self) -> str:
        return self.kind if self.kind == "none" or self.difficulty == "medium" else f"{self.kind}_{self.difficulty}"

    @property
    def scale(self) -> float:
        return 0.0 if self.kind == "none" else SCALES[self.difficulty]

    @property
    def videos(self) -> int | None:
        """How many videos are in play, None for all."""
        return VIDEOS[self.difficulty]

    @classmethod
    def parse(cls, name: str) -> DistractorSetting:
        """The setting of a name such as "dynamic", "dynamic_medium" or "static_easy"."""
        kind, _, difficulty = name.partition("_")
        return cls(kind, difficulty or "medium")


def floor_alpha_for(task: Task, setting: DistractorSetting) -> float:
    """Opacity of the ground plane: under distractors the background shows through humanoid's floor.

    1.0 for walker and cheetah, 0.3 otherwise (Distracting Control Suite); untouched without distractors.
    """
    if setting.kind == "none" or task.id in ("walker-walk", "cheetah-run"):
        return 1.0
    return 0.3
