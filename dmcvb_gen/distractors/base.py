"""What varies in a picture and nowhere else: the setting's name in, its ranges and videos out."""

from __future__ import annotations

from dmcvb_gen.spec import DIFFICULTY_SCALES as SCALES
from dmcvb_gen.spec import DISTRACTOR_KINDS as KINDS
from dmcvb_gen.spec import Distractor
from dmcvb_gen.tasks.base import Task

__all__ = ["KINDS", "SCALES", "Distractor", "floor_alpha_for"]


def floor_alpha_for(task: Task, setting: Distractor) -> float:
    """Opacity of the ground plane: under distractors the background shows through humanoid's floor.

    Walker and cheetah 1.0, reacher 0.0, otherwise 0.3 (Distracting Control Suite); untouched without distractors.
    """
    return 1.0 if setting.kind == "none" else task.floor_alpha
