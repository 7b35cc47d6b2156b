"""A task's model in, arrays of what a picture can show out: geoms, lights, materials by look."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from dmcvb_gen.errors import RenderingError
from dmcvb_gen.tasks.base import Task

PLANE, SPHERE, CAPSULE = 0, 2, 3
"""MuJoCo's numbers of the kinds of geoms painted here."""
OPAQUE = 0.995
"""OpenGL's border between opaque and blended, as MuJoCo draws it."""
MAX_GEOMS = 250
"""Geoms are numbered in a byte a sample; the sky takes one number more."""
SHOWN_GROUPS = 3
"""MuJoCo shows the geom groups 0, 1 and 2."""
SKY_DISTANCE = 0.7
"""MuJoCo draws the sky on an upright cylinder around the eye, of this share of the largest depth."""
_OWN_COLOR = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""A geom of this color takes its material's."""
_MAX_GRID = 200
"""Lines of the grid of vertices that MuJoCo draws a plane with, at most."""


@dataclass(frozen=True)
class Look:
    """What the geoms of a scene are covered with, one visual look.

    Attributes:
      material: (geom,) int64, the material that gives the geom's color; -1: its own color.
      color: (geom, 4) float64, the color where there is no material, and always the opacity.
      texture: (geom,) int32; -1: none.
      repeat: (geom, 2) float64, texture coordinates for each meter (planes).
      shine: (geom, 2) float64, specular share and exponent.
    """

    material: np.ndarray
    color: np.ndarray
    texture: np.ndarray
    repeat: np.ndarray
    shine: np.ndarray


@dataclass(frozen=True)
class Scene:
    """What never changes from frame to frame, geoms in the model's order.

    Attributes:
      geoms: (geom,) int64, the model's geoms that can be seen.
      kind: (geom,) int64, PLANE, SPHERE or CAPSULE.
      size: (geom, 3) float64, meters, half lengths as MuJoCo's.
      moving: (geom,) bool; the others never move.
      goal: (geom,) bool, left out of the hidden-goal pictures.
      mirror: the geom that mirrors (the first reflective plane), or -1.
      reflectance: of that plane.
      headlight: (9,) float64, ambient, diffuse and specular RGB; zeros when off.
      spot: (9,) float64, the same of the one lamp; zeros without one.
      lamp: index of the lamp in the model, -1 without one.
      cone: (3,) float64, cosine of the lamp's cut-off angle, its exponent, tangent of the shadow map's half angle.
      grid: (2, line) float64, coordinates in the lit plane's frame of the vertices that it is drawn with.
      lines: (2,) int64, how many there are along each axis.
      boxes: (box, 6) float64, lowest and highest corner of the solid boxes behind walls (not drawn themselves).
      sky: texture of the sky, or -1.
      near, far: depths between which things are drawn, meters.
      horizon: how far from the eye, in the world's horizontal plane, the sky hides what is beyond, meters.
    """

    geoms: np.ndarray
    kind: np.ndarray
    size: np.ndarray
    moving: np.ndarray
    goal: np.ndarray
    mirror: int
    reflectance: float
    headlight: np.ndarray
    spot: np.ndarray
    lamp: int
    cone: np.ndarray
    grid: np.ndarray
    lines: np.ndarray
    boxes: np.ndarray
    sky: int
    near: float
    far: float
    horizon: float


def scene_of(task: Task) -> Scene:
    """The scene of a task.

    Raises:
      RenderingError: the model has what this painter does not paint.
    """
    model = task.picture_model
    alpha = np.where(
        (model.geom_matid >= 0) & (model.geom_rgba == _OWN_COLOR).all(axis=1),
        model.mat_rgba[model.geom_matid, 3] if model.nmat else 1.0,
        model.geom_rgba[:, 3],
    )
    geoms = np.flatnonzero((alpha > 0) & (model.geom_group < SHOWN_GROUPS))
    kind = model.geom_type[geoms].astype(np.int64)
    _refuse_what_is_not_painted(task, geoms, kind, alpha)
    shiny = model.mat_reflectance[model.geom_matid[geoms]] * (model.geom_matid[geoms] >= 0) * (kind == PLANE)
    mirror = int(np.flatnonzero(shiny)[0]) if shiny.any() else -1
    lamp = int(np.flatnonzero(model.light_active)[0]) if np.any(model.light_active) else -1
    grid, lines = _vertices(model, geoms[kind == PLANE]) if lamp >= 0 else (np.zeros((2, 2)), np.zeros(2, np.int64))
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    return Scene(
        geoms=geoms,
        kind=kind,
        size=np.array(model.geom_size[geoms], np.float64),
        moving=(model.body_weldid[model.geom_bodyid[geoms]] != 0) | (model.body_mocapid[model.geom_bodyid[geoms]] >= 0),
        goal=np.isin(geoms, task.goal_geoms),
        mirror=mirror,
        reflectance=float(shiny[mirror]) if mirror >= 0 else 0.0,
        headlight=_headlight(model),
        spot=_light(model, lamp),
        lamp=lamp,
        cone=_cone(model, lamp),
        grid=grid,
        lines=lines,
        boxes=_boxes(model),
        sky=int(skies[0]) if len(skies) else -1,
        near=float(model.vis.map.znear * model.stat.extent),
        far=float(model.vis.map.zfar * model.stat.extent),
        horizon=SKY_DISTANCE * float(model.vis.map.zfar * model.stat.extent) if len(skies) else 1e9,
    )


