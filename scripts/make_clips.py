"""Make clips of objects that fall and collide, like Kubric's MOVi-D, from a seed: the kind that the package brings.

MUJOCO_GL=egl python scripts/make_clips.py --seed 2024 --out clips              # those of the package
MUJOCO_GL=egl python scripts/make_clips.py --videos 60 --seed 1 --out clips
dmcvb-gen rollout walker-walk --distractor dynamic --backgrounds clips

Each clip is a MuJoCo simulation of its own: 13 to 23 objects of many shapes with procedural textures, some
lying in a heap, some thrown into it one after another, filmed by a fixed camera for 24 frames of 256 x 256.
"""

from __future__ import annotations

import argparse
import colorsys
import contextlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageFilter

FRAME_SIZE = 256
FRAMES, FRAMES_PER_SECOND = 24, 12
SETTLING = 0.8
"""Seconds that the heap has to come to rest before the film begins."""
QUALITY = 72
"""WebP quality of the files."""
SPLITS = ("train", "val")


# -- textures ------------------------------------------------------------------------------------


def fractal_noise(rng: np.random.Generator, size: int, octaves: int = 6, first: int = 3) -> np.ndarray:
    """(size, size) in [0, 1]: noise summed over octaves of halving amplitude; tiles at the edges nearly."""
    total, weight, cells = np.zeros((size, size)), 0.0, first
    for octave in range(octaves):
        grid = rng.random((cells, cells))
        grid = np.pad(grid, ((0, 1), (0, 1)), mode="wrap")
        layer = Image.fromarray((grid * 255).astype(np.uint8)).resize((size, size), Image.Resampling.BICUBIC)
        total += np.asarray(layer) / 255.0 * 0.5**octave
        weight += 0.5**octave
        cells = min(cells * 2, size)
    total /= weight
    low, high = total.min(), total.max()
    return (total - low) / (high - low + 1e-9)


_HUES = ((0.08, 0.035, 0.5), (0.6, 0.05, 0.17), (0.27, 0.06, 0.13), (0.0, 0.02, 0.08))
"""Mean, spread and share of the hues of nature and rooms: earth and wood, sky and slate, leaves, brick; else any."""


def palette(rng: np.random.Generator, count: int = 4, vivid: float | None = None) -> np.ndarray:
    """(count, 3) in [0, 1]: colors that go together: neighboring hues and sometimes one of the other side."""
    draw, hue = rng.random(), rng.random()
    for mean, spread, share in _HUES:
        if draw < share:
            hue = rng.normal(mean, spread)
            break
        draw -= share
    vivid = rng.uniform(0.1, 0.75) if vivid is None else vivid
    colors = []
    for index in range(count):
        shift = rng.normal(0, 0.04) + (0.5 if index == count - 1 and rng.random() < 0.3 else 0)
        colors.append(
            colorsys.hsv_to_rgb((hue + shift) % 1, np.clip(vivid + rng.normal(0, 0.12), 0, 1), rng.uniform(0.25, 1))
        )
    return np.array(colors)


