"""Mip levels of pictures as one flat buffer of texels; a texel is an int32 with red in its lowest byte.

The levels are those that Mesa's `glGenerateMipmap` makes: each side halved and rounded down, each texel the
bilinear sample of the level before. Textures in sRGB are kept in linear light, as OpenGL samples them.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache

import mujoco
import numpy as np

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native.layout import distinct, entry, get, leaf, part, put

f4, i4 = np.float32, np.int32
BITS = 22
"""Bits of Pillow's weights below the point."""
SKY_WIDTH = 800
"""Texels a side of a background on the sky (the skybox's own width, Distracting Control Suite)."""
SKY_BYTES = 64 << 20
"""Memory for the skies of a renderer; the least recently seen make room."""


def level_sizes(width: int, height: int) -> list[tuple[int, int]]:
    """(width, height) of every level, down to one texel."""
    sizes = [(width, height)]
    while max(sizes[-1]) > 1:
        width, height = max(1, width // 2), max(1, height // 2)
        sizes.append((width, height))
    return sizes


@lru_cache
def _taps(old: int, new: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for each of `new` texels along a side, the two old ones around it and the weight of the second."""
    center = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(center).astype(int)
    return np.clip(first, 0, old - 1), np.clip(first + 1, 0, old - 1), (center - first).astype(np.float32)


def halved(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """(h, w, channel) float32 -> (height, width, channel) float32, the next level before rounding."""
    top, bottom, down = _taps(picture.shape[0], height)
    left, right, across = _taps(picture.shape[1], width)
    down, across = down[:, None, None], across[None, :, None]
    rows = picture[top] * (1 - down) + picture[bottom] * down
    return rows[:, left] * (1 - across) + rows[:, right] * across


def _display(linear: np.ndarray) -> np.ndarray:
    """Linear light in [0, 1] as sRGB in [0, 255]."""
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


_SRGB = np.arange(256, dtype=np.float32) / np.float32(255)
_LINEAR_OF = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""sRGB in whole numbers up to 255 -> linear light in [0, 1]."""


def levels(picture: np.ndarray, srgb: bool = False) -> list[np.ndarray]:
    """(h, w, 3) uint8 -> its mip levels, each uint8; sRGB ones as linear light in [0, 255]."""
    out: list[np.ndarray] = []
    current = picture
    for width, height in level_sizes(picture.shape[1], picture.shape[0]):
        if out:
            source = _LINEAR_OF[current] if srgb else current.astype(np.float32)
            smaller = halved(source, width, height)
            current = np.floor((_display(smaller) if srgb else smaller) + 0.5).astype(np.uint8)
        out.append(np.rint(255 * _LINEAR_OF[current]).astype(np.uint8) if srgb else current)
    return out


@lru_cache(maxsize=8)  # a sky's six faces and a floor, up to 9 MB each: seven mazes share them, a task's settings too
def _packed_levels(picture: bytes, height: int, width: int, srgb: bool) -> tuple[np.ndarray, ...]:
    """The levels of (height, width, 3) uint8 bytes, `packed`."""
    pixels = np.frombuffer(picture, np.uint8).reshape(height, width, 3)
    return tuple(packed(level) for level in levels(pixels, srgb))


def packed(picture: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 -> (h * w,) int32 texels."""
    return np.concatenate([picture, np.zeros_like(picture[..., :1])], axis=2).view("<i4").ravel()


def background_texels(picture: np.ndarray, room: dict[str, np.ndarray]) -> np.ndarray:
    """(h, w, 3) uint8, sides of 2 to SKY_WIDTH -> (texel,) int32, all levels of a background on the sky in turn.

    They are `levels` of the picture that Pillow's bilinear filter makes SKY_WIDTH wide and high.

    Args:
      room: memory that is kept for the next call; the texels are in it.
    """
    rows, columns = picture.shape[:2]
    if "all" not in room:
        total = sum(width * height for width, height in level_sizes(SKY_WIDTH, SKY_WIDTH))
        sizes = {"narrow": SKY_WIDTH * SKY_WIDTH, "tall": SKY_WIDTH * SKY_WIDTH, "all": total}
        room.update({name: np.empty(size, np.int32) for name, size in sizes.items()})
    across, down = taps(columns, SKY_WIDTH), taps(rows, SKY_WIDTH)
    out = room["all"]
    at, side = make_sky(np.ascontiguousarray(picture), *across, *down, room["narrow"], room["tall"], out)
    smallest = out[at : at + side * side].view(np.uint8).reshape(side, side, 4)[..., :3]
    out[at:] = np.concatenate([packed(level) for level in levels(smallest)])
    return out


class Textures:
    """The textures of a model and the skies of the backgrounds, each made ready when it is first asked for.

    Args:
      model: the MuJoCo model; its own sky counts as a texture of six faces.
      backgrounds: the videos that labels may name, or None.
      finest: the finest level of a background that pictures can show.

    Attributes:
      texels: (texel,) int32, the table, then all levels of all textures.
      table: (texture, column) int32, where they are: see `layout.FIRST`. Backgrounds come after the model's own.
      slots: number of backgrounds that there is room for.
    """

    def __init__(self, model: mujoco.MjModel, backgrounds, finest: int):
        self._model, self._backgrounds, self._finest = model, backgrounds, finest
        self._ready: set[int] = set()
        self._room: dict[str, np.ndarray] = {}
        self._slot: OrderedDict[tuple[int, int], int] = OrderedDict()
        textures = []
        for texture in range(model.ntex):
            width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
            cube = model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D
            textures.append((level_sizes(width, width if cube else height), 6 if cube else 1, 0))
        sky = level_sizes(SKY_WIDTH, SKY_WIDTH), 1, finest
        each = 4 * sum(width * height for width, height in sky[0][finest:])
        self.slots = int(np.clip(SKY_BYTES // each, 8, 256)) if backgrounds is not None else 0
        textures += [sky] * self.slots
        most = max((len(sizes) for sizes, _, _ in textures), default=0)
        self.table = np.zeros((max(len(textures), 1), L.FIRST + 3 * most), np.int32)
        total = self.table.size
        for row, (sizes, faces, first) in zip(self.table, textures, strict=False):
            row[L.LEVELS], row[L.FACES] = len(sizes), faces
            for level, (width, height) in enumerate(sizes):
                row[L.FIRST + 3 * level : L.FIRST + 3 * level + 3] = total, width, height
                total += faces * width * height if level >= first else 0
        self.texels = np.empty(total, np.int32)  # memory is taken when a texture is written
        self.texels[: self.table.size] = self.table.ravel()

    def make_ready(self, index: int) -> None:
        """Build the levels of one of the model's textures, once."""
        if index < 0 or index in self._ready:
            return
        self._ready.add(index)
        faces = int(self.table[index, L.FACES])
        # OpenGL reads cubes as they are.
        srgb = faces == 1 and self._model.tex_colorspace[index] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB
        for face, picture in enumerate(self._faces(index, faces)):
            for level, texels in enumerate(_packed_levels(picture.tobytes(), *picture.shape[:2], bool(srgb))):
                self._put(index, level, texels, face)

    def background(self, video: int, frame: int) -> int:
        """The texture of a video's frame, made now if need be; stays for the next `slots` - 1 others."""
        key = video, frame
        if key not in self._slot:
            full = len(self._slot) >= self.slots
            texture = self._slot.popitem(last=False)[1] if full else self._model.ntex + len(self._slot)
            texels = background_texels(self._backgrounds.frames(video)[frame], self._room)
            finer = sum(width * height for width, height in level_sizes(SKY_WIDTH, SKY_WIDTH)[: self._finest])
            self._put(texture, self._finest, texels[finer:])
            self._slot[key] = texture
        self._slot.move_to_end(key)
        return self._slot[key]

    def _put(self, texture: int, level: int, texels: np.ndarray, face: int = 0) -> None:
        first = int(self.table[texture, L.FIRST + 3 * level]) + face * len(texels)
        self.texels[first : first + len(texels)] = texels

    def _faces(self, index: int, faces: int) -> list[np.ndarray]:
        model = self._model
        height, width, channels = (int(a[index]) for a in (model.tex_height, model.tex_width, model.tex_nchannel))
        address = int(model.tex_adr[index])
        data = model.tex_data[address : address + height * width * channels].reshape(height, width, channels)
        if faces == 1:
            return [data]
        return [data] * 6 if height == width else [data[face * width : (face + 1) * width] for face in range(6)]


# -- skies: the same bits as Pillow's bilinear `resize` and `reduce`, several times as fast ----------


def taps(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Of `old` texels made `new` >= `old`: (new,) int32, the first of the two that each lies between, and its weight.

    Pillow's bilinear filter; the second one has the rest of the weight.
    """
    center = (np.arange(new) + 0.5) * (old / new)
    first = np.maximum((center - 0.5).astype(np.int64), 0)
    past = np.minimum((center + 1.5).astype(np.int64), old)
    share = 1.0 - np.abs(first - center + 0.5)
    second = np.where(past - first > 1, 1.0 - np.abs(first + 1 - center + 0.5), 0.0)
    weight = (0.5 + share / (share + second) * (1 << BITS)).astype(np.int64)
    alone = np.minimum(first, old - 2) < first  # the last texel counts as a second one without a first
    weight = np.where(alone, 0, weight)
    return np.where(alone, old - 2, first).astype(np.int32), weight.astype(np.int32)


@leaf
def between(one, two, weight, shift):
    """Channel of two texels by weight of the first, in its place."""
    a, b = i4((one >> shift) & i4(255)), i4((two >> shift) & i4(255))
    value = i4(i4(a * weight) + i4(b * i4(i4(1 << BITS) - weight)))
    return i4(i4(i4(value + i4(1 << (BITS - 1))) >> i4(BITS)) << shift)


@part
def widen(texels, first, weight, rows, columns, wide, out):
    """(rows * columns) texels made (rows * wide)."""
    distinct()
    for row in range(rows):
        at, to = row * columns, row * wide
        for x in range(wide):
            place, share = i4(at + get(first, x)), get(weight, x)
            one, two = get(texels, place), get(texels, i4(place + i4(1)))
            red, green = between(one, two, share, i4(0)), between(one, two, share, i4(8))
            put(out, to + x, i4(red | green | between(one, two, share, i4(16))))


@part
def heighten(texels, first, weight, columns, high, out):
    """(rows * columns) texels made (high * columns)."""
    distinct()
    for row in range(high):
        at, to, share = first[row] * columns, row * columns, weight[row]
        for x in range(columns):
            one, two = get(texels, at + x), get(texels, at + columns + x)
            red, green = between(one, two, share, i4(0)), between(one, two, share, i4(8))
            put(out, to + x, i4(red | green | between(one, two, share, i4(16))))


@part
def halve(texels, side, out):
    """(2 * side * 2 * side) texels made (side * side), boxes of four."""
    distinct()
    for row in range(side):
        at, to = 4 * side * row, side * row
        for x in range(side):
            one, two = get(texels, at + 2 * x), get(texels, at + 2 * x + 1)
            three, four = get(texels, at + 2 * side + 2 * x), get(texels, at + 2 * side + 2 * x + 1)
            apart = i4(0xFF00FF)
            sides = i4((one & apart) + (two & apart) + (three & apart) + (four & apart) + 0x20002)
            middle = i4(((one >> 8) & 255) + ((two >> 8) & 255) + ((three >> 8) & 255) + ((four >> 8) & 255) + 2)
            put(out, to + x, i4(((sides >> 2) & apart) | ((middle >> 2) << 8)))


@entry
def make_sky(picture, across, across_weight, down, down_weight, narrow, tall, out):
    """Make of (rows, columns, 3) uint8 the texels of `side` * `side` and of each half of it, up to an odd side.

    Gives where the texels of that side begin, and the side.
    """
    rows, columns, side = picture.shape[0], picture.shape[1], down.size
    for row in range(rows):
        for x in range(columns):
            red, green, blue = i4(picture[row, x, 0]), i4(picture[row, x, 1]), i4(picture[row, x, 2])
            narrow[row * columns + x] = red | (green << 8) | (blue << 16)
    widen(narrow, across, across_weight, rows, columns, side, tall)
    heighten(tall, down, down_weight, side, side, out)
    at = 0
    while side % 2 == 0:
        halve(out[at : at + side * side], side // 2, out[at + side * side :])
        at, side = at + side * side, side // 2
    return at, side