def look_of(task: Task, scene: Scene, style: int, floor_alpha: float) -> Look:
    """The look of a style label (-1: the model's own materials).

    Args:
      floor_alpha: opacity of the planes whose material is their own (below 1: the floor is seen through).
    """
    model, geoms = task.picture_model, scene.geoms
    chosen = task.style_geom_matid(style) if style >= 0 else None
    material = np.array(model.geom_matid if chosen is None else chosen)[geoms].astype(np.int64)
    own = (model.geom_rgba[geoms] != _OWN_COLOR).any(axis=1) | (material < 0)
    color = np.where(own[:, None], model.geom_rgba[geoms], model.mat_rgba[material]).astype(np.float64)
    color[(scene.kind == PLANE) & ~own & (floor_alpha < 1), 3] = floor_alpha
    texture = np.where(material >= 0, model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB], -1)
    uniform = model.mat_texuniform[material].astype(bool)[:, None]
    shine = np.stack([model.mat_specular[material], np.rint(128.0 * model.mat_shininess[material])], axis=1)
    shine[material < 0] = 0.5, 64.0  # MuJoCo's defaults of a geom without a material
    scale = np.where(uniform, 1.0, 1.0 / np.maximum(scene.size[:, :2], 1e-9))
    return Look(
        material=np.where(own, -1, material),
        color=color,
        texture=texture.astype(np.int32),
        repeat=0.5 * model.mat_texrepeat[material] * scale,
        shine=shine.astype(np.float64),
    )


def _refuse_what_is_not_painted(task: Task, geoms: np.ndarray, kind: np.ndarray, alpha: np.ndarray) -> None:
    model = task.model
    materials = np.unique(model.geom_matid[geoms])
    materials = materials[materials >= 0]
    lights = np.flatnonzero(model.light_active)
    faults = {
        "geoms other than planes, spheres and capsules": not np.isin(kind, (PLANE, SPHERE, CAPSULE)).all(),
        f"more than {MAX_GEOMS} geoms": len(geoms) > MAX_GEOMS,
        "transparent bodies": bool((alpha[geoms][kind != PLANE] < 1).any()),
        "infinite planes": bool((model.geom_size[geoms][kind == PLANE][:, :2] <= 0).any()),
        "luminous materials": bool(model.mat_emission[materials].any()),
        "several lamps": len(lights) > 1,
        "several planes under a lamp": len(lights) > 0 and int((kind == PLANE).sum()) > 1,
        "a lamp that is no spot light with whole exponent and without attenuation": any(
            model.light_type[i] != mujoco.mjtLightType.mjLIGHT_SPOT
            or model.light_exponent[i] % 1
            or not np.array_equal(model.light_attenuation[i], (1, 0, 0))
            for i in lights
        ),
    }
    for what, there in faults.items():
        if there:
            raise RenderingError(f"{task.id} has {what}, which 'native' does not paint; use --renderer warp")


def _headlight(model: mujoco.MjModel) -> np.ndarray:
    light = model.vis.headlight
    return np.concatenate([light.ambient, light.diffuse, light.specular]).astype(np.float64) * bool(light.active)


def _light(model: mujoco.MjModel, lamp: int) -> np.ndarray:
    if lamp < 0:
        return np.zeros(9)
    parts = model.light_ambient[lamp], model.light_diffuse[lamp], model.light_specular[lamp]
    return np.concatenate(parts).astype(np.float64)


def _cone(model: mujoco.MjModel, lamp: int) -> np.ndarray:
    if lamp < 0:
        return np.zeros(3)
    cutoff = float(model.light_cutoff[lamp])
    shadow = min(2 * cutoff * float(model.vis.map.shadowscale), 160.0) / 2
    casts = bool(model.light_castshadow[lamp])
    angles = np.radians([cutoff, shadow])
    return np.array([np.cos(angles[0]), float(model.light_exponent[lamp]), np.tan(angles[1]) * casts])


def _vertices(model: mujoco.MjModel, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where MuJoCo puts the vertices of the lit plane: OpenGL computes light there and blends between them."""
    if not len(planes):
        return np.zeros((2, 2)), np.zeros(2, np.int64)
    size = model.geom_size[planes[0]].astype(np.float64)
    axes = []
    for half in size[:2]:
        step = max(size[2], half / (_MAX_GRID - 2))
        count = int(np.floor(half / step))
        count -= count % 2
        pad = half - count * step
        inner = -half + pad + 2 * step * np.arange(count + 1)
        axes.append(np.concatenate([[-half], inner, [inner[-1] + pad]]))
    grid = np.zeros((2, max(map(len, axes))))
    for row, axis in zip(grid, axes, strict=True):
        row[: len(axis)] = axis
    return grid, np.array([len(axis) for axis in axes], np.int64)


def _boxes(model: mujoco.MjModel) -> np.ndarray:
    """The world's unturned boxes (lowest and highest corner), whose faces are drawn as planes."""
    fixed = (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX) & (model.body_weldid[model.geom_bodyid] == 0)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    unturned = np.isclose(np.abs(data.geom_xmat.reshape(-1, 3, 3)), np.eye(3)).all(axis=(1, 2))
    found = np.flatnonzero(fixed & unturned)
    return np.concatenate(
        [data.geom_xpos[found] - model.geom_size[found], data.geom_xpos[found] + model.geom_size[found]], axis=1
    ).astype(np.float64)