def shade(values: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Map values in [0, 1] onto a ramp of colors, (h, w, 3) in [0, 1]."""
    stops = np.linspace(0, 1, len(colors))
    return np.stack([np.interp(values, stops, colors[:, channel]) for channel in range(3)], axis=-1)


def _marble(rng, size, grid):
    x, y = grid
    turbulence = fractal_noise(rng, size)
    angle = rng.uniform(0, np.pi)
    veins = np.sin(
        rng.uniform(3, 9) * np.pi * (x * np.cos(angle) + y * np.sin(angle)) + rng.uniform(4, 10) * turbulence
    )
    return shade(np.abs(veins) ** rng.uniform(0.3, 1), palette(rng, 4, rng.uniform(0, 0.5)))


def _wood(rng, size, grid):
    x, y = grid
    warp = fractal_noise(rng, size, 4) * rng.uniform(0.05, 0.3)
    rings = (np.hypot(x - rng.random(), (y - 0.5) * rng.uniform(0.05, 0.4)) + warp) * rng.uniform(6, 20)
    rings = 0.5 + 0.35 * np.sin(2 * np.pi * rings) + 0.15 * np.sin(6 * np.pi * rings)
    brown = np.array([[0.25, 0.13, 0.05], [0.55, 0.33, 0.15], [0.75, 0.52, 0.3]]) * rng.uniform(0.6, 1.3)
    grain = fractal_noise(rng, size, 7, 16)[:, :, None]
    return np.clip(shade(rings, brown) * (0.75 + 0.4 * grain), 0, 1)


def _rust(rng, size, grid):
    noise, mask = fractal_noise(rng, size, 7), fractal_noise(rng, size, 5)
    paint = shade(noise * 0.3 + 0.5, palette(rng, 3))
    rust = shade(noise, np.array([[0.2, 0.08, 0.03], [0.5, 0.22, 0.08], [0.75, 0.45, 0.2]]))
    edge = np.clip((mask - rng.uniform(0.35, 0.65)) * 12, 0, 1)[..., None]
    return paint * edge + rust * (1 - edge)


def _fabric(rng, size, grid):
    x, y = grid
    fine = rng.uniform(40, 90)
    weave = 0.5 + 0.25 * np.sin(fine * np.pi * x) + 0.25 * np.sin(fine * np.pi * y)
    colors, bands = palette(rng, 5), int(rng.integers(3, 9))
    stripes = colors[
        (np.floor(x * bands).astype(int) + (np.floor(y * bands).astype(int) if rng.random() < 0.6 else 0)) % 5
    ]
    return np.clip(stripes * (0.6 + 0.4 * weave)[..., None] * (0.8 + 0.3 * fractal_noise(rng, size))[..., None], 0, 1)


def _stones(rng, size, grid):
    x, y = grid
    centers = rng.random((int(rng.integers(15, 70)), 2))
    offsets = np.abs(np.stack([x, y], -1)[:, :, None] - centers)
    distances = np.sqrt((np.minimum(offsets, 1 - offsets) ** 2).sum(-1))
    nearest, owner = np.sort(distances, axis=-1)[..., :2], distances.argmin(-1)
    colors = shade(rng.random(len(centers)), palette(rng, 4))
    gap = np.clip((nearest[..., 1] - nearest[..., 0]) * 25, 0.15, 1)[..., None]
    return np.clip(colors[owner] * gap * (0.6 + 0.5 * fractal_noise(rng, size, 7, 8))[..., None], 0, 1)


def _package(rng, size, grid):
    """Printed cardboard: blocks, bars and blobs, a little worn."""
    colors = palette(rng, 6, rng.uniform(0.4, 1))
    canvas = np.ones((size, size, 3)) * colors[0]
    for _ in range(int(rng.integers(6, 20))):
        top, left = rng.integers(0, size, 2)
        high, wide = rng.integers(size // 24, size // 2, 2)
        canvas[top : top + high, left : left + wide] = colors[rng.integers(6)]
    for _ in range(int(rng.integers(4, 12))):
        top, left = rng.integers(0, size, 2)
        for line in range(int(rng.integers(2, 6))):
            width = int(rng.integers(size // 16, size // 3))
            row = top + line * size // 32
            canvas[row : row + size // 64, left : left + width] = rng.choice([0.05, 0.95])
    x, y = grid
    for _ in range(int(rng.integers(0, 5))):
        disc = np.hypot(x - rng.random(), y - rng.random()) < rng.uniform(0.04, 0.22)
        canvas[disc] = colors[rng.integers(6)]
    return np.clip(canvas * (0.8 + 0.25 * fractal_noise(rng, size, 6))[..., None], 0, 1)


def _foliage(rng, size, grid):
    noise = fractal_noise(rng, size, 7, 6)
    fine = fractal_noise(rng, size, 6, 24)
    base = np.array([[0.05, 0.12, 0.03], [0.2, 0.4, 0.1], [0.55, 0.65, 0.25], [0.8, 0.75, 0.45]])
    return np.clip(shade(noise * 0.6 + fine * 0.4, base) * rng.uniform(0.7, 1.2, 3), 0, 1)


def _bricks(rng, size, grid):
    x, y = grid
    rows = int(rng.integers(5, 14))
    row = np.floor(y * rows).astype(int)
    u = (x * rows / 2 + 0.5 * (row % 2)) % 1
    v = (y * rows) % 1
    column = np.floor(x * rows / 2 + 0.5 * (row % 2)).astype(int)
    tint = rng.random((rows + 1, rows + 2))[row % (rows + 1), column % (rows + 2)]
    mortar = np.clip(np.minimum.reduce([u * 2, (1 - u) * 2, v, 1 - v]) * 12, 0, 1)[..., None]
    brick = shade(tint, palette(rng, 3, rng.uniform(0.1, 0.7)))
    return np.clip(
        (brick * mortar + 0.6 * (1 - mortar)) * (0.7 + 0.4 * fractal_noise(rng, size, 7, 8))[..., None], 0, 1
    )


MATERIALS = (_marble, _wood, _rust, _fabric, _stones, _package, _foliage, _bricks)
FLOORS = (_marble, _wood, _fabric, _stones, _foliage, _bricks)


def texture(rng: np.random.Generator, size: int = 256, materials: Sequence[Callable] = MATERIALS) -> np.ndarray:
    """(size, size, 3) uint8: marble, wood, rust, cloth, stones, print, leaves or bricks (or one of `materials`)."""
    y, x = np.mgrid[:size, :size] / size
    kind = materials[int(rng.integers(len(materials)))]
    return (np.clip(kind(rng, size, (x, y)), 0, 1) * 255).astype(np.uint8)


_SKIES = np.array(
    [
        [[0.25, 0.45, 0.8], [0.8, 0.88, 0.95]],  # clear
        [[0.55, 0.6, 0.66], [0.85, 0.85, 0.85]],  # overcast
        [[0.2, 0.25, 0.5], [0.98, 0.62, 0.35]],  # sunset
        [[0.75, 0.7, 0.62], [0.95, 0.92, 0.85]],  # a lit room
        [[0.1, 0.12, 0.22], [0.4, 0.42, 0.55]],  # dusk
    ]
)
"""Colors at the zenith and at the horizon."""


def surroundings(rng: np.random.Generator, size: int = 512) -> np.ndarray:
    """(size, size, 3) uint8: a side of the world around: sky or ceiling, a skyline or shelves, ground; out of focus."""
    y, x = np.mgrid[:size, :size] / size
    zenith, horizon = _SKIES[rng.integers(len(_SKIES))] * rng.normal(1, 0.06, (2, 3))
    sky = shade(np.clip(y * 1.8, 0, 1), np.clip([zenith, (zenith + horizon) / 2, horizon], 0, 1))
    clouds = np.clip(fractal_noise(rng, size, 7) - 0.45, 0, 1)[..., None] * 1.2
    picture = sky * (1 - clouds) + clouds
    for layer in range(3):
        color = palette(rng, 3, rng.uniform(0.05, 0.4)) * (0.8 - 0.15 * layer)
        edges = np.cumsum(rng.integers(size // 40, size // 8, 80))
        heights = rng.uniform(0.32 + 0.08 * layer, 0.52 + 0.06 * layer, 81)
        column = np.searchsorted(edges, np.arange(size))
        if rng.random() < 0.5:
            profile = heights[column]
        else:
            profile = 0.4 + 0.07 * layer + 0.15 * (fractal_noise(rng, size, 6)[0] - 0.5)
        solid = y > profile[None, :]
        detail = fractal_noise(rng, size, 7, 10)
        windows = ((x * rng.uniform(30, 80)) % 1 > 0.5) & ((y * rng.uniform(30, 80)) % 1 > 0.5) & (detail > 0.45)
        body = shade(detail, color) + 0.25 * windows[..., None] * rng.random(3)
        picture = np.where(solid[..., None], body, picture)
    ground = np.clip((y - rng.uniform(0.55, 0.65)) * 8, 0, 1)[..., None]
    picture = picture * (1 - ground) + shade(fractal_noise(rng, size, 7, 6), palette(rng, 4, 0.3)) * ground
    image = Image.fromarray((np.clip(picture, 0, 1) * 255).astype(np.uint8))
    return np.asarray(image.filter(ImageFilter.GaussianBlur(size / 300)))


# -- scenes --------------------------------------------------------------------------------------


def _numbers(values) -> str:
    return " ".join(f"{value:.5g}" for value in np.ravel(values))


def _png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def _quads(rows: int, columns: int) -> list[tuple[int, int, int, int]]:
    """Corners of the quads of a grid of points that is closed in both directions, row by row."""
    places = [(i, j, (i + 1) % rows, (j + 1) % columns) for i in range(rows) for j in range(columns)]
    return [(i * columns + j, m * columns + j, m * columns + n, i * columns + n) for i, j, m, n in places]


def _revolution(rng: np.random.Generator, size: float) -> str:
    """Vertices and faces of a vase: a random profile turned around its axis."""
    rings, sides = 9, 18
    profile = np.interp(np.linspace(0, 1, rings), np.linspace(0, 1, 5), rng.uniform(0.25, 1, 5)) * size
    height = np.linspace(-1, 1, rings) * size * rng.uniform(0.8, 1.8)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    side = np.stack([np.outer(profile, np.cos(angle)), np.outer(profile, np.sin(angle))], -1)
    points = np.concatenate([side, np.broadcast_to(height[:, None, None], (rings, sides, 1))], -1).reshape(-1, 3)
    points = np.concatenate([points, [[0, 0, height[0]], [0, 0, height[-1]]]])
    faces = [face for a, b, c, d in _quads(rings, sides)[:-sides] for face in ([a, d, c], [a, c, b])]
    bottom, top, last = rings * sides, rings * sides + 1, (rings - 1) * sides
    for k in range(sides):
        faces += [[bottom, (k + 1) % sides, k], [top, last + k, last + (k + 1) % sides]]
    return f'vertex="{_numbers(points)}" face="{" ".join(map(str, np.ravel(faces)))}"'


def _torus(rng: np.random.Generator, size: float) -> str:
    around, tube = 24, 10
    thick = rng.uniform(0.2, 0.42)
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(tube) * 2 * np.pi / tube, indexing="ij")
    radius = 1 + thick * np.cos(v)
    points = np.stack([radius * np.cos(u), radius * np.sin(u), thick * np.sin(v)], -1).reshape(-1, 3) * size
    faces = [face for a, b, c, d in _quads(around, tube) for face in ([a, b, c], [a, c, d])]
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
    """One clip, (24, 256, 256, 3) uint8; every (seed, split, index) has its own objects."""
    rng = np.random.default_rng([seed, SPLITS.index(split), index])
    model = None
    while model is None:
        xml, assets, velocities = _scene(rng)
        with contextlib.suppress(ValueError):  # a degenerate random mesh: draw another scene from the same stream
            model = mujoco.MjModel.from_xml_string(xml, assets)
    data, step = mujoco.MjData(model), model.opt.timestep
    mujoco.mj_step(model, data, nstep=round(SETTLING / step))
    speed = data.qvel.reshape(-1, 6)
    for thrown in np.flatnonzero(np.isfinite(velocities[:, 0])).tolist():
        model.body_gravcomp[thrown + 1] = 0
        speed[thrown] = [*velocities[thrown], *rng.normal(0, 3, 3)]
    frames = np.empty((FRAMES, FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
    with mujoco.Renderer(model, FRAME_SIZE, FRAME_SIZE) as renderer:
        for frame in range(FRAMES):
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "film")
            frames[frame] = renderer.render()
            mujoco.mj_step(model, data, nstep=round(1 / FRAMES_PER_SECOND / step))
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=int, default=8, help="clips for each of train and val")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="folder of the clips")
    options = parser.parse_args()
    for split in SPLITS:
        (options.out / split).mkdir(parents=True, exist_ok=True)
        for index in range(options.videos):
            path = options.out / split / f"clip_{index:03d}.webp"
            first, *others = map(Image.fromarray, make_clip(options.seed, split, index))
            duration = round(1000 / FRAMES_PER_SECOND)
            first.save(path, save_all=True, append_images=others, duration=duration, loop=0, quality=QUALITY, method=6)
            print(path, flush=True)


if __name__ == "__main__":
    main()
