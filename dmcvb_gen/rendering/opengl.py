"""The reference renderer: MuJoCo's own OpenGL through EGL, whose pictures are dm_control's.

`mujoco.Renderer` draws; what costs no pixel is left out: the off-screen buffer has the picture's own size, an agent
step has one render, and kinematics no physics step.
"""

from __future__ import annotations

import atexit
import copy
import ctypes.util
import functools
import importlib
import os
import subprocess
import sys
import weakref
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from dmcvb_gen.errors import RenderingError, first_line
from dmcvb_gen.rendering.base import Renderer, check_frames, empty_labels, moved_lamps
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import camera_ids, matrices

RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
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


def _painter(model: mujoco.MjModel, size: int) -> mujoco.Renderer:
    """MuJoCo's own renderer, in the off-screen OpenGL that starts here.

    Raises:
      RenderingError: none does.
    """
    if reason := unavailable():
        raise RenderingError(f"renderer 'opengl' cannot start here: {reason}")
    way, _ = _started()
    os.environ.setdefault("PYOPENGL_PLATFORM", str(way))
    module: Any = sys.modules[mujoco.Renderer.__module__]  # it has chosen already, a window system for example
    chosen = getattr(module.gl_context, "GLContext", None)
    module.gl_context.GLContext = importlib.import_module(f"mujoco.{way}").GLContext
    try:
        return mujoco.Renderer(model, size, size, MAX_GEOMS)
    finally:
        module.gl_context.GLContext = chosen


def _close(painter: mujoco.Renderer) -> None:
    if painter._gl_context:
        painter._gl_context.make_current()  # MuJoCo frees what the current one has
    painter.close()


