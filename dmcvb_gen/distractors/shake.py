"""Camera shake: every frame shifts the camera by a small random vector, on top of its walk."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.distractors.base import Distractor, Scene
from dmcvb_gen.tasks.cameras import camera_ids

SHARE = 0.1
"""Standard deviation of the shift along each axis, times s, as a share of the nominal camera's distance."""


class Shake(Distractor):
    """Shifts of the camera, independent from frame to frame; it keeps its direction."""

    kinds = ("dynamic",)
    stream = "shake"
    names = ()

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        model = scene.task.model
        distance = arithmetic.norm(np.asarray(model.cam_poscom0[camera_ids(scene.task)[0]]))
        drawn = np.stack([arithmetic.normal(rng, (scene.frames, 3)) for rng in generators])
        self._shift = SHARE * scene.setting.scale_of("shake") * float(distance) * drawn

    def adjust(self, found: dict[str, np.ndarray], actions: np.ndarray, frames: int | slice) -> None:
        found["camera_position"] = found["camera_position"] + self._shift[:, frames][..., None, :]
