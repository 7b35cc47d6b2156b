"""What varies in a picture and nowhere else: the setting's name in, its ranges and videos out."""

from __future__ import annotations

from dmcvb_gen.names import DIFFICULTY_SCALES as SCALES
from dmcvb_gen.names import DISTRACTOR_KINDS as KINDS
from dmcvb_gen.names import DistractorSetting
from dmcvb_gen.tasks.base import Task

__all__ = ["KINDS", "SCALES", "DistractorSetting", "floor_alpha_for"]


def floor_alpha_for(task: Task, setting: DistractorSetting) -> float:
    """Opacity of the ground plane: under distractors the background shows through humanoid's floor.

    1.0 for walker and cheetah, 0.3 otherwise (Distracting Control Suite); untouched without distractors.
    """
    if setting.kind == "none" or task.id in ("walker-walk", "cheetah-run"):
        return 1.0
    return 0.3
