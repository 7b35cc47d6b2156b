"""Show depth, segmentation and flow as RGB images, for formats that know images alone.

Each image can be read back: segmentation exactly, depth and flow to the accuracy of 8 bits.
"""

from __future__ import annotations

import numpy as np

FLOW_STEP = 1 / 8
"""Pixels of flow that one grey level stands for; 128 stands still."""
DEPTH_SCALE = 4
"""Meters at which depth has half of the brightness."""
_GEOM_FACTOR = 0x9E3779
"""Odd, so that id -> id * factor modulo 2**24 gives no color to two geoms; near ids get colors far apart."""

ENCODINGS = {
    "depth": f"grey level = 255 / (1 + meters / {DEPTH_SCALE}), 0: sky",
    "segmentation": f"65536 R + 256 G + B = {_GEOM_FACTOR} (geom id + 1) modulo 2^24, 0: sky",
    "flow": "R = 128 + 8 pixels to the right, G = 128 + 8 pixels down, B = 128",
}
"""How the images of each modality hold its values."""


def color(modality: str, values: np.ndarray) -> np.ndarray:
    """Show values of a modality as RGB.

    Args:
      modality: a name out of `spec.LABEL_TYPES`.
      values: (..., height, width) or, of flow, (..., height, width, 2), see `spec.LABEL_TYPES`.

    Returns:
      (..., height, width, 3) uint8.
    """
    if modality == "depth":
        grey = np.where(values > 0, np.rint(255 / (1 + np.maximum(values, 0) / DEPTH_SCALE)), 0)
        return np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
    if modality == "segmentation":
        code = (values.astype(np.int64) + 1) * _GEOM_FACTOR % 2**24
        return np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)
    moved = np.clip(np.rint(128 + values / FLOW_STEP), 0, 255)
    return np.concatenate([moved, np.full((*moved.shape[:-1], 1), 128)], axis=-1).astype(np.uint8)


def uncolor(modality: str, images: np.ndarray) -> np.ndarray:
    """Read the values back from `color`'s images, (..., height, width, 3) uint8; of `spec.LABEL_TYPES`' dtype."""
    if modality == "depth":
        grey = images[..., 0].astype(np.float32)
        return np.where(grey > 0, DEPTH_SCALE * (255 / np.maximum(grey, 1) - 1), 0).astype(np.float32)
    if modality == "segmentation":
        code = (images.astype(np.int64) * [65536, 256, 1]).sum(axis=-1)
        return (code * pow(_GEOM_FACTOR, -1, 2**24) % 2**24 - 1).astype(np.int16)
    return ((images[..., :2].astype(np.float32) - 128) * FLOW_STEP).astype(np.float32)
