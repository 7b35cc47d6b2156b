"""Make clips of objects that fall and collide, like Kubric's MOVi-D, from a seed.

Each clip is a MuJoCo simulation of its own: 13 to 23 objects of many shapes with procedural textures, some
lying in a heap, some thrown into it one after another, filmed by a fixed camera for 24 frames of 256 x 256.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from dmcvb_gen.distractors.backgrounds import FRAME_SIZE
from dmcvb_gen.distractors.textures import FLOORS, surroundings, texture
from dmcvb_gen.errors import BackgroundError
from dmcvb_gen.files import replacing, write_text
from dmcvb_gen.spec import SPLITS
from dmcvb_gen.storage.remote import local_path

GENERATOR = 2
"""Version of what a seed means; clips of another version or seed are not mixed."""
FRAMES, FRAMES_PER_SECOND = 24, 12
SETTLING = 0.8
"""Seconds that the heap has to come to rest before the film begins."""
QUALITY = 72
"""WebP quality of the files."""


def _numbers(values) -> str:
    return " ".join(f"{value:.5g}" for value in np.ravel(values))


def _png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def _revolution(rng: np.random.Generator, size: float) -> str:
    """Vertices and faces of a vase: a random profile turned around its axis."""
    rings, sides = 9, 18
    profile = np.interp(np.linspace(0, 1, rings), np.linspace(0, 1, 5), rng.uniform(0.25, 1, 5)) * size
    height = np.linspace(-1, 1, rings) * size * rng.uniform(0.8, 1.8)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    side = np.stack([np.outer(profile, np.cos(angle)), np.outer(profile, np.sin(angle))], -1)
    points = np.concatenate([side, np.broadcast_to(height[:, None, None], (rings, sides, 1))], -1).reshape(-1, 3)
    points = np.concatenate([points, [[0, 0, height[0]], [0, 0, height[-1]]]])
    faces = []
    for ring in range(rings - 1):
        for k in range(sides):
            a, b = ring * sides + k, ring * sides + (k + 1) % sides
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    for k in range(sides):
        a, b = k, (k + 1) % sides
        last = (rings - 1) * sides
        faces += [[rings * sides, b, a], [rings * sides + 1, last + a, last + b]]
    return f'vertex="{_numbers(points)}" face="{" ".join(map(str, np.ravel(faces)))}"'


def _torus(rng: np.random.Generator, size: float) -> str:
    around, tube = 24, 10
    thick = rng.uniform(0.2, 0.42)
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(tube) * 2 * np.pi / tube, indexing="ij")
    radius = 1 + thick * np.cos(v)
    points = np.stack([radius * np.cos(u), radius * np.sin(u), thick * np.sin(v)], -1).reshape(-1, 3) * size
    faces = []
    for i in range(around):
        for j in range(tube):
            a, b = i * tube + j, ((i + 1) % around) * tube + j
            c, d = ((i + 1) % around) * tube + (j + 1) % tube, i * tube + (j + 1) % tube
            faces += [[a, b, c], [a, c, d]]
    return f'vertex="{_numbers(points)}" face="{" ".join(map(str, np.ravel(faces)))}"'


def _rock(rng: np.random.Generator, size: float) -> str:
    points = rng.normal(size=(int(rng.integers(9, 40)), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return f'vertex="{_numbers(points * size * rng.uniform(0.6, 1.2, 3))}"'


def _superquadric(rng: np.random.Generator, size: float) -> str:
    e1, e2 = rng.uniform(0.2, 2.2, 2)
    u, v = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 13), np.linspace(-np.pi, np.pi, 25)[:-1], indexing="ij")

    def power(values, exponent):
        return np.sign(values) * np.abs(values) ** exponent

    x = power(np.cos(u), e1) * power(np.cos(v), e2)
    y = power(np.cos(u), e1) * power(np.sin(v), e2)
    z = power(np.sin(u), e1)
    points = np.stack([x, y, z], -1).reshape(-1, 3) * size * rng.uniform(0.6, 1.3, 3)
    return f'vertex="{_numbers(points)}"'


_MESHES = (_revolution, _torus, _rock, _superquadric)


def _object(rng: np.random.Generator, index: int, material: str) -> tuple[str, str]:
    """Geoms of one object, and the meshes they need."""
    size = rng.uniform(0.22, 0.55)
    look = f'material="{material}"'
    kind = rng.random()
    if kind < 0.4:
        mesh = _MESHES[rng.integers(len(_MESHES))](rng, size)
        return f'<geom type="mesh" mesh="m{index}" {look}/>', f'<mesh name="m{index}" {mesh}/>'
    if kind < 0.7:
        shape = ("box", "ellipsoid", "cylinder", "capsule", "sphere")[rng.integers(5)]
        return f'<geom type="{shape}" size="{_numbers(size * rng.uniform(0.4, 1.1, 3))}" {look}/>', ""
    if kind < 0.8:  # a stool
        top, leg = size * rng.uniform(0.7, 1.1), size * rng.uniform(0.6, 1.3)
        parts = [f'<geom type="cylinder" size="{top} {size * 0.12}" pos="0 0 {leg}" {look}/>']
        for angle in np.arange(4) * np.pi / 2:
            x, y = 0.7 * top * np.cos(angle), 0.7 * top * np.sin(angle)
            parts.append(f'<geom type="capsule" size="{size * 0.09}" fromto="{x} {y} {leg} {x} {y} {-leg}" {look}/>')
        return "".join(parts), ""
    parts = []  # a toy of a few rounded parts
    for _ in range(int(rng.integers(3, 7))):
        shape = ("ellipsoid", "capsule", "box", "sphere")[rng.integers(4)]
        parts.append(
            f'<geom type="{shape}" size="{_numbers(size * rng.uniform(0.2, 0.6, 3))}" '
            f'pos="{_numbers(rng.normal(0, 0.45, 3) * size)}" quat="{_numbers(rng.normal(size=4))}" {look}/>'
        )
    return "".join(parts), ""


def _light(rng: np.random.Generator, sun: bool) -> str:
    """The sun (casts shadows) or a lamp."""
    place, aim = [*rng.uniform(-4, 4, 2), rng.uniform(4, 8)], [*rng.normal(0, 0.3, 2), -1]
    color = rng.uniform(0.25, 0.6) * (1 + rng.normal(0, 0.08, 3))
    flag = str(sun).lower()
    return (
        f'<light pos="{_numbers(place)}" dir="{_numbers(aim)}" diffuse="{_numbers(color)}" '
        f'directional="{flag}" castshadow="{flag}"/>'
    )


def _throw(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return where a thrown object starts, and the velocity that takes it into the heap within the film."""
    flight = rng.uniform(0.15, 0.85) * FRAMES / FRAMES_PER_SECOND
    side, far = rng.uniform(0, 2 * np.pi), rng.uniform(1.8, 3.5)
    start = np.array([far * np.cos(side), far * np.sin(side), rng.uniform(0.8, 3.5)])
    goal = np.array([*rng.uniform(-0.7, 0.7, 2), rng.uniform(0.5, 1.0)])
    return start, (goal - start) / flight + np.array([0, 0, 9.81 / 2 * flight])


