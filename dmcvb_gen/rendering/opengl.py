"""The reference renderer: MuJoCo's own OpenGL through EGL, whose pictures are dm_control's.

Against the usual wrapper it takes what costs no pixel: an off-screen buffer of the picture's own size,
one render an agent step, kinematics without a physics step.
"""

from __future__ import annotations

import copy
import ctypes.util
import functools
import importlib
import os
import subprocess
import sys
from importlib import metadata
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import RenderingError
from dmcvb_gen.rendering.base import (
    Renderer,
    Views,
    check_frames,
    check_size,
    empty_labels,
    geom_materials,
    moved_lamps,
)
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import camera_ids, matrices

RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
SKY_WIDTH = 800
"""Texels a side of a background on the sky (the skybox's own width)."""
_REPLACED = ("mat_rgba", "geom_matid", "geom_rgba")
"""Fields of the model that labels replace, frame by frame."""
MAX_GEOMS = 20_000
"""Shapes of a picture, at most; MuJoCo leaves out the others. A maze of 31 x 31 cells can have 1,026."""
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""MuJoCo's ways to off-screen OpenGL, and the library that each needs; the first one that starts is taken."""
_PROBE = "from mujoco.{0} import GLContext; c = GLContext(8, 8); c.make_current(); c.free()"


@functools.cache
def _started() -> tuple[str | None, str]:
    """The way to OpenGL that starts here, or None and why none does. A failure can abort, so a process tries it."""
    asked, reasons = os.environ.get("PYOPENGL_PLATFORM"), []
    for way, library in _LIBRARIES.items():
        if asked not in (None, way) or ctypes.util.find_library(library) is None:
            continue
        variables = {"PYOPENGL_PLATFORM": way, "MUJOCO_GL": way}
        command = [sys.executable, "-c", _PROBE.format(way)]
        run = subprocess.run(command, capture_output=True, text=True, env=os.environ | variables)
        if run.returncode == 0:
            return way, ""
        reasons.append(f"{library} does not start ({(run.stderr.strip().splitlines() or ['no message'])[-1]})")
    return None, "; ".join(reasons) or "libEGL is missing"


def unavailable() -> str | None:
    """Why OpenGL cannot start here (and the cure), or None."""
    way, reason = _started()
    return None if way else f"{reason}; install libegl1 and libgl1 (Debian: apt-get install libegl1 libgl1)"


def _gl_context(size: int) -> Any:
    """An off-screen OpenGL context.

    Raises:
      RenderingError: none starts here.
    """
    if reason := unavailable():
        raise RenderingError(f"renderer 'opengl' cannot start here: {reason}")
    way, _ = _started()
    os.environ.setdefault("PYOPENGL_PLATFORM", str(way))
    return importlib.import_module(f"mujoco.{way}").GLContext(size, size)


