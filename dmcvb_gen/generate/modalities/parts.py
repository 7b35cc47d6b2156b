"""Parts: which part of the scene each pixel shows, the same numbers for every task."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from dmcvb_gen.generate.modalities.base import Modality, register_modality

if TYPE_CHECKING:
    from dmcvb_gen.tasks.base import Task

BACKGROUND, AGENT, FLOOR, WALL, GOAL = range(5)
COLORS = np.array([[0, 0, 0], [230, 159, 0], [86, 180, 233], [204, 121, 167], [0, 158, 115]], np.uint8)
"""Colors of the parts in their order. Color-blind people can tell them apart."""


@register_modality
class Parts(Modality):
    """Part of each pixel: 0 background, 1 agent (whatever joints move), 2 floor, 3 wall (other still geoms), 4 goal.

    The goal is what a maze hides under `hidden`, and whatever the model calls a target.
    """

    name, dtype, bounds = "parts", "uint8", (BACKGROUND, GOAL)
    encoding = "black background, orange agent, light blue floor, pink wall, green goal"

    def compute(self, seen):
        return parts_of(seen.task)[seen.geom]

    def color(self, values):
        return COLORS[values]


@functools.lru_cache(maxsize=8)
def parts_of(task: Task) -> np.ndarray:
    """(geom + 1,) uint8: the part of every geom; the last entry, which geom -1 indexes, is the background."""
    import mujoco

    model = task.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    level = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (data.geom_xmat[:, 8] > 0.7)
    moving = model.body_weldid[model.geom_bodyid] > 0
    named = ["target" in model.geom(geom).name for geom in range(model.ngeom)]
    parts = np.full(model.ngeom + 1, WALL, np.uint8)
    for part, geoms in ((FLOOR, level), (AGENT, moving), (GOAL, named), (GOAL, list(task.goal_geoms))):
        parts[:-1][geoms] = part
    parts[-1] = BACKGROUND
    return parts