def _scene(rng: np.random.Generator) -> tuple[str, dict[str, bytes], np.ndarray]:
    """The XML of a clip, its texture files, and the velocity of each object (NaN: it lies in the heap)."""
    count = int(rng.integers(13, 24))
    velocities = np.full((count, 3), np.nan)
    assets = {"floor.png": _png(texture(rng, 512, FLOORS)), "sky.png": _png(surroundings(rng))}
    textures, materials, meshes, bodies = [], [], [], []
    for index in range(count):
        assets[f"t{index}.png"] = _png(texture(rng))
        textures.append(f'<texture name="t{index}" type="cube" file="t{index}.png"/>')
        materials.append(
            f'<material name="o{index}" texture="t{index}" specular="{rng.uniform(0, 0.9):.2f}" '
            f'shininess="{rng.uniform(0.05, 0.9):.2f}" reflectance="0"/>'
        )
        geoms, mesh = _object(rng, index, f"o{index}")
        meshes.append(mesh)
        if rng.random() < 0.45:
            place, velocities[index] = _throw(rng)
        else:
            place = np.array([*rng.normal(0, 0.9, 2).clip(-1.7, 1.7), rng.uniform(0.3, 1.6)])
        floating = 'gravcomp="1"' if np.isfinite(velocities[index, 0]) else ""
        bodies.append(
            f'<body pos="{_numbers(place)}" quat="{_numbers(rng.normal(size=4))}" {floating}><freejoint/>{geoms}</body>'
        )
    angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(3.4, 4.6)
    eye = np.array([far * np.cos(angle), far * np.sin(angle), rng.uniform(0.9, 2.8)])
    target = np.array([*rng.normal(0, 0.3, 2), rng.uniform(0.5, 1.1)])
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    lights = "".join(_light(rng, sun) for sun in (True, False))
    repeat, fovy = rng.uniform(0.1, 0.5, 2), rng.uniform(35, 55)
    up = np.cross(back, right)
    xml = f"""<mujoco><option timestep="0.004"/>
    <visual><headlight ambient="0.35 0.35 0.35" diffuse="0.25 0.25 0.25" specular="0.1 0.1 0.1"/>
    <quality shadowsize="2048" offsamples="8"/><map znear="0.02"/>
    <global offwidth="{FRAME_SIZE}" offheight="{FRAME_SIZE}"/></visual><statistic extent="6" center="0 0 1"/>
    <asset><texture name="sky" type="skybox" file="sky.png"/><texture name="floor" type="2d" file="floor.png"/>
    <material name="floor" texture="floor" texrepeat="{_numbers(repeat)}" texuniform="true"
     reflectance="{rng.uniform(0, 0.15):.2f}"/>{"".join(textures)}{"".join(materials)}{"".join(meshes)}</asset>
    <default><geom density="400" friction="0.9 0.02 0.006" condim="6"/></default>
    <worldbody><geom type="plane" size="30 30 1" material="floor"/>{lights}
    <camera name="film" pos="{_numbers(eye)}" xyaxes="{_numbers(right)} {_numbers(up)}" fovy="{fovy:.1f}"/>
    {"".join(bodies)}</worldbody></mujoco>"""
    return xml, assets, velocities


