"""The color distractor: an episode's own stream in, a color for every material and frame out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.distractors.base import Distractor
from dmcvb_gen.tasks.base import ACTION_REPEAT

STEP_STD = 0.03
"""Of a tick's change of a channel, times s."""


def color_walk(
    own: np.ndarray, setting: Distractor, frames: int, generators: Sequence[np.random.Generator]
) -> np.ndarray:
    """Draw the colors of all materials.

    Args:
      own: (material, 3) the model's colors.

    Returns:
      (episode, frame, material, 3) in [0, 1], never farther than s from the model's own.
    """
    low, high = np.clip(own - setting.scale, 0, 1), np.clip(own + setting.scale, 0, 1)
    start = np.stack([rng.random(own.shape) for rng in generators])
    color = low + start * (high - low)  # uniform in what is left of the range inside [0, 1]
    out = np.empty((len(generators), frames, *own.shape))
    out[:] = color[:, None]
    if setting.kind != "dynamic":
        return out
    ticks = ACTION_REPEAT * (frames - 1)
    noise = np.stack([arithmetic.normal(rng, (ticks, *own.shape)) for rng in generators], axis=1)
    for tick in range(ticks):
        color = np.clip(color + STEP_STD * setting.scale * noise[tick], low, high)
        if (tick + 1) % ACTION_REPEAT == 0:
            out[:, (tick + 1) // ACTION_REPEAT] = color
    return out