class OpenglRenderer(Renderer):
    """Renderer by MuJoCo's OpenGL."""

    name = "opengl"

    @classmethod
    def unavailable(cls):
        return unavailable()

    def __init__(self, task: Task, size: int, *, backgrounds=None, floor_alpha=1.0, samples: int | None = None):
        check_size(size)
        self._gl = _gl_context(size)
        self.task, self.size, self.floor_alpha = task, size, float(floor_alpha)
        self._backgrounds = backgrounds
        self._model = copy.deepcopy(task.picture_model)  # materials and textures change frame by frame
        self._model.vis.global_.offwidth = self._model.vis.global_.offheight = size
        self._model.vis.quality.offsamples = 4 if samples is None else samples
        self._samples = int(self._model.vis.quality.offsamples)
        skies = np.flatnonzero(self._model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        self._sky = int(skies[0]) if len(skies) else -1
        if self._sky >= 0:
            address = int(self._model.tex_adr[self._sky])
            height, width = int(self._model.tex_height[self._sky]), int(self._model.tex_width[self._sky])
            self._sky_range = slice(address, address + height * width * int(self._model.tex_nchannel[self._sky]))
            self._own_sky = height, self._model.tex_data[self._sky_range].copy()
        self._floors = np.flatnonzero(self._model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        for geom in self._floors:
            material = self._model.geom_matid[geom]
            if self.floor_alpha < 1 and material >= 0 and self._model.mat_texid[material, RGB_ROLE] >= 0:
                self._model.mat_rgba[material, 3] = self.floor_alpha
        self._own_colors = task.material_colors.astype(np.float32)
        self._own_values = {name: getattr(self._model, name).copy() for name in _REPLACED}
        self._data = mujoco.MjData(self._model)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, maxgeom=MAX_GEOMS)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._shown: tuple[int, int] = (-1, -1)

    def describe(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "samples": self._samples,
            "floor_alpha": self.floor_alpha,
            "mujoco": metadata.version("mujoco"),
        }

    def render(
        self, physics: np.ndarray, exogenous: DistractorState, views: Views = None, hide_goal: bool = False
    ) -> np.ndarray:
        indices = check_frames(self.task, physics, exogenous, views)
        out = np.empty((len(physics), len(indices), self.size, self.size, 3), np.uint8)
        self._gl.make_current()
        rotations = matrices(exogenous.camera_quaternion.astype(np.float64))
        # Frames with the same background follow each other: a texture is uploaded once.
        order = np.lexsort((exogenous.background_frame, exogenous.background_video))
        for frame in order:
            self._pose(physics[frame], exogenous, frame, hide_goal)
            for column, view in enumerate(indices):
                out[frame, column] = self._shoot(view, exogenous.camera_position[frame], rotations[frame])
        return out

    def render_labels(
        self, physics: np.ndarray, exogenous: DistractorState, views: Views = None, hide_goal: bool = False
    ) -> dict[str, np.ndarray]:
        """Depth (frame, view, size, size) float32 in meters (0: sky) and segmentation int16 (geom id, -1: sky)."""
        indices = check_frames(self.task, physics, exogenous, views)
        depth, segmentation = empty_labels(len(physics), len(indices), self.size)
        self._gl.make_current()
        rotations = matrices(exogenous.camera_quaternion.astype(np.float64))
        near = self._model.vis.map.znear * self._model.stat.extent
        far = self._model.vis.map.zfar * self._model.stat.extent
        for frame in range(len(physics)):
            self._pose(physics[frame], exogenous, frame, hide_goal)
            for column, view in enumerate(indices):
                raw = np.empty((self.size, self.size), np.float32)
                self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0  # which has a depth of its own
                self._shoot(view, exogenous.camera_position[frame], rotations[frame], depth=raw)
                self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1
                meters = near * far / (far - raw[::-1].astype(np.float64) * (far - near))
                depth[frame, column] = np.where(raw[::-1] >= 1, 0, meters)
                self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 1
                self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
                colors = self._shoot(view, exogenous.camera_position[frame], rotations[frame]).astype(np.int32)
                self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 0
                self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
                ids = colors[..., 0] + colors[..., 1] * 256 + colors[..., 2] * 65536
                table = np.full(self._scene.ngeom + 2, -1, np.int16)
                for geom in self._scene.geoms[: self._scene.ngeom]:
                    if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                        table[geom.segid + 1] = geom.objid
                segmentation[frame, column] = table[np.minimum(ids, len(table) - 1)]
        return {"depth": depth, "segmentation": segmentation}

    def _pose(self, physics, exogenous, frame, hide_goal):
        """Set the frame's state, then the model as its episode has it, then what its labels say."""
        model, data = self._model, self._data
        row, spec = np.asarray(physics, np.float64), self.task.physics_spec
        for name, values in self._own_values.items():
            getattr(model, name)[:] = values
        self.task.apply_entries(model, row)
        for field in range(model.nhfield if "hfield_data" in self.task.model_entries else 0):
            mujoco.mjr_uploadHField(model, self._context, field)
        mujoco.mj_setState(model, data, row[: mujoco.mj_stateSize(model, spec)], spec)
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex, mujoco.mj_tendon):
            stage(model, data)
        if exogenous.light_shift is not None:
            lamps, shift = (data.light_xpos[None], data.light_xdir[None]), exogenous.light_shift[frame : frame + 1]
            data.light_xpos[:], data.light_xdir[:] = (part[0] for part in moved_lamps(model, *lamps, shift))
        recolored = np.flatnonzero((exogenous.material_rgb[frame] != self._own_colors).any(axis=1))
        model.mat_rgba[recolored, :3] = exogenous.material_rgb[frame, recolored]
        if exogenous.style[frame] >= 0:
            model.geom_matid[:] = geom_materials(self.task, int(exogenous.style[frame]))
        if hide_goal:
            model.geom_rgba[list(self.task.goal_geoms)] = 0
        self._show_background(int(exogenous.background_video[frame]), int(exogenous.background_frame[frame]))

    def _show_background(self, video: int, frame: int) -> None:
        """Put a video frame on the sky: a square texture, which MuJoCo repeats on the six faces."""
        if self._sky < 0 and video >= 0:
            raise RenderingError(
                f'{self.task.id} has no sky to show a video on; add a texture of type="skybox" to its model, or leave '
                "the background out of what varies"
            )
        if self._sky < 0 or (video, frame) == self._shown:
            return
        if video < 0:
            height, pixels = self._own_sky
            self._model.tex_height[self._sky] = height
            self._model.tex_data[self._sky_range] = pixels
        else:
            width = int(self._model.tex_width[self._sky])
            picture = self.background(video, frame, width, Image.Resampling.BILINEAR)
            self._model.tex_height[self._sky] = width
            start = self._sky_range.start
            self._model.tex_data[start : start + picture.size] = picture.ravel()
        mujoco.mjr_uploadTexture(self._model, self._context, self._sky)
        self._shown = (video, frame)

    def _shoot(self, view, positions, rotations, depth=None) -> np.ndarray:
        camera = camera_ids(self.task)[view]
        self._data.cam_xpos[camera] = positions[view]
        self._data.cam_xmat[camera] = rotations[view].ravel()
        self._camera.fixedcamid = camera
        shown = (self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        mujoco.mjv_updateScene(self._model, self._data, *shown)
        if self._scene.ngeom >= MAX_GEOMS:
            raise RenderingError(f"{self.task.id} has more than {MAX_GEOMS:,} shapes, which 'opengl' cannot draw")
        rectangle = mujoco.MjrRect(0, 0, self.size, self.size)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        picture = np.empty((self.size, self.size, 3), np.uint8)
        mujoco.mjr_readPixels(picture, depth, rectangle, self._context)
        return picture[::-1]

    def close(self) -> None:
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None


RENDERER = OpenglRenderer
