"""Turn a task's model into arrays of what a picture can show: geoms, lights, materials of each look."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import mujoco
import numpy as np

from dmcvb_gen.errors import RenderingError
from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import camera_ids

_PAINTED = PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = 0, 2, 3, 4, 5, 6
"""MuJoCo's numbers of the kinds of geoms painted here."""
SUN_DISTANCE = 25.0
"""A directional light is a lamp so far away, times the model's extent."""
OPAQUE = 0.995
"""OpenGL's border between opaque and blended, as MuJoCo draws it."""
MAX_GEOMS = 250
"""Geoms are numbered in a byte a sample; the sky takes one number more."""
SHOWN_GROUPS = 3
"""MuJoCo shows the geom groups 0, 1 and 2."""
SKY_DISTANCE = 0.7
"""MuJoCo draws the sky on an upright cylinder around the eye, of this share of the largest depth."""
LOOKS = (
    *(f"geom_{name}" for name in ("type", "size", "rgba", "matid", "group", "dataid")),
    *(f"site_{name}" for name in ("type", "size", "rgba", "matid", "group")),
    *(f"tendon_{name}" for name in ("width", "rgba", "matid", "group")),
    *(f"cam_{name}" for name in ("fovy", "projection", "sensorsize", "intrinsic")),
    *(f"light_{name}" for name in ("type", "active", "castshadow", "cutoff", "exponent", "attenuation")),
    *(f"light_{name}" for name in ("ambient", "diffuse", "specular", "bulbradius", "intensity", "range")),
    *("mat_", "vis.", "stat."),
)
"""Beginnings of the names of the model's fields that are read once, so that no episode may have its own."""
_OWN_COLOR = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""A geom of this color takes its material's."""
_MAX_GRID = 200
"""Lines of the grid of vertices that MuJoCo draws a plane with, at most."""


@dataclass(frozen=True)
class Scene:
    """Constant part of a scene: geoms in the model's order, then sites, then pieces of tendons.

    Attributes:
      geoms: (geom,) int64, the model's geoms that can be seen; -1 for sites and pieces of tendons.
      sites: the model's sites that can be seen.
      cords: (piece, 2) int64, the sites at the ends of the pieces of tendons.
      rec: (geom, column) float64, the first columns of `layout`'s `rec`; those of a look are 0.
      material: (geom,) int64, of the model's own look; -1: none.
      rgba: (geom, 4) float32, the model's own colors without materials.
      lamps: indices of the lamps in the model.
      shine: (lamp, 12) float64, of each lamp ambient, diffuse and specular RGB, then the cosine of its cut-off angle,
        its exponent, and the tangent of its shadow map's half angle; one row of zeros without a lamp.
      grid: (2, line) float64, coordinates of the vertices that the plane is drawn with that is lit there, in its frame.
      boxes: (box, 6) float64, lowest and highest corner of the solid boxes behind walls (not drawn themselves).
      sky: texture of the sky, or -1.
      constants: float64, the first entries of `layout`'s `k`; STEP is 0, as it differs between views.
    """

    geoms: np.ndarray
    sites: np.ndarray
    cords: np.ndarray
    rec: np.ndarray
    material: np.ndarray
    rgba: np.ndarray
    lamps: np.ndarray
    shine: np.ndarray
    grid: np.ndarray
    boxes: np.ndarray
    sky: int
    constants: np.ndarray


