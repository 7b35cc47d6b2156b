"""A spurious cue: what the agent just did shows in the colors, so that imitation can learn it in place of the task.

Every frame is a shade lighter or darker. Its shade is the sign of the first number of the action before the frame, or
the opposite, at random so that the two correlate by RHO. Environments show the cue of the actions that are taken there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dmcvb_gen.distractors.base import Distractor, Scene
from dmcvb_gen.distractors.color import check_colors_are_seen

SHADE = 0.15
"""Added to or taken from every channel of every material that is seen."""


class Cue(Distractor):
    """Colors a shade lighter or darker, by the sign of the last action's first number, at a correlation.

    The sign is that of the number less the middle of its bounds.
    """

    kinds = ("dynamic",)
    stream = "cue"
    names = ()

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        check_colors_are_seen(scene.task)
        self._middle = (scene.task.action_low[0] + scene.task.action_high[0]) / 2
        drawn = np.stack([rng.random(scene.frames) for rng in generators])
        self._follows = drawn < (1 + scene.setting.scale_of("cue")) / 2
        self._coin = drawn < 0.5

    def adjust(self, found: dict[str, np.ndarray], actions: np.ndarray, frames: int | slice) -> None:
        sign = np.where(actions.any(axis=-1), np.sign(actions[..., 0] - self._middle), 0)
        agree = np.where(self._follows[:, frames], sign, -sign)
        cue = np.where(sign == 0, np.where(self._coin[:, frames], 1.0, -1.0), agree)  # nothing was done yet
        found["material_rgb"] = np.clip(found["material_rgb"] + SHADE * cue[..., None, None], 0, 1)
