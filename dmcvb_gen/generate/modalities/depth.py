"""Depth: meters along the line of sight's axis, 0 for the sky."""

from __future__ import annotations

import numpy as np

from dmcvb_gen.generate.modalities.base import Modality, register_modality

SCALE = 4
"""Meters at which an image of the depth has half of its brightness."""


@register_modality
class Depth(Modality):
    """Depth of what each pixel shows."""

    name, bounds = "depth", (0, np.inf)
    encoding = f"grey level = 255 / (1 + meters / {SCALE}), 0: sky"
    levels = "16-bit level = millimeters, 0: sky, 65535: or farther"

    def gray(self, values):
        return np.rint(values * 1000).clip(0, np.iinfo(np.uint16).max).astype(np.uint16)

    def compute(self, seen):
        return seen.depth

    def color(self, values):
        grey = np.where(values > 0, np.rint(255 / (1 + np.maximum(values, 0) / SCALE)), 0)
        return np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
