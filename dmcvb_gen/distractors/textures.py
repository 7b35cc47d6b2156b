"""Make natural-looking square textures for the clips from a random stream."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image, ImageFilter


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
