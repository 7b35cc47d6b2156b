"""A modality: `repaint --label near` marks the pixels that show something within two meters."""

import numpy as np

from dmcvb_gen.generate.modalities import Modality, register_modality


@register_modality
class Near(Modality):
    """1 if a pixel shows something within two meters, else 0."""

    name = "near"  # of the option and of the stored array
    dtype, bounds = "uint8", (0, 1)
    encoding = "white: near, black: far"  # what `color` makes, for LeRobot's info.json

    def compute(self, seen):  # depth and geom of each pixel, states, labels
        return ((seen.depth > 0) & (seen.depth < 2)).astype(np.uint8)

    def color(self, values):
        return np.repeat(values[..., None] * np.uint8(255), 3, axis=-1)