def make_clip(seed: int, split: str, index: int) -> np.ndarray:
    """One clip, (24, 256, 256, 3) uint8; every (seed, split, index) has its own objects.

    Raises:
      BackgroundError: OpenGL (EGL) cannot start here.
    """
    from dmcvb_gen.rendering.opengl import offscreen, unavailable

    reason = unavailable()
    if reason:
        raise BackgroundError(f"clips are rendered with OpenGL: {reason.replace(' or use --renderer warp', '')}")
    rng = np.random.default_rng([seed, {"train": 0, "val": 1}[split], index])
    for last in (False,) * 19 + (True,):
        xml, assets, velocities = _scene(rng)
        try:
            model = mujoco.MjModel.from_xml_string(xml, assets)
            break
        except ValueError:  # a degenerate random mesh: draw another scene from the same stream
            if last:
                raise
    data, step = mujoco.MjData(model), model.opt.timestep
    mujoco.mj_step(model, data, nstep=round(SETTLING / step))
    speed = data.qvel.reshape(-1, 6)
    for index in np.flatnonzero(np.isfinite(velocities[:, 0])).tolist():
        model.body_gravcomp[index + 1] = 0
        speed[index] = [*velocities[index], *rng.normal(0, 3, 3)]
    frames = np.empty((FRAMES, FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
    with offscreen(model, FRAME_SIZE) as shoot:
        for frame in range(FRAMES):
            frames[frame] = shoot(data, "film")
            mujoco.mj_step(model, data, nstep=round(1 / FRAMES_PER_SECOND / step))
    return frames


def save_clip(path: Path, frames: np.ndarray) -> None:
    """Write frames (n, h, w, 3) uint8 as an animated WebP, whole or not at all."""
    pictures = [Image.fromarray(frame) for frame in frames]
    duration = round(1000 / FRAMES_PER_SECOND)
    options: dict[str, Any] = dict(save_all=True, duration=duration, loop=0, quality=QUALITY, method=6)
    try:
        with replacing(path) as part:
            pictures[0].save(part, "WEBP", append_images=pictures[1:], **options)
    except OSError as error:
        raise BackgroundError(f"cannot write {path}: {error.strerror or error}; give another --out") from None


def _claim(out: Path, seed: int) -> None:
    """Note in the folder what its clips are made from; refuse one with other clips."""
    note, facts = out / "clips.json", {"seed": seed, "generator": GENERATOR}
    try:
        if note.is_file():
            found = json.loads(note.read_text())
            if found != facts:
                raise BackgroundError(f"{out} holds clips of {found}, asked for are {facts}; give another --out")
        elif any((out / split).is_dir() and any((out / split).iterdir()) for split in SPLITS):
            raise BackgroundError(f"{out} holds videos of another origin; give another --out")
        else:
            write_text(note, json.dumps(facts))
    except (OSError, ValueError) as error:
        raise BackgroundError(f"cannot use {out} ({error}); give another --out") from None


def make_clips(
    videos: int, seed: int, out: str | Path, tick: Callable[[], None] = lambda: None
) -> dict[str, list[Path]]:
    """Make `videos` clips for training and as many for evaluation, in train/ and val/ of a folder.

    Clips of the same seed that are there already are kept, so that an interrupted call goes on.

    Raises:
      BackgroundError: OpenGL cannot start, the folder cannot be written or holds other videos.
      StoreError: the folder is a URL.
    """
    out = local_path(out)
    _claim(out, seed)
    made: dict[str, list[Path]] = {split: [] for split in SPLITS}
    for split, paths in made.items():
        for index in range(videos):
            path = out / split / f"clip_{index:03d}.webp"
            if not path.exists():
                save_clip(path, make_clip(seed, split, index))
            paths.append(path)
            tick()
    return made


def clip_sheet(source: str | Path, columns: int = 6) -> np.ndarray:
    """(height, width, 3) uint8: a few frames of every video of a source, a row a video, at half size."""
    from dmcvb_gen.distractors.backgrounds import load_backgrounds

    rows = []
    for split in SPLITS:
        backgrounds = load_backgrounds(source, split)
        for video in range(len(backgrounds)):
            frames = backgrounds.frames(video)
            steps = np.linspace(0, len(frames) - 1, columns).round().astype(int)
            rows.append(np.concatenate(list(frames[steps][:, ::2, ::2]), axis=1))
    return np.concatenate(rows)
