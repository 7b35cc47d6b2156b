"""Segmentation: MuJoCo's number of the geom that each pixel shows, -1 for the sky."""

from __future__ import annotations

import numpy as np

from dmcvb_gen.generate.modalities.base import Modality, register_modality

FACTOR = 0x9E3779
"""Odd, so that id -> id * factor modulo 2**24 gives no color to two geoms; near ids get colors far apart."""


@register_modality
class Segmentation(Modality):
    """Geom of each pixel."""

    name, dtype, bounds = "segmentation", "int16", (-1, np.iinfo(np.int16).max)
    encoding = f"65536 R + 256 G + B = {FACTOR} (geom id + 1) modulo 2^24, 0: sky"

    def compute(self, seen):
        return seen.geom

    def color(self, values):
        code = (values.astype(np.int64) + 1) * FACTOR % 2**24
        return np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)
