"""Light that moves: lamps wander, so light and shadows come from other places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dmcvb_gen.distractors.base import Distractor, Scene, bounded_walk
from dmcvb_gen.errors import DmcvbError

RANGE = np.array([2.0, 2.0, 0.5])
"""Largest shift along x, y and z, times s, as a share of the highest lamp's height."""
STEP_STD = 0.05
"""Standard deviation of a tick's step, as a share of the largest shift."""


class Light(Distractor):
    """One walk for all lamps of the model, which starts uniform in its range and stops at its ends."""

    kinds = ("dynamic",)
    stream = "light"
    names = ("light_shift",)

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        model = scene.task.model
        heights = model.light_pos[model.light_active.astype(bool), 2]
        if not len(heights):
            raise DmcvbError(f"{scene.task.id} has no lamp, so its light cannot vary; remove light")
        most = RANGE * scene.setting.scale_of("light") * (abs(float(heights.max())) or 1.0)
        place = (2 * np.stack([rng.random(3) for rng in generators]) - 1) * most
        self.drawn = {"light_shift": bounded_walk(scene, generators, place, -most, most, STEP_STD * most)}
