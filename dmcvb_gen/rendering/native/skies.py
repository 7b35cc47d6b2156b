"""Turn a background's picture into the mip levels of a sky, as packed texels (see `textures`).

The same bits as Pillow's bilinear `resize` and `reduce`, several times as fast: a video's every frame is a sky.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dmcvb_gen.rendering.native.lanes import distinct, get, leaf, part, put

f4, i4 = np.float32, np.int32
BITS = 22
"""Bits of Pillow's weights below the point."""


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


@part
def shrink(texels, side, out):
    """(side * side) texels of an odd side made (side // 2)^2, each the blend of the four around its center."""
    less = side // 2
    for row in range(less):
        y = (row + 0.5) * side / less - 0.5
        top = int(np.floor(y))
        down = f4(y - top)
        for column in range(less):
            x = (column + 0.5) * side / less - 0.5
            left = int(np.floor(x))
            across, color = f4(x - left), i4(0)
            for shift in range(0, 24, 8):
                a, b = channel(texels, side * top + left, shift), channel(texels, side * top + left + 1, shift)
                at = side * (top + 1) + left
                c, d = channel(texels, at, shift), channel(texels, at + 1, shift)
                near, far = a * (f4(1) - down) + c * down, b * (f4(1) - down) + d * down
                value = np.floor(near * (f4(1) - across) + far * across + f4(0.5))
                color |= i4(i4(value) << shift)
            out[less * row + column] = color


@leaf
def channel(texels, at, shift):
    """A channel of a texel, as a float."""
    return f4(i4((texels[at] >> shift) & 255))


def sky_maker(version: int):
    """Return a function that makes of (rows, columns, 3) uint8 the texels of `side` * `side` and of all smaller levels,
    one after another; see `frame.painter`.
    """

    @njit(nogil=True, error_model="numpy", cache=True)
    def make(picture, across, across_weight, down, down_weight, narrow, tall, out):
        rows, columns, side = picture.shape[0], picture.shape[1], down.size
        if version != 0:
            for row in range(rows):
                for x in range(columns):
                    red, green, blue = i4(picture[row, x, 0]), i4(picture[row, x, 1]), i4(picture[row, x, 2])
                    narrow[row * columns + x] = red | (green << 8) | (blue << 16)
            widen(narrow, across, across_weight, rows, columns, side, tall)
            heighten(tall, down, down_weight, side, side, out)
            at = 0
            while side > 1:
                if side % 2 == 0:
                    halve(out[at : at + side * side], side // 2, out[at + side * side :])
                else:
                    shrink(out[at : at + side * side], side, out[at + side * side :])
                at, side = at + side * side, side // 2

    return make
