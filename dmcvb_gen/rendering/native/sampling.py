"""Colors of textures at coordinates, with mip levels and weights as OpenGL on a CPU (Mesa's llvmpipe) has them.

Everything works on rows of `layout`. Texels and weights are whole numbers below 2^24, which float32 holds exactly.
"""

from __future__ import annotations

import numpy as np

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native.layout import distinct, get, get3, leaf, part, put, put3

f4, i4 = np.float32, np.int32
SHARE_UNIT = 1.0 / (255.0 * 65536.0 * 256.0)
"""Of a channel in a byte, times the weights of a texel, times 256ths of a level: the color in [0, 1]."""


@part
def fill(s, n, row, value):
    """Set a row of `layout`."""
    for i in range(n):
        put(s, row + i, value)


@part
def choose_levels(s, n, last):
    """Compute LEVEL and its share MIX from FOOTPRINT, and clear the color. Return True if any place mixes two levels.

    The logarithm is linear between powers of two, and a level is taken alone within a quarter of it: llvmpipe's
    "brilinear" choice.

    Args:
      last: the coarsest level.
    """
    distinct()
    most = i4(0)
    for i in range(n):
        rho = get(s, L.FOOTPRINT + i)
        bits = f4(rho).view(i4)
        power, rest = f4(i4((bits >> i4(23)) - i4(127))), f4(i4(bits & i4(0x7FFFFF))) * f4(1.0 / 0x800000)
        lod = f4(0.5) * (power + rest) + f4(0.25)
        lod = lod if rho > f4(1) else f4(0)
        level = i4(lod)
        share = np.floor(f4(256) * max(f4(2) * (lod - f4(level)) - f4(1), f4(0)))
        share = share if level < last else f4(0)
        put(s, L.LEVEL + i, f4(min(level, i4(last))))
        put(s, L.MIX + i, share)
        put3(s, L.TEXEL + i, f4(0), f4(0), f4(0))
        most = max(most, i4(share))
    return most > 0


@leaf
def blend(one, two, three, four, across, down, shift):
    """Channel of four texels (top left, top right, bottom left, bottom right), times 65536.

    Args:
      shift: bits below the channel; `across`, `down`: weights of right and bottom in 1/256.
    """
    a, b = f4(i4((one >> shift) & i4(255))), f4(i4((two >> shift) & i4(255)))
    c, d = f4(i4((three >> shift) & i4(255))), f4(i4((four >> shift) & i4(255)))
    left, top = f4(256) - across, f4(256) - down
    return (a * left + b * across) * top + (c * left + d * across) * down


@part
def add_level(s, n, texels, at, repeats, many, last, further, weight, slope):
    """Add one level's color at (S, T) to TEXEL, `weight + slope * MIX` times.

    Args:
      at: where in `texels` the table of textures has the texture's first level; `further`: 1 for the coarser level.
      repeats: the texture repeats; else its coordinates end at an edge, as those of a cube map's face.
      many: 1 if a cube map's faces differ, else 0.
    """
    distinct()
    for i in range(n):
        entry = at + 3 * min(i4(get(s, L.LEVEL + i)) + further, last)
        base, columns, rows = get(texels, entry), get(texels, entry + 1), get(texels, entry + 2)
        x, y = get(s, L.S + i), get(s, L.T + i)
        x, y = x - np.floor(x) if repeats else x, y - np.floor(y) if repeats else y
        x, y = x * f4(columns) + f4(0.5), y * f4(rows) + f4(0.5)
        right, bottom = i4(x), i4(y)
        across, down = np.floor(f4(256) * (x - f4(right))), np.floor(f4(256) * (y - f4(bottom)))
        left, top = i4(right - i4(1)), i4(bottom - i4(1))
        far_right, far_bottom = i4(columns - i4(1)), i4(rows - i4(1))
        left = left if left >= 0 else (far_right if repeats else i4(0))
        top = top if top >= 0 else (far_bottom if repeats else i4(0))
        right = right if right < columns else (i4(0) if repeats else far_right)
        bottom = bottom if bottom < rows else (i4(0) if repeats else far_bottom)
        base = i4(base + i4(many * i4(get(s, L.FACE + i))) * i4(columns * rows))
        share = (weight + slope * get(s, L.MIX + i)) * f4(SHARE_UNIT)
        top, bottom = i4(base + i4(top * columns)), i4(base + i4(bottom * columns))
        one, two = get(texels, i4(top + left)), get(texels, i4(top + right))
        three, four = get(texels, i4(bottom + left)), get(texels, i4(bottom + right))
        red, green, blue = get3(s, L.TEXEL + i)
        red += share * blend(one, two, three, four, across, down, i4(0))
        green += share * blend(one, two, three, four, across, down, i4(8))
        blue += share * blend(one, two, three, four, across, down, i4(16))
        put3(s, L.TEXEL + i, red, green, blue)


