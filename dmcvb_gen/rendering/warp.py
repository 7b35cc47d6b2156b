"""The renderer 'warp': MuJoCo Warp's batch ray tracer on CPU or CUDA.

One world of the ray tracer is one frame. Kinematics is computed by MuJoCo in float64 and copied in, so
no Warp physics runs. What OpenGL does and the tracer does not is made up for here: distant floor textures
are averaged (supersampling and a softened texture), a see-through floor is two passes blended, the
background's picture is put on all six faces of the sky.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from importlib import metadata
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import RenderingError
from dmcvb_gen.extras import installed
from dmcvb_gen.rendering.base import Renderer, check_frames, check_size, empty_labels, geom_materials, moved_lamps
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import Kinematics, camera_ids, matrices

WORLDS = 256
"""Frames a launch."""
FEW_WORLDS = 32
"""Frames of the launches for what is left over, so that little is painted for nothing."""
PATTERNS = {
    1: [(0.5, 0.5)],
    2: [(0.25, 0.25), (0.75, 0.75)],
    4: [(0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375)],
    8: [(i / 8 + 1 / 16, (3 * i % 8) / 8 + 1 / 16) for i in range(8)],
}
"""Samples a pixel -> where they lie in it: no two share a row or a column, so that edges of any direction soften."""
DEFAULT_SAMPLES = 2
"""Twice as fast as 4 and hardly farther from OpenGL (scripts/bench_render.py)."""
TEXTURE_TEXELS = 64
"""Texels a side that larger repeating textures are averaged to, for pictures of 64 pixels; grows with the size."""


def _mjw():
    _warp()
    import mujoco_warp

    return mujoco_warp


def _warp():
    import warp

    warp.config.log_level = 40  # errors alone: kernels and a missing CUDA driver announce themselves otherwise
    return warp


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence standard error, on which warp's library says that it finds no CUDA driver; a CPU needs none."""
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (OSError, ValueError, AttributeError):  # there is no standard error
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class WarpRenderer(Renderer):
    """Renderer by MuJoCo Warp's ray tracer."""

    name = "warp"

    @classmethod
    def unavailable(cls):
        return None if installed("mujoco_warp") else "mujoco-warp is not installed: pip install mujoco-warp==3.17.0"

    worlds = WORLDS
    """Frames a launch; may be lowered before the first picture, if few frames are painted at a time."""

    def __init__(
        self, task: Task, size: int, *, backgrounds=None, floor_alpha=1.0, device="cpu", samples: int | None = None
    ):
        check_size(size)
        self.task, self.size, self.floor_alpha = task, size, float(floor_alpha)
        self.samples = samples or DEFAULT_SAMPLES
        if self.samples not in PATTERNS:
            raise RenderingError(
                f"{samples} samples a pixel are not offered; give one of {', '.join(map(str, PATTERNS))}"
            )
        self._backgrounds = backgrounds
        wp = _warp()
        try:
            with _quiet() if device == "cpu" else contextlib.nullcontext():
                wp.init()
            self._device = wp.get_device("cuda:0" if device == "cuda" else device)
        except (RuntimeError, ValueError) as error:
            raise RenderingError(f"device {device!r} is not usable ({error}); use --device cpu") from None
        self._kinematics = Kinematics(task, ("geom_xpos", "geom_xmat", "light_xpos", "light_xdir"))
        self._contexts: dict[tuple[int, bool, int], Any] = {}
        self._data: dict[int, Any] = {}
        self._skies: dict[tuple[int, int], Any] = {}
        self._model: Any = None
        self._held: Any = None

    def describe(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "samples": self.samples,
            "floor_alpha": self.floor_alpha,
            "device": "cpu" if self._device.is_cpu else "cuda",
            "texture_texels": self._texels(),
            "mujoco-warp": metadata.version("mujoco-warp"),
            "warp-lang": metadata.version("warp-lang"),
        }

    # -- building -----------------------------------------------------------------------------

    def _texels(self) -> int:
        return TEXTURE_TEXELS * -(-self.size // 64)

    def _sky_width(self) -> int:
        """Texels a side of a sky face: a face spans 90 degrees, about two pictures at 45 degrees of view."""
        return min(2 * self.size, 512)

    @property
    def _mujoco_model(self) -> Any:
        """The task's, with its textures; kept, as the task may let go of it."""
        if self._held is None:
            self._held = self.task.picture_model
        return self._held

    def _build(self) -> None:
        mjw, wp, mjm = _mjw(), _warp(), self._mujoco_model
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(mjm)
            self._textures = [self._texture(i) for i in range(mjm.ntex)]
            self._geom_size = self._model.geom_size
            halved = np.where((mjm.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)[:, None], 0.5, 1.0) * mjm.geom_size
            self._tight_size = wp.array(halved[None].astype(np.float32), dtype=wp.vec3)
        self._floor_materials = np.unique(mjm.geom_matid[mjm.geom_type == 0])
        self._floor_materials = self._floor_materials[self._floor_materials >= 0]

    def _texture(self, index: int):
        """A texture of the model; repeating ones are averaged down, so that far away they do not sparkle."""
        from mujoco_warp._src.render_util import texture_pixels

        pixels = np.asarray(texture_pixels(self._mujoco_model, index))[..., :3]
        is_sky = self._mujoco_model.tex_type[index] == 2
        width = 2 * self._sky_width() if is_sky else self._texels()
        if pixels.shape[1] > width:
            faces = pixels.shape[0] // pixels.shape[1]
            parts = pixels.reshape(faces, -1, *pixels.shape[1:]) if faces > 1 else pixels[None]
            smaller = [Image.fromarray(part).resize((width, width), Image.Resampling.BOX) for part in parts]
            pixels = np.concatenate([np.asarray(part) for part in smaller])
        return self._upload(pixels)

    def _upload(self, pixels: np.ndarray):
        wp = _warp()
        rgba = np.ones((*pixels.shape[:2], 4), np.float32)
        rgba[..., :3] = pixels / np.float32(255)
        with wp.ScopedDevice(self._device):
            return wp.Texture2D(wp.array(rgba, dtype=float), filter_mode=wp.TextureFilterMode.LINEAR)

    def _context(self, camera: int, labels: bool, worlds: int):
        if self._model is None:
            self._build()
        mjw = _mjw()
        if worlds not in self._data:
            with _warp().ScopedDevice(self._device):
                self._data[worlds] = mjw.make_data(self._mujoco_model, nworld=worlds)
        key = camera, labels, worlds
        if key not in self._contexts:
            with _warp().ScopedDevice(self._device):
                context = mjw.create_render_context(
                    self._mujoco_model,
                    nworld=worlds,
                    cam_res=(self.size, self.size * self.samples),  # a block of rows a sample
                    cam_active=[camera],
                    render_rgb=True,
                    render_depth=labels,
                    render_seg=labels,
                    use_textures=False,  # else it uploads all of them in full size, for each context; see _set_sky
                    use_fast_math=False,
                    use_shadows=True,
                    render_skybox=True,
                    shadow_light_fraction=0.0,
                )
                context.use_textures = True
                context.ray.assign(self._rays(float(self._mujoco_model.cam_fovy[camera])))
            self._contexts[key] = context
        return self._contexts[key]

    def _rays(self, fovy: float) -> np.ndarray:
        """(sample * size * size, 3) float32: directions in the camera's frame of all samples of all pixels."""
        row, column = np.mgrid[: self.size, : self.size]
        half, blocks = np.tan(np.radians(fovy) / 2), []
        for right, down in PATTERNS[self.samples]:
            x = (2 * (column + right) / self.size - 1) * half
            y = (1 - 2 * (row + down) / self.size) * half
            direction = np.stack([x, y, -np.ones_like(x)], axis=-1)
            blocks.append((direction / np.linalg.norm(direction, axis=-1, keepdims=True)).reshape(-1, 3))
        return np.concatenate(blocks).astype(np.float32)

    # -- painting -----------------------------------------------------------------------------

    def render(
        self,
        physics: np.ndarray,
        exogenous: DistractorState,
        views: Sequence[str] | None = None,
        hide_goal: bool = False,
    ) -> np.ndarray:
        indices = check_frames(self.task, physics, exogenous, views)
        out = np.empty((len(physics), len(indices), self.size, self.size, 3), np.uint8)
        for part, worlds in self._parts(len(physics)):
            for column, view in enumerate(indices):
                out[part, column] = self._launch(physics[part], exogenous[part], view, hide_goal, worlds)[0]
        return out

    def render_labels(
        self,
        physics: np.ndarray,
        exogenous: DistractorState,
        views: Sequence[str] | None = None,
        hide_goal: bool = False,
    ) -> dict[str, np.ndarray]:
        """Depth (frame, view, size, size) float32 in meters (0: sky) and segmentation int16 (geom id, -1: sky)."""
        indices = check_frames(self.task, physics, exogenous, views)
        depth, segmentation = empty_labels(len(physics), len(indices), self.size)
        for part, worlds in self._parts(len(physics)):
            for column, view in enumerate(indices):
                _, depth[part, column], segmentation[part, column] = self._launch(
                    physics[part], exogenous[part], view, hide_goal, worlds, labels=True
                )
        return {"depth": depth, "segmentation": segmentation}

    def _parts(self, count: int) -> Iterator[tuple[slice, int]]:
        """Frames of each launch, and the size of the launch."""
        few = min(FEW_WORLDS, self.worlds) if self._device.is_cpu else self.worlds  # a GPU paints 256 as fast as 32
        whole = count - count % self.worlds
        if -(-(count - whole) // few) * few >= self.worlds:
            whole = count
        for first in range(0, whole, self.worlds):
            yield slice(first, min(first + self.worlds, count)), self.worlds
        for first in range(whole, count, few):
            yield slice(first, min(first + few, count)), few

    def _launch(self, physics, exogenous, view, hide_goal, worlds, labels=False):
        """Render up to `worlds` frames of one view: pictures, and depth and segmentation if requested."""
        mjw, wp, mjm, count = _mjw(), _warp(), self._mujoco_model, len(physics)
        camera = camera_ids(self.task)[view]
        context = self._context(camera, labels, worlds)
        data = self._data[worlds]
        rows = np.minimum(np.arange(worlds), count - 1)  # unused worlds repeat the last frame
        exogenous = exogenous[rows]
        pose = self._kinematics(physics)

        with wp.ScopedDevice(self._device):

            def put(target, value):
                target.assign(np.ascontiguousarray(value, np.float32))

            put(data.geom_xpos, pose["geom_xpos"][rows])
            put(data.geom_xmat, pose["geom_xmat"][rows].reshape(worlds, -1, 3, 3))
            if mjm.nlight:
                lamps = pose["light_xpos"][rows], pose["light_xdir"][rows]
                if exogenous.light_shift is not None:
                    lamps = moved_lamps(mjm, *lamps, exogenous.light_shift)
                put(data.light_xpos, lamps[0])
                put(data.light_xdir, lamps[1])
            cam_xpos = np.zeros((worlds, mjm.ncam, 3))
            cam_xmat = np.zeros((worlds, mjm.ncam, 3, 3))
            cam_xpos[:, camera] = exogenous.camera_position[:, view]
            cam_xmat[:, camera] = matrices(exogenous.camera_quaternion[:, view].astype(np.float64))
            put(data.cam_xpos, cam_xpos)
            put(data.cam_xmat, cam_xmat)

            rgba = np.empty((worlds, mjm.nmat, 4), np.float32)
            rgba[..., :3] = exogenous.material_rgb
            rgba[..., 3] = np.where(mjm.mat_rgba[:, 3] > 0, 1.0, 0.0)
            self._model.mat_rgba = wp.array(rgba, dtype=wp.vec4)
            self._model.geom_rgba = wp.array(self._geom_rgba(hide_goal), dtype=wp.vec4)
            self._model.geom_matid = wp.array(self._geom_matid(exogenous.style), dtype=int)
            self._set_sky(context, exogenous, worlds)
            # The tracer's boxes around planes are twice as wide as the planes; tight ones are missed by more rays.
            self._model.geom_size = self._tight_size
            mjw.refit_bvh(self._model, data, context)
            self._model.geom_size = self._geom_size
            mjw.render(self._model, data, context)
            picture = self._read(context, count)
            depth = segmentation = None
            if labels:
                shape, pixels = (count, self.size, self.size), self.size**2  # of each pixel's first sample
                depth = context.depth_data.numpy()[:count, :pixels].reshape(shape)
                segmentation = context.seg_data.numpy()[:count, :pixels, 0].reshape(shape).astype(np.int16)
            if self.floor_alpha < 1 and not labels:
                rgba[:, self._floor_materials, 3] = 0
                self._model.mat_rgba = wp.array(rgba, dtype=wp.vec4)
                mjw.render(self._model, data, context)
                through = self._read(context, count)
                picture = self._see_through(picture, through)
        return picture, depth, segmentation

    def _see_through(self, floor: np.ndarray, behind: np.ndarray) -> np.ndarray:
        """Blend the pictures with an opaque floor and without a floor.

        OpenGL draws a reflective plane twice, once darkened by its reflectance: the weights follow from that
        (and agree with a regression of OpenGL's pixels on the two pictures).
        """
        alpha = self.floor_alpha
        reflectance = float(self._mujoco_model.mat_reflectance[self._floor_materials].max(initial=0.0))
        if reflectance:
            weights = alpha * (1 - reflectance) + alpha * (1 - alpha), (1 - alpha) ** 2
        else:
            weights = alpha, 1 - alpha
        blend = np.rint(np.float32(weights[0]) * floor + np.float32(weights[1]) * behind).astype(np.uint8)
        return np.where((floor != behind).any(axis=-1, keepdims=True), blend, floor)

    def _read(self, context, count: int) -> np.ndarray:
        packed = context.rgb_data.numpy()[:count].view(np.uint8)
        samples = packed.reshape(count, self.samples, self.size, self.size, 4)[..., 2::-1]
        if self.samples == 1:
            return samples[:, 0].copy()
        # The tracer cuts fractions off, half a level a sample on average: add that half before the mean is cut.
        total = samples.sum(axis=1, dtype=np.uint16) + np.uint16(self.samples // 2)
        return np.minimum(total // self.samples, 255).astype(np.uint8)

    def _geom_rgba(self, hide_goal: bool) -> np.ndarray:
        rgba = np.array(self._mujoco_model.geom_rgba, np.float32)
        if hide_goal:
            rgba[list(self.task.goal_geoms)] = 0
        return rgba[None]

    def _geom_matid(self, style: np.ndarray) -> np.ndarray:
        looks, place = np.unique(style, return_inverse=True)
        found = np.stack([geom_materials(self.task, int(look)) for look in looks])
        return found if len(looks) == 1 else found[place]

    def _set_sky(self, context, exogenous: DistractorState, worlds: int) -> None:
        """Each world's sky: the model's own, or a video frame on every face."""
        wp, mjm = _warp(), self._mujoco_model
        skies = np.flatnonzero(mjm.tex_type == 2)
        own = int(skies[0]) if len(skies) else -1
        textures, index = list(self._textures), np.full(worlds, own)
        keys = {}
        for world, key in enumerate(zip(exogenous.background_video, exogenous.background_frame, strict=True)):
            if key[0] < 0:
                continue
            if key not in keys:
                keys[key] = len(textures)
                textures.append(self._sky(*map(int, key)))
            index[world] = keys[key]
        context.textures_registry = textures  # keeps them alive
        context.textures = wp.array(textures, dtype=wp.Texture2D)
        context.skybox_tex_id = wp.array(index, dtype=int)
        widths = [texture.width for texture in textures]
        context.skybox_face_width = wp.array(np.array([widths[i] if i >= 0 else 1 for i in index]), dtype=int)

    def _sky(self, video: int, frame: int):
        if (video, frame) not in self._skies:
            if len(self._skies) > 256:
                self._skies.clear()
            picture = self.background(video, frame, self._sky_width(), Image.Resampling.BOX)
            self._skies[video, frame] = self._upload(np.tile(picture, (6, 1, 1)))
        return self._skies[video, frame]

    def close(self) -> None:
        self._contexts.clear()
        self._skies.clear()
        self._data.clear()
        self._model = self._held = None


RENDERER = WarpRenderer
