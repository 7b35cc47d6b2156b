"""The color distractor: the color of every material walks around the model's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dmcvb_gen.distractors.base import Distractor, Scene, bounded_walk
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.spec import ALL_PARTS, CUE
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import seen_materials

STEP_STD = 0.03
"""Standard deviation of the change of a channel in one tick, as a multiple of s."""


def check_colors_are_seen(task: Task) -> None:
    """Raise DmcvbError if no material of a task's model is seen, so that other colors would change no picture."""
    if (seen_materials(task.model) < 0).all():
        raise DmcvbError(f"{task.id} has no materials, so its colors cannot vary; give its geoms materials")


class Color(Distractor):
    """A color for every material, at most s from the model's own; those that no geom or site shows keep that."""

    kinds = ("static", "dynamic")
    stream = "color"
    names = ("material_rgb",)

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        own, scale = scene.task.material_colors, scene.setting.scale_of("color")
        if not any(scene.setting.varies(part) for part in ALL_PARTS if part not in (self.stream, CUE)):
            check_colors_are_seen(scene.task)
        low, high = np.clip(own - scale, 0, 1), np.clip(own + scale, 0, 1)
        start = np.stack([rng.random(own.shape) for rng in generators])
        color = low + start * (high - low)  # uniform in what is left of the range inside [0, 1]
        if scene.setting.kind == "dynamic":
            colors = bounded_walk(scene, generators, color, low, high, STEP_STD * scale)
        else:
            colors = np.repeat(color[:, None], scene.frames, axis=1)
        unseen = np.setdiff1d(np.arange(len(own)), seen_materials(scene.task.model))
        colors[:, :, unseen] = own[unseen]  # a label without effect would only cost bytes
        self.drawn = {"material_rgb": colors}

    @classmethod
    def nominal(cls, scene: Scene, physics: np.ndarray) -> Mapping[str, np.ndarray]:
        own = scene.task.material_colors
        return {"material_rgb": np.broadcast_to(own, (*physics.shape[:-1], *own.shape))}