def scene_of(task: Task) -> Scene:
    """The scene of a task.

    Raises:
      RenderingError: the model has what this painter does not paint.
    """
    model = task.picture_model
    geoms, sites, cords = _shown(model.geom_group), _shown(model.site_group), _cords(task, model)
    tendons, ends = cords[:, 0], cords[:, 1:]
    material = np.concatenate([model.geom_matid[geoms], model.site_matid[sites], model.tendon_matid[tendons]])
    rgba = np.concatenate([model.geom_rgba[geoms], model.site_rgba[sites], model.tendon_rgba[tendons]])
    kind = np.concatenate([model.geom_type[geoms], model.site_type[sites], np.full(len(cords), CAPSULE)])
    width = np.stack([model.tendon_width[tendons], np.ones(len(cords)), np.ones(len(cords))], axis=1)
    size = np.concatenate([model.geom_size[geoms], model.site_size[sites], width]).astype(np.float64)
    by_material = (material >= 0) & (rgba == _OWN_COLOR).all(axis=1)
    alpha = np.where(by_material, _of_materials(model.mat_rgba, material)[:, 3], rgba[:, 3])
    seen = np.flatnonzero(alpha > 0)
    numbers = np.concatenate([geoms, np.full(len(sites) + len(cords), -1)])
    bodies = np.concatenate([model.geom_bodyid[geoms], model.site_bodyid[sites]])
    moving = (model.body_weldid[bodies] != 0) | (model.body_mocapid[bodies] >= 0)
    moving = np.concatenate([moving, np.ones(len(cords), bool)])
    geoms, kind, size = numbers[seen], kind[seen], size[seen]
    material, rgba = material[seen], rgba[seen]
    first, second = len(numbers) - len(sites) - len(cords), len(numbers) - len(cords)
    sites, ends = sites[seen[(seen >= first) & (seen < second)] - first], ends[seen[seen >= second] - second]
    _refuse_what_is_not_painted(task, material, kind, size, alpha[seen])
    shiny = _of_materials(model.mat_reflectance, material) * (kind == PLANE) * (material >= 0)
    mirror = np.flatnonzero(shiny)[:1]  # the first reflective plane
    lamps, boxes = np.flatnonzero(model.light_active), _boxes(model)
    grid, lines = np.zeros((2, 2)), np.zeros(2, np.int64)
    rec = np.zeros((len(geoms), L.RGB + 3))
    planes = np.flatnonzero(kind == PLANE)
    if len(planes) and len(lamps):  # the largest plane is lit at its vertices
        gridded = planes[np.argmax(size[planes, 0] * size[planes, 1])]
        grid, lines = _vertices(size[gridded])
        rec[gridded, L.GRIDDED] = 1
    rec[:, L.KIND], rec[:, L.SIZE : L.SIZE + 3], rec[:, L.BALL] = kind, size, _ball_radius(kind, size)
    rec[kind == CYLINDER, L.SIZE + 1 : L.SIZE + 3] = size[kind == CYLINDER, :2]  # a radius, half a length
    rec[:, L.GOAL], rec[:, L.BOXED] = np.isin(geoms, task.goal_geoms), _boxed(model, geoms, boxes) & (kind == PLANE)
    rec[:, L.MOVING] = moving[seen] | bool(task.model_entries)
    rec[:, L.CORD] = np.arange(len(rec)) >= len(rec) - len(ends)
    shine = [_shine(model, lamp) for lamp in lamps] or [np.zeros(12)]
    near, far = model.vis.map.znear * model.stat.extent, model.vis.map.zfar * model.stat.extent
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    constants = np.zeros(L.HORIZON + 1)
    constants[L.NEAR], constants[L.FAR], constants[L.HORIZON] = near, far, SKY_DISTANCE * far if len(skies) else 1e9
    constants[L.MIRROR], constants[L.REFLECTANCE] = (mirror[0], shiny[mirror[0]]) if len(mirror) else (-1, 0)
    headlight = np.concatenate([model.vis.headlight.ambient, model.vis.headlight.diffuse, model.vis.headlight.specular])
    constants[L.HEADLIGHT : L.SPOT] = headlight * bool(model.vis.headlight.active)
    constants[L.SPOT : L.LINES] = shine[0]
    constants[L.LINES : L.GRID], constants[L.GRID] = lines, grid.shape[1]
    return Scene(
        geoms=geoms,
        sites=sites,
        cords=ends,
        rec=rec,
        material=material.astype(np.int64),
        rgba=rgba,
        lamps=lamps,
        shine=np.array(shine),
        grid=grid,
        boxes=boxes,
        sky=int(skies[0]) if len(skies) else -1,
        constants=constants,
    )


