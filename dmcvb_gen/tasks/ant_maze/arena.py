"""The ant in its maze as one MuJoCo model, from dm_control's locomotion library and labmaze's textures.

All visual looks are in the model: a look changes only which material a geom has. The goal's sphere is a
mocap body, so that each episode of a batch puts it elsewhere.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

import mujoco
import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.tasks.ant_maze.layouts import CELL, Layout
from dmcvb_gen.tasks.suite import import_quietly

WALL_HEIGHT = 2.0
"""Meters."""
GOAL_RADIUS, GOAL_HEIGHT = 0.5, 1.0
"""Meters; the height is that of the sphere's center."""
TOP_HEIGHT = 100.0
"""Meters of the top camera above the floor."""
PHYSICS_STEP = 0.001
ACTIONS = 8
"""The ant's actuators."""
SKY = "sky_02"
STYLES = {"train": (2, 3, 4, 5), "val": (1,)}
"""Labmaze's styles of data and of evaluation (paper, section 3.1: unseen distractors)."""
CAMERAS = {
    "top": "top_camera",
    "egocentric": "walker/egocentric",
    "follow": "walker/follow",
    "overhead": "walker/overhead",
}
"""View -> camera of the model."""


@dataclass(frozen=True)
class Arena:
    """A layout's model.

    Attributes:
      model: compiled, without textures; shared, never changed.
      source, assets: what `textured_model` compiles: XML, and file -> bytes.
      looks: look -> (geom,) int, the material of every geom; a look is style * 100 + wall texture * 10 + floor texture.
      goal_geom: index of the goal's sphere.
    """

    model: mujoco.MjModel
    source: str
    assets: dict[str, bytes]
    looks: dict[int, np.ndarray]
    goal_geom: int


@functools.cache
def textures(style: int) -> dict[str, tuple[str, ...]]:
    """The files of all "wall" and all "floor" textures of a labmaze style, in the order of their names."""
    from labmaze import assets

    finders = {"wall": assets.get_wall_texture_paths, "floor": assets.get_floor_texture_paths}
    found = {kind: sorted(find(f"style_{style:02}").items()) for kind, find in finders.items()}
    return {kind: tuple(path for _, path in paths) for kind, paths in found.items()}


def look_numbers(style: int) -> tuple[int, ...]:
    """All looks of a style: every wall texture with every floor texture."""
    walls, floors = (len(paths) for paths in textures(style).values())  # 8 of each at most
    return tuple(style * 100 + wall * 10 + floor for wall in range(walls) for floor in range(floors))


@functools.lru_cache(maxsize=2)  # each holds 200 MB
def textured_model(layout: Layout) -> mujoco.MjModel:
    """The model of a layout's arena with all its textures, equal in everything else; for painters."""
    arena = build_arena(layout)
    return mujoco.MjModel.from_xml_string(arena.source, arena.assets)


@functools.lru_cache(maxsize=32)
def build_arena(layout: Layout) -> Arena:
    """The arena of a layout, with the ant and the goal."""
    import labmaze

    modules = ("arenas.labmaze_textures", "arenas.mazes", "props.target_sphere", "walkers.ant")
    labmaze_textures, mazes, target_sphere, ant = (import_quietly(f"locomotion.{module}") for module in modules)
    maze = labmaze.FixedMazeWithRandomGoals(entity_layer=layout.entity_layer, num_spawns=1, num_objects=1)
    arena = mazes.MazeWithTargets(
        maze=maze, xy_scale=CELL, z_height=WALL_HEIGHT, skybox_texture=labmaze_textures.SkyBox(SKY)
    )
    arena.regenerate()
    walker = ant.Ant()
    walker.create_root_joints(arena.attach(walker))
    observables = walker.observables
    _ = observables.bodies_pos, observables.bodies_quats, observables.end_effectors_pos  # each adds its sensors
    for sensor in walker.mjcf_model.sensor.get_children("rangefinder"):
        sensor.remove()  # costly rays that no state holds
    frame = walker.mjcf_model.worldbody  # the root frame, below the torso; forward is to the right in both pictures
    frame.add("camera", name="follow", pos=[-1, 0, 2], zaxis=[-1, 0, 2])
    frame.add("camera", name="overhead", pos=[0, 0, 3])
    half = max(layout.shape) * CELL / 2
    arena.top_camera.set_attributes(
        pos=[0, 0, TOP_HEIGHT], fovy=np.degrees(2 * float(arithmetic.arctan2(half, TOP_HEIGHT)))
    )
    goal = target_sphere.TargetSphere(radius=GOAL_RADIUS, height_above_ground=GOAL_HEIGHT)
    arena.attach(goal).mocap = "true"

    root = arena.mjcf_model
    root.option.timestep = PHYSICS_STEP
    repeats: dict[str, tuple] = {}
    for geom in root.worldbody.geom:
        if geom.material is not None and (face := re.match("wall|floor", geom.name)):
            repeats[geom.name] = (face[0], *np.round(geom.material.texrepeat, 6).tolist())
    for geom in root.find("body", "maze_body").geom:
        geom.rgba = [0, 0, 0, 0]  # their faces are drawn by textured planes
    names: dict[tuple, str] = {}
    styles = sorted(sum(STYLES.values(), ()))
    for style in styles:
        for kind, paths in textures(style).items():
            for number, path in enumerate(paths):
                texture = root.asset.add("texture", type="2d", name=f"{kind}_{style}_{number}", file=path)
                for repeat in sorted({value for value in repeats.values() if value[0] == kind}):
                    name = f"look_{kind}_{style}_{number}_{len(names)}"
                    root.asset.add("material", name=name, texture=texture, texrepeat=repeat[1:])
                    names[repeat, style, number] = name

    source, assets = root.to_xml_string(), root.get_assets()
    spec = mujoco.MjSpec.from_string(source, assets=assets)
    # Without textures a simulation's copy takes 0.1 MB, not 200.
    for texture in list(spec.textures):
        spec.delete(texture)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    model = spec.compile()
    looks = {}
    for style in styles:
        for look in look_numbers(style):
            materials = np.array(model.geom_matid)
            for geom, repeat in repeats.items():
                number = look // 10 % 10 if repeat[0] == "wall" else look % 10
                materials[model.geom(geom).id] = model.mat(names[repeat, style, number]).id
            looks[look] = materials
    return Arena(model, source, assets, looks, model.geom("target/geom").id)
