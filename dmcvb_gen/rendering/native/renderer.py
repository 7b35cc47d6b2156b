"""The renderer 'native': batches, visual looks and skies around the painter of `frame`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import RenderingError
from dmcvb_gen.rendering.base import Renderer, Views, check_frames, empty_labels, moved_lamps
from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native.frame import Frames, SceneConstants, label_frames, make_scratch, paint_frames
from dmcvb_gen.rendering.native.scene import PLANE, SUN_DISTANCE, Scene, records_of, scene_of
from dmcvb_gen.rendering.native.textures import SKY_WIDTH, Textures
from dmcvb_gen.rendering.native.visibility import sample_rays
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import Kinematics, camera_ids, matrices

VERSION = 2
"""Goes up when pictures change."""
CHUNK = 256
"""Frames whose poses are held at a time."""


OUT_OF_SIGHT = -1e6
"""Height of a goal that labels are to leave out, meters: below every floor."""


class NativeRenderer(Renderer):
    """Renderer in compiled Python. One thread at a time may use a renderer; several renderers work side by side."""

    name = "native"
    samples = 4

    @classmethod
    def check_task(cls, task):
        scene_of(task)

    def __init__(self, task: Task, size: int, *, backgrounds=None, floor_alpha=1.0, samples: int | None = None):
        super().__init__(task, size, backgrounds=backgrounds, floor_alpha=floor_alpha)
        if samples not in (None, self.samples):
            raise RenderingError(f"renderer 'native' takes {self.samples} samples a pixel, not {samples}; give none")
        self._scene = scene = scene_of(task)
        self._angles = np.radians(task.model.cam_fovy[camera_ids(task)]).tolist()
        finest = min(_finest_level(size, angle) for angle in self._angles)
        self._textures = Textures(task.picture_model, backgrounds, finest)
        self._textures.make_ready(scene.sky)
        self._looks: dict[int, int] = {}
        self._records = np.zeros((0, *scene.rec.shape))
        fields = ["geom_xpos", "geom_xmat"]
        fields += ["site_xpos", "site_xmat"] * bool(len(scene.sites) or len(scene.cords))
        fields += ["light_xpos", "light_xdir"] * bool(len(scene.lamps))
        self._kinematics, self._fields = Kinematics(task), fields
        moving_planes = scene.rec[scene.rec[:, L.KIND] == PLANE, L.MOVING]
        self._stays = scene.constants[L.MIRROR] < 0 and not len(scene.lamps) and not moving_planes.any()
        sun = task.model.light_type[scene.lamps] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        self._far_away = np.where(sun, SUN_DISTANCE * task.model.stat.extent, 0.0)
        self._scratch = make_scratch(len(scene.rec), size, scene.grid)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"version": VERSION}

    def render(self, physics, exogenous, views=None, hide_goal=False):
        return self._paint(physics, exogenous, views, not hide_goal, hide_goal)[int(hide_goal)]

    def render_pair(self, physics, exogenous, views=None):
        """See `Renderer`; the second ones are painted again only where the goal is."""
        return self._paint(physics, exogenous, views, True, True)

    def _paint(
        self, physics: np.ndarray, exogenous: DistractorState, views: Views, shown: bool, hidden: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Frames with and without the goal; none if they are not asked for."""
        indices = check_frames(self.task, physics, exogenous, views)
        shape = (len(indices), self.size, self.size, 3)
        out = [np.empty((len(physics) * asked, *shape), np.uint8) for asked in (shown, hidden)]
        for rows, poses in self._parts(physics):
            pictures = [np.empty((len(rows) * asked, *shape[1:]), np.uint8) for asked in (shown, hidden)]
            for column, view in enumerate(indices):
                frames, scene = self._frames(poses, exogenous[rows], view), self._constants(view)
                paint_frames(scene, frames, self._scratch, self._stays, *pictures)
                for whole, part in zip(out, pictures, strict=True):
                    if len(part):
                        whole[rows, column] = part
        return out[0], out[1]

    def render_labels(self, physics, exogenous, views=None, hide_goal=False):
        indices = check_frames(self.task, physics, exogenous, views)
        depth, segmentation = empty_labels(len(physics), len(indices), self.size)
        numbers = np.append(self._scene.geoms, -1).astype(np.int16)
        for rows, poses in self._parts(physics):
            if hide_goal:
                poses["geom_xpos"][:, list(self.task.goal_geoms), 2] = OUT_OF_SIGHT
            deep = np.empty((len(rows), self.size, self.size), np.float32)
            geom = np.empty((len(rows), self.size, self.size), np.int16)
            for column, view in enumerate(indices):
                frames, scene = self._frames(poses, exogenous[rows], view), self._constants(view, centers=True)
                label_frames(scene, frames, self._scratch, deep, geom)
                depth[rows, column], segmentation[rows, column] = deep, numbers[geom]
        return {"depth": depth, "segmentation": segmentation}

    # -- arguments ----------------------------------------------------------------------------

    def _parts(self, physics: np.ndarray) -> Iterator[tuple[np.ndarray, dict]]:
        """Frames to paint together, with their poses: never more than there is room for backgrounds."""
        together = min(self._textures.slots or CHUNK, CHUNK)
        for first in range(0, len(physics), together):
            rows = np.arange(first, min(first + together, len(physics)))
            yield rows, self._kinematics(physics[rows], self._fields)

    def _frames(self, poses: dict[str, np.ndarray], exogenous: DistractorState, view: int) -> Frames:
        scene, count = self._scene, len(exogenous)
        backgrounds = zip(exogenous.background_video.tolist(), exogenous.background_frame.tolist(), strict=True)
        sky = [self._textures.background(*key) if key[0] >= 0 else scene.sky for key in backgrounds]
        lamp = np.zeros((count, len(scene.shine), 6))
        if len(scene.lamps):
            place, direction = poses["light_xpos"], poses["light_xdir"]
            if exogenous.light_shift is not None:
                place, direction = moved_lamps(self.task.model, place, direction, exogenous.light_shift)
            lamp[..., :3], lamp[..., 3:] = place[:, scene.lamps], direction[:, scene.lamps]
            lamp[..., :3] -= self._far_away[:, None] * lamp[..., 3:]
        center, turn = _poses(scene, poses)
        eye = np.ascontiguousarray(exogenous.camera_position[:, view], np.float64)
        within = (scene.boxes[:, :3] < eye[:, None]) & (eye[:, None] < scene.boxes[:, 3:])
        return Frames(
            center=center,
            turn=turn,
            eye=eye,
            axes=np.ascontiguousarray(matrices(exogenous.camera_quaternion[:, view].astype(np.float64))),
            lamp=lamp,
            rgb=np.ascontiguousarray(exogenous.material_rgb, np.float64),
            look=np.array([self._look(style) for style in exogenous.style.tolist()], np.int64),
            sky=np.array(sky, np.int64),
            inside=within.all(axis=2).any(axis=1),
        )

    def _look(self, style: int) -> int:
        """Row of a style's records, its textures made ready."""
        if style not in self._looks:
            rec = records_of(self.task, self._scene, style, self.floor_alpha)
            for texture in np.unique(rec[:, L.TEXTURE]).astype(int).tolist():
                self._textures.make_ready(texture)
            self._records = np.concatenate([self._records, rec[None]])
            self._looks[style] = len(self._looks)
        return self._looks[style]

    def _constants(self, view: int, centers: bool = False) -> SceneConstants:
        """The constant arguments of a view; with `centers` all samples lie in the middle of their pixels."""
        scene, angle = self._scene, self._angles[view]
        constants = scene.constants.copy()
        constants[L.STEP] = step = 2 * math.tan(angle / 2) / self.size
        return SceneConstants(
            looks=self._records,
            constants=constants,
            lamps=scene.shine,
            texels=self._textures.texels,
            width=self._textures.table.shape[1],
            rays=sample_rays(self.size, step, centers),
        )