def records_of(task: Task, scene: Scene, style: int, floor_alpha: float) -> np.ndarray:
    """(geom, column) float64: the first columns of `layout`'s `rec` under a style label (-1: the model's own look).

    Args:
      floor_alpha: opacity of the planes whose material is their own (below 1: the floor is seen through).
    """
    model, material, rec = task.picture_model, scene.material.copy(), scene.rec.copy()
    chosen = task.style_geom_matid(style) if style >= 0 else None
    if chosen is not None:
        material[scene.geoms >= 0] = chosen[scene.geoms[scene.geoms >= 0]]
    own = (scene.rgba != _OWN_COLOR).any(axis=1) | (material < 0)
    color = np.where(own[:, None], scene.rgba, _of_materials(model.mat_rgba, material)).astype(np.float64)
    textures = _of_materials(model.mat_texid, material)[:, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    texture = np.where(material >= 0, textures, -1)
    color[(rec[:, L.KIND] == PLANE) & ~own & (texture >= 0) & (floor_alpha < 1), 3] = floor_alpha
    uniform = _of_materials(model.mat_texuniform, material).astype(bool)[:, None]
    shininess = np.rint(128.0 * _of_materials(model.mat_shininess, material))
    shine = np.stack([_of_materials(model.mat_specular, material), shininess], axis=1)
    shine[material < 0] = 0.5, 64.0  # MuJoCo's defaults of a geom without a material
    scale = np.where(uniform, 1.0, 1.0 / np.maximum(rec[:, L.SIZE : L.SIZE + 2], 1e-9))
    rec[:, L.MATERIAL], rec[:, L.OWN_OPACITY] = np.where(own, -1, material), color[:, 3]
    rec[:, L.TEXTURE] = texture
    rec[:, L.REPEAT : L.REPEAT + 2] = 0.5 * _of_materials(model.mat_texrepeat, material) * scale
    rec[:, L.SHARE], rec[:, L.EXPONENT] = shine.T
    rec[:, L.RGB : L.RGB + 3] = color[:, :3]
    return rec


def _ball_radius(kind: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(geom,) meters: of the ball around a body (around the end of a capsule)."""
    reach = {
        ELLIPSOID: size.max(axis=1),
        CYLINDER: np.hypot(size[:, 0], size[:, 1]),
        BOX: np.sqrt((size**2).sum(axis=1)),
    }
    return np.select([kind == each for each in reach], list(reach.values()), size[:, 0])


def _boxed(model: mujoco.MjModel, geoms: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(geom,) bool: those whose place is in a box or on a side of it."""
    place = np.where(geoms[:, None] >= 0, model.geom_pos[geoms], np.inf)[:, None]
    touching = (boxes[None, :, :3] - 1e-6 <= place) & (place <= boxes[None, :, 3:] + 1e-6)
    return touching.all(axis=2).any(axis=1)


def _shown(groups: np.ndarray) -> np.ndarray:
    return np.flatnonzero(groups < SHOWN_GROUPS)


def _of_materials(values: np.ndarray, material: np.ndarray) -> np.ndarray:
    """A field of the materials for each of `material`; zeros in a model that has none."""
    return values[material] if len(values) else np.zeros((len(material), *values.shape[1:]), values.dtype)


def _cords(task: Task, model: mujoco.MjModel) -> np.ndarray:
    """(piece, 3) int64 of the pieces of tendons that are drawn: tendon, and the sites at both ends.

    Raises:
      RenderingError: a tendon that is wrapped around a geom.
    """
    out = []
    for tendon in _shown(model.tendon_group).tolist():
        wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        kinds = model.wrap_type[wraps]
        if (kinds == mujoco.mjtWrap.mjWRAP_JOINT).any() or model.tendon_width[tendon] <= 0:
            continue  # it has no place in space
        if (kinds != mujoco.mjtWrap.mjWRAP_SITE).any():
            raise _not_painted(task, "tendons wrapped around geoms")
        sites = model.wrap_objid[wraps].tolist()
        out += [(tendon, *ends) for ends in itertools.pairwise(sites)]
    return np.array(out, np.int64).reshape(-1, 3)


def _not_painted(task: Task, what: str) -> RenderingError:
    return RenderingError(f"{task.id} has {what}, which 'native' does not paint; use --renderer opengl")


def _refuse_what_is_not_painted(
    task: Task, material: np.ndarray, kind: np.ndarray, size: np.ndarray, alpha: np.ndarray
) -> None:
    model, cameras = task.model, camera_ids(task)
    materials = np.unique(material[material >= 0])
    lights = np.flatnonzero(model.light_active)
    others = [mujoco.mjtGeom(number).name[7:].lower() for number in sorted({*kind.tolist()} - {*_PAINTED})]
    textures = _of_materials(model.mat_texid, material)[:, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    textures = np.where(material >= 0, textures, -1)
    textured, types = kind[textures >= 0], model.tex_type[textures[textures >= 0]]
    fitting = np.where(textured == PLANE, mujoco.mjtTexture.mjTEXTURE_2D, mujoco.mjtTexture.mjTEXTURE_CUBE)
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    channels = model.tex_nchannel[np.concatenate([textures[textures >= 0], skies])]
    changed = [name for name in task.model_entries if name.startswith(LOOKS)]
    faults = {
        f"geoms of type {', '.join(others)}": bool(others),
        "a skin": model.nskin > 0,
        "a flex": model.nflex > 0,
        f"{', '.join(changed)} of its own in each episode": bool(changed),
        "a texture that is neither a picture on a plane nor a cube on a ball": bool(
            (types != fitting).any() or not np.isin(textured, [PLANE, SPHERE, ELLIPSOID]).all()
        ),
        "a texture that is not RGB": bool((channels != 3).any()),
        "mirrors that are no planes": bool(
            _of_materials(model.mat_reflectance, material)[(kind != PLANE) & (material >= 0)].any()
        ),
        "an orthographic camera, or one with a sensor's size": bool(
            (model.cam_projection[cameras] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE).any()
            or model.cam_sensorsize[cameras].any()
        ),
        "a spot lamp wider than 90 degrees": bool(
            ((model.light_type == mujoco.mjtLightType.mjLIGHT_SPOT) & (model.light_cutoff >= 90))[lights].any()
        ),
        f"more than {MAX_GEOMS} geoms": len(kind) > MAX_GEOMS,
        "transparent bodies": bool((alpha[kind != PLANE] < 1).any()),
        "infinite planes": bool((size[kind == PLANE][:, :2] <= 0).any()),
        "luminous materials": bool(model.mat_emission[materials].any()),
        "a spot light without whole exponent or with attenuation": any(
            model.light_type[i] == mujoco.mjtLightType.mjLIGHT_SPOT
            and (model.light_exponent[i] % 1 or not np.array_equal(model.light_attenuation[i], (1, 0, 0)))
            for i in lights
        ),
        "a lamp that is neither a spot light nor directional": bool((model.light_type[lights] > 1).any()),
    }
    for what, there in faults.items():
        if there:
            raise _not_painted(task, what)


def _shine(model: mujoco.MjModel, lamp: int) -> np.ndarray:
    """A row of `Scene.shine`."""
    casts = bool(model.light_castshadow[lamp])
    if model.light_type[lamp] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
        cone = [1e-6, 0.0, float(model.vis.map.shadowclip) / SUN_DISTANCE * casts]
    else:
        cutoff = float(model.light_cutoff[lamp])
        shadow = min(2 * cutoff * float(model.vis.map.shadowscale), 160.0) / 2
        angles = np.radians([cutoff, shadow])
        cone = [np.cos(angles[0]), float(model.light_exponent[lamp]), np.tan(angles[1]) * casts]
    return np.concatenate([model.light_ambient[lamp], model.light_diffuse[lamp], model.light_specular[lamp], cone])


def _vertices(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return MuJoCo's vertices of a plane: OpenGL computes light there and blends between them.

    Args:
      size: (3,) of the plane.
    """
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