class OpenglRenderer(Renderer):
    """Renderer by MuJoCo's OpenGL."""

    name = "opengl"

    unavailable = staticmethod(unavailable)

    def __init__(self, task: Task, size: int, *, backgrounds=None, floor_alpha=1.0, samples: int | None = None):
        super().__init__(task, size, backgrounds=backgrounds, floor_alpha=floor_alpha)
        self._model = copy.deepcopy(task.picture_model)  # materials and textures change frame by frame
        self._model.vis.global_.offwidth = self._model.vis.global_.offheight = size
        self._model.vis.quality.offsamples = self.samples = 4 if samples is None else samples
        skies = np.flatnonzero(self._model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        self._sky = int(skies[0]) if len(skies) else -1
        if self._sky >= 0:
            address = int(self._model.tex_adr[self._sky])
            height, width = int(self._model.tex_height[self._sky]), int(self._model.tex_width[self._sky])
            self._sky_range = slice(address, address + height * width * int(self._model.tex_nchannel[self._sky]))
            self._own_sky = height, self._model.tex_data[self._sky_range].copy()
        for geom in np.flatnonzero(self._model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
            material = self._model.geom_matid[geom]
            if self.floor_alpha < 1 and material >= 0 and self._model.mat_texid[material, RGB_ROLE] >= 0:
                self._model.mat_rgba[material, 3] = self.floor_alpha
        self._own_colors = task.material_colors.astype(np.float32)
        self._own_values = {name: getattr(self._model, name).copy() for name in _REPLACED}
        self._data = mujoco.MjData(self._model)
        self._painter = _painter(self._model, size)
        self._free = weakref.finalize(self, _close, self._painter)
        self._free.atexit = False
        atexit.register(self._free)  # now, before OpenGL's library ends: it may have come with this renderer
        if (given := self._painter._mjr_context.offSamples) != self.samples:
            raise RenderingError(
                f"OpenGL gives {given} samples a pixel here, not {self.samples}; ask for --samples {given}"
            )
        self._terrain_changes = task.draws_terrain or "hfield_data" in task.model_entries
        self._shown: tuple[int, int] = (-1, -1)

    def render(self, physics, exogenous, views=None, hide_goal=False):
        indices = check_frames(self.task, physics, exogenous, views)
        out = np.empty((len(physics), len(indices), self.size, self.size, 3), np.uint8)
        self._take_context()
        rotations = matrices(exogenous.camera_quaternion.astype(np.float64))
        # Frames with the same background follow each other: a texture is uploaded once.
        order = np.lexsort((exogenous.background_frame, exogenous.background_video))
        for frame in order:
            self._pose(physics[frame], exogenous, frame, hide_goal)
            for column, view in enumerate(indices):
                out[frame, column] = self._shoot(view, exogenous.camera_position[frame], rotations[frame])
        return out

    def render_labels(self, physics, exogenous, views=None, hide_goal=False):
        indices = check_frames(self.task, physics, exogenous, views)
        depth, segmentation = empty_labels(len(physics), len(indices), self.size)
        self._take_context()
        rotations = matrices(exogenous.camera_quaternion.astype(np.float64))
        for frame in range(len(physics)):
            self._pose(physics[frame], exogenous, frame, hide_goal)
            for column, view in enumerate(indices):
                self._painter.enable_segmentation_rendering()
                number, kind = np.moveaxis(self._shoot(view, exogenous.camera_position[frame], rotations[frame]), -1, 0)
                segmentation[frame, column] = np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, -1)
                self._painter.enable_depth_rendering()
                meters = self._shoot(view, exogenous.camera_position[frame], rotations[frame])
                depth[frame, column] = np.where(kind < 0, 0, meters)
        self._painter.disable_depth_rendering()
        return {"depth": depth, "segmentation": segmentation}

    def check_sky(self) -> None:
        if self._sky < 0:
            raise RenderingError(
                f'{self.task.id} has no sky to show a video on; add a texture of type="skybox" to its model, or leave '
                "the background out of what varies"
            )

    def _take_context(self) -> None:
        try:
            self._painter._gl_context.make_current()
        except Exception as error:  # EGL's own kinds
            raise RenderingError(
                f"OpenGL does not draw here ({first_line(error)}); make an environment in the thread that uses it"
            ) from None

    def _pose(self, physics, exogenous, frame, hide_goal):
        """Set the frame's state, then the model as its episode has it, then what its labels say."""
        model, data = self._model, self._data
        row, spec = np.asarray(physics, np.float64), self.task.physics_spec
        for name, values in self._own_values.items():
            getattr(model, name)[:] = values
        self.task.apply_entries(model, row)
        for field in range(model.nhfield if self._terrain_changes else 0):
            mujoco.mjr_uploadHField(model, self._painter._mjr_context, field)
        mujoco.mj_setState(model, data, row[: mujoco.mj_stateSize(model, spec)], spec)
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex, mujoco.mj_tendon):
            stage(model, data)
        if exogenous.light_shift is not None:
            lamps, shift = (data.light_xpos[None], data.light_xdir[None]), exogenous.light_shift[frame : frame + 1]
            data.light_xpos[:], data.light_xdir[:] = (part[0] for part in moved_lamps(model, *lamps, shift))
        recolored = np.flatnonzero((exogenous.material_rgb[frame] != self._own_colors).any(axis=1))
        model.mat_rgba[recolored, :3] = exogenous.material_rgb[frame, recolored]
        style = int(exogenous.style[frame])
        if style >= 0 and (materials := self.task.style_geom_matid(style)) is not None:
            model.geom_matid[:] = materials
        if hide_goal:
            model.geom_rgba[list(self.task.goal_geoms)] = 0
        self._show_background(int(exogenous.background_video[frame]), int(exogenous.background_frame[frame]))

    def _show_background(self, video: int, frame: int) -> None:
        """Put a video frame on the sky: a square texture, which MuJoCo repeats on the six faces."""
        if video >= 0:
            self.check_sky()
        if self._sky < 0 or (video, frame) == self._shown:
            return
        if video < 0:
            height, pixels = self._own_sky
            self._model.tex_height[self._sky] = height
            self._model.tex_data[self._sky_range] = pixels
        else:
            width = int(self._model.tex_width[self._sky])
            image = Image.fromarray(self.backgrounds.frames(video)[frame])
            picture = np.asarray(image.resize((width, width), Image.Resampling.BILINEAR))
            self._model.tex_height[self._sky] = width
            start = self._sky_range.start
            self._model.tex_data[start : start + picture.size] = picture.ravel()
        mujoco.mjr_uploadTexture(self._model, self._painter._mjr_context, self._sky)
        self._shown = (video, frame)

    def _shoot(self, view, positions, rotations) -> np.ndarray:
        """What the painter is set to: a picture, depth, or number and kind of the objects."""
        camera = camera_ids(self.task)[view]
        self._data.cam_xpos[camera] = positions[view]
        self._data.cam_xmat[camera] = rotations[view].ravel()
        self._painter.update_scene(self._data, camera)
        if self._painter.scene.ngeom >= MAX_GEOMS:
            raise RenderingError(f"{self.task.id} has more than {MAX_GEOMS:,} shapes, which 'opengl' cannot draw")
        return self._painter.render()

    def close(self) -> None:
        self._free()


RENDERER = OpenglRenderer