@leaf
def turn_to_face(along_z, along_x, sign, x, y, z):
    """Return a direction's (or its change's) two coordinates and length towards a face of a cube map (OpenGL's table).

    Args:
      along_z, along_x: the pair of faces, neither for y; `sign`: 1 or -1, which of the two.
    """
    across = x if not along_x else -sign * z
    across = sign * x if along_z else across
    upwards = -y if along_z or along_x else sign * z
    length = z if along_z else (x if along_x else y)
    return across, upwards, sign * length


@part
def face_cube(s, n, half):
    """Compute FACE, coordinates S, T in [0, 1] and FOOTPRINT from a direction and its changes.

    Args:
      half: half the texels a side of the finest level.
    """
    distinct()
    for i in range(n):
        x, y, z = get3(s, L.DIRECTION + i)
        ax, ay, az = abs(x), abs(y), abs(z)
        along_z = (az >= ax) & (az >= ay)
        along_x = (not along_z) & (ax > ay)
        chosen = z if along_z else (x if along_x else y)
        sign = f4(1) if chosen >= f4(0) else f4(-1)
        across, upwards, length = turn_to_face(along_z, along_x, sign, x, y, z)
        over = f4(1) / length
        across, upwards = across * over, upwards * over
        x, y, z = get3(s, L.RIGHT + i)
        a, b, c = turn_to_face(along_z, along_x, sign, x, y, z)
        x, y, z = get3(s, L.UP + i)
        d, e, f = turn_to_face(along_z, along_x, sign, x, y, z)
        most = max(max(abs(a - across * c), abs(b - upwards * c)), max(abs(d - across * f), abs(e - upwards * f)))
        rho = half * most * over
        first = f4(4) if along_z else (f4(0) if along_x else f4(2))
        put(s, L.FACE + i, first if sign > f4(0) else first + f4(1))
        put(s, L.S + i, min(max(f4(0.5) * across + f4(0.5), f4(0)), f4(1)))
        put(s, L.T + i, min(max(f4(0.5) * upwards + f4(0.5), f4(0)), f4(1)))
        put(s, L.FOOTPRINT + i, rho * rho)


@part
def sample(s, n, texels, width, texture, repeats):
    """Sample a texture that repeats at S, T with FOOTPRINT, or a cube map in a direction with its changes to the
    right and upwards.

    Args:
      texels: the table of textures, and the textures; `width` of the table's rows.
    """
    at = texture * width
    last, many = i4(texels[at + L.LEVELS] - 1), i4(1 if texels[at + L.FACES] > 1 else 0)
    if not repeats:
        face_cube(s, n, f4(0.5) * f4(texels[at + L.FIRST + 1]))
    mixed = choose_levels(s, n, last)
    add_level(s, n, texels, at + L.FIRST, repeats, many, last, i4(0), f4(256), f4(-1))
    if mixed:
        add_level(s, n, texels, at + L.FIRST, repeats, many, last, i4(1), f4(0), f4(1))
