"""Texture coordinates in, colors out: mip levels and weights as OpenGL on a CPU (Mesa's llvmpipe) chooses them.

Everything here is plain arithmetic that gives the same bits on every processor: no function of a mathematics
library, no contraction into fused operations.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from dmcvb_gen.rendering.native.records import FACES, FIRST, LEVELS

part = njit(nogil=True, error_model="numpy")
"""For the parts of the entry points in `frame`, which alone are kept on disk."""
leaf = njit(nogil=True, error_model="numpy", forceinline=True)
"""For small parts: numba hands an array over as seven numbers or more, so a call can cost more than its work."""


@leaf
def level_of_detail(rho_squared):
    """(finer level, share of the next one in 1/256) of a footprint of `rho` texels a pixel.

    The logarithm is linear between powers of two, and a level is taken alone within a quarter of it: llvmpipe's
    "brilinear" choice.
    """
    if not rho_squared > 1.0:
        return 0, 0
    bits = np.int64(np.float32(rho_squared).view(np.int32))
    lod = 0.5 * ((bits >> 23) - 127 + (bits & 0x7FFFFF) * (1.0 / 0x800000)) + 0.25
    level = int(lod)
    share = 2.0 * (lod - level) - 1.0
    return level, int(256.0 * share) if share > 0.0 else 0


@leaf
def repeated(coordinate, size):
    """The two texels around a repeating coordinate, and the second one's weight in 1/256."""
    place = (coordinate - math.floor(coordinate)) * size + 0.5
    second = int(place)
    weight = int(256.0 * (place - second))
    first = second - 1
    if first < 0:
        first = size - 1
    if second >= size:
        second = 0
    return first, second, weight


@leaf
def clamped(coordinate, size):
    """As `repeated`, for a coordinate in [0, 1] that ends at the texture's edge."""
    place = coordinate * size + 0.5
    second = int(place)
    weight = int(256.0 * (place - second))
    return max(second - 1, 0), min(second, size - 1), weight


@leaf
def blend_of_four(texels, top, bottom, left, right, across, down):
    """Red and blue (in the halves of one integer), and green, of four texels, times 65536."""
    a, b, all_ = np.uint64(across), np.uint64(down), np.uint64(256)
    eight = np.uint64(8)
    one, two = np.uint64(texels[top + left]), np.uint64(texels[top + right])
    three, four = np.uint64(texels[bottom + left]), np.uint64(texels[bottom + right])
    low = np.uint64(0xFF)
    move, high = np.uint64(16), np.uint64(0xFF0000)
    u, v, w, x = (all_ - a) * (all_ - b), a * (all_ - b), (all_ - a) * b, a * b
    red_blue = (
        ((one & low) | ((one & high) << move)) * u
        + ((two & low) | ((two & high) << move)) * v
        + ((three & low) | ((three & high) << move)) * w
        + ((four & low) | ((four & high) << move)) * x
    )
    green = (
        ((one >> eight) & low) * u
        + ((two >> eight) & low) * v
        + ((three >> eight) & low) * w
        + ((four >> eight) & low) * x
    )
    return red_blue, green


@leaf
def unpacked(red_blue, green, nearer, farther, share):
    """Two levels' `blend_of_four` mixed, as colors in [0, 1]."""
    unit = 1.0 / (255.0 * 65536.0)
    low, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    red, blue, green_ = np.int64(red_blue & low), np.int64(red_blue >> half), np.int64(green)
    if share > 0:
        rest = 256 - share
        red = red * rest + np.int64(nearer & low) * share
        blue = blue * rest + np.int64(nearer >> half) * share
        green_ = green_ * rest + np.int64(farther) * share
        unit *= 1.0 / 256.0
    return red * unit, green_ * unit, blue * unit


@leaf
def repeating_level(texels, table, texture, level, s, t):
    """`blend_of_four` at (s, t) of a level of a repeating texture."""
    entry = FIRST + 3 * level
    columns = table[texture, entry + 1]
    left, right, across = repeated(s, columns)
    top, bottom, down = repeated(t, table[texture, entry + 2])
    base = table[texture, entry]
    return blend_of_four(texels, base + top * columns, base + bottom * columns, left, right, across, down)


@part
def sample_repeating(texels, table, texture, s, t, rho_squared):
    """Color of a repeating texture at (s, t), for a squared footprint in texels."""
    level, share = level_of_detail(rho_squared)
    last = table[texture, LEVELS] - 1
    if level >= last:
        level, share = last, 0
    red_blue, green = repeating_level(texels, table, texture, level, s, t)
    more, more_green = np.uint64(0), np.uint64(0)
    if share > 0:
        more, more_green = repeating_level(texels, table, texture, level + 1, s, t)
    return unpacked(red_blue, green, more, more_green, share)


@leaf
def cube_face(x, y, z):
    """Face of a cube map, its two coordinates' numerators and the length that divides them (OpenGL's table)."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if az >= ax and az >= ay:
        return (4, x, -y, az) if z >= 0.0 else (5, -x, -y, az)
    if ax > ay:
        return (0, -z, -y, ax) if x >= 0.0 else (1, z, -y, ax)
    return (2, x, z, ay) if y >= 0.0 else (3, x, -z, ay)


@leaf
def face_change(face, dx, dy, dz):
    """How the numerators and the length of a face change with the direction."""
    if face == 0:
        return -dz, -dy, dx
    if face == 1:
        return dz, -dy, -dx
    if face == 2:
        return dx, dz, dy
    if face == 3:
        return dx, -dz, -dy
    if face == 4:
        return dx, -dy, dz
    return -dx, -dy, -dz


@leaf
def cube_level(texels, table, texture, level, face, s, t):
    """`blend_of_four` at (s, t) in [0, 1] of a face of a level of a cube map."""
    entry = FIRST + 3 * level
    side = table[texture, entry + 1]
    left, right, across = clamped(s, side)
    top, bottom, down = clamped(t, side)
    base = table[texture, entry]
    if table[texture, FACES] > 1:
        base += face * side * side
    return blend_of_four(texels, base + top * side, base + bottom * side, left, right, across, down)


@part
def sample_cube(texels, table, texture, x, y, z, ux, uy, uz, vx, vy, vz):
    """Color of a cube map in direction (x, y, z), changing by u from pixel to pixel in a row, by v upwards."""
    face, s, t, major = cube_face(x, y, z)
    over = 1.0 / major
    s, t = s * over, t * over
    us, ut, um = face_change(face, ux, uy, uz)
    vs, vt, vm = face_change(face, vx, vy, vz)
    most = max(max(abs(us - s * um), abs(ut - t * um)), max(abs(vs - s * vm), abs(vt - t * vm)))
    rho = 0.5 * table[texture, FIRST + 1] * most * over
    level, share = level_of_detail(rho * rho)
    last = table[texture, LEVELS] - 1
    if level >= last:
        level, share = last, 0
    s, t = 0.5 * s + 0.5, 0.5 * t + 0.5
    red_blue, green = cube_level(texels, table, texture, level, face, s, t)
    more, more_green = np.uint64(0), np.uint64(0)
    if share > 0:
        more, more_green = cube_level(texels, table, texture, level + 1, face, s, t)
    return unpacked(red_blue, green, more, more_green, share)