def _finest_level(size: int, angle: float) -> int:
    """The finest level of a sky that pictures of a size can show: the smallest footprint is at a rolled corner."""
    half = math.tan(angle / 2)
    corner = 1 + 2 * half * half  # squared length of the ray through the corner
    rho = 0.5 * SKY_WIDTH * (2 * half / size) / corner / math.sqrt(2)
    return max(int(math.floor(math.log2(rho) - 0.25)), 0) if rho > 1 else 0


def _poses(scene: Scene, poses: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Centers (frame, geom, 3) and axes (frame, geom, 3, 3) of a scene's geoms, sites and pieces of tendons."""
    geoms = scene.geoms[scene.geoms >= 0]
    center = [poses["geom_xpos"][:, geoms]]
    turn = [poses["geom_xmat"][:, geoms].reshape(len(center[0]), -1, 3, 3)]
    if len(scene.sites):
        center.append(poses["site_xpos"][:, scene.sites])
        turn.append(poses["site_xmat"][:, scene.sites].reshape(len(center[0]), -1, 3, 3))
    if len(scene.cords):
        one, two = poses["site_xpos"][:, scene.cords[:, 0]], poses["site_xpos"][:, scene.cords[:, 1]]
        center.append((one + two) / 2)
        turn.append(np.zeros((*one.shape, 3)))
        turn[-1][..., 2] = (two - one) / 2
    return np.ascontiguousarray(np.concatenate(center, axis=1)), np.ascontiguousarray(np.concatenate(turn, axis=1))
