"""A surface and a pixel in, colors out: of the headlight's pass and of the lamp's, which OpenGL draws after it."""

from __future__ import annotations

import math

from dmcvb_gen.rendering.native.lighting import (
    headlight_terms,
    in_shadow,
    lamp_on_plane,
    lamp_terms,
    lit,
)
from dmcvb_gen.rendering.native.records import (
    AXIS,
    CONE,
    EXPONENT,
    EYE,
    FIRST,
    FUNCTIONS,
    HEADLIGHT,
    KIND,
    LAMP,
    MIRRORED,
    MIRRORED_AXIS,
    MIRRORED_PLACE,
    OPACITY,
    PLACE,
    QUAD,
    REFLECTANCE,
    REPEAT,
    RGB,
    SHARE,
    SIZE,
    SKY,
    SPOT,
    STEP,
    TEXTURE,
    TURN,
    VIEW,
)
from dmcvb_gen.rendering.native.sampling import leaf, part, sample_cube, sample_repeating
from dmcvb_gen.rendering.native.scene import CAPSULE, OPAQUE


@leaf
def ray_of(step, pixels, row, column):
    """x and y of the ray through a pixel's center."""
    half = 0.5 * pixels
    return (column + 0.5 - half) * step, (half - row - 0.5) * step


@leaf
def quad_ray(step, pixels, row, column):
    """The ray of the first pixel of the two by two in which OpenGL takes differences (to the right, and up)."""
    last = pixels - 1
    return ray_of(step, pixels, last - ((last - row) & ~1), column & ~1)


@leaf
def place_on_plane(rec, g, x, y):
    """A plane's coordinates, over its half lengths, where the ray (x, y) meets it."""
    at = FUNCTIONS
    over = 1.0 / max(rec[g, at] * x + rec[g, at + 1] * y + rec[g, at + 2], 1e-9)
    return (
        (rec[g, at + 3] * x + rec[g, at + 4] * y + rec[g, at + 5]) * over,
        (rec[g, at + 6] * x + rec[g, at + 7] * y + rec[g, at + 8]) * over,
    )


@leaf
def texel_on_plane(k, rec, texels, table, g, pixels, row, column, a, b):
    """Color of a plane's texture at a pixel, (a, b) being the place on it over its half lengths."""
    texture = int(rec[g, TEXTURE])
    if texture < 0:
        return 1.0, 1.0, 1.0
    scale_a, scale_b = rec[g, REPEAT] * rec[g, SIZE], rec[g, REPEAT + 1] * rec[g, SIZE + 1]
    quad = ((row + (pixels & 1)) >> 1) * pixels + (column >> 1)
    if k[QUAD] != quad or k[QUAD + 1] != g:  # else as for the pixel before
        step = k[STEP]
        x, y = quad_ray(step, pixels, row, column)
        a0, b0 = place_on_plane(rec, g, x, y)
        a1, b1 = place_on_plane(rec, g, x + step, y)
        a2, b2 = place_on_plane(rec, g, x, y + step)
        rho = max(
            max(abs(a1 - a0), abs(a2 - a0)) * scale_a * table[texture, FIRST + 1],
            max(abs(b1 - b0), abs(b2 - b0)) * scale_b * table[texture, FIRST + 2],
        )
        k[QUAD], k[QUAD + 1], k[QUAD + 2] = quad, g, rho * rho
    return sample_repeating(texels, table, texture, scale_a * (1.0 + a), scale_b * (1.0 - b), k[QUAD + 2])


@part
def shade_plane(k, rec, texels, table, grid, vertices, g, pixels, row, column):
    """(red, green, blue) of plane g in the headlight's pass, then in the lamp's."""
    x, y = ray_of(k[STEP], pixels, row, column)
    a, b = place_on_plane(rec, g, x, y)
    red, green, blue = texel_on_plane(k, rec, texels, table, g, pixels, row, column, a, b)
    along, across = a * rec[g, SIZE], b * rec[g, SIZE + 1]
    px = rec[g, PLACE] + along * rec[g, TURN] + across * rec[g, TURN + 1]
    py = rec[g, PLACE + 1] + along * rec[g, TURN + 3] + across * rec[g, TURN + 4]
    pz = rec[g, PLACE + 2] + along * rec[g, TURN + 6] + across * rec[g, TURN + 7]
    exponent = int(rec[g, EXPONENT])
    diffuse, specular = headlight_terms(k, EYE, px, py, pz, rec[g, AXIS], rec[g, AXIS + 1], rec[g, AXIS + 2], exponent)
    specular *= rec[g, SHARE]
    lamp_red, lamp_green, lamp_blue = 0.0, 0.0, 0.0
    if k[CONE] > 0.0:
        lamp_red, lamp_green, lamp_blue = lamp_on_plane(k, grid, vertices, along, across)
        # Only opaque surfaces show shadows.
        if lamp_red + lamp_green + lamp_blue > 0.0 and rec[g, OPACITY] >= OPAQUE and in_shadow(k, rec, px, py, pz, g):
            lamp_red, lamp_green, lamp_blue = 0.0, 0.0, 0.0
    return (
        red * min(lit(k, HEADLIGHT, 0, rec[g, RGB], 1.0, diffuse, specular), 1.0),
        green * min(lit(k, HEADLIGHT, 1, rec[g, RGB + 1], 1.0, diffuse, specular), 1.0),
        blue * min(lit(k, HEADLIGHT, 2, rec[g, RGB + 2], 1.0, diffuse, specular), 1.0),
        red * lamp_red,
        green * lamp_green,
        blue * lamp_blue,
    )


@part
def meet_body(rec, g, place, axis, x, y):
    """Depth and outward unit normal where the ray (x, y, -1) meets a body, or at its outline if it passes by.

    Args:
      place, axis: the columns of `rec` where its center and axis are.
    """
    ox, oy, oz = rec[g, place], rec[g, place + 1], rec[g, place + 2]
    radius = rec[g, SIZE]
    if rec[g, KIND] == CAPSULE:
        ax, ay, az, half = rec[g, axis], rec[g, axis + 1], rec[g, axis + 2], rec[g, SIZE + 1]
        mx, my, mz = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
        moment = mx * mx + my * my + mz * mz - radius * radius
        along_axis = ox * ax + oy * ay + oz * az
        reach = half if along_axis < 0.0 else -half
        if moment > 0.0:
            nx, ny, nz = y * az + ay, -ax - x * az, x * ay - y * ax
            turned = mx * x + my * y - mz
            square = max(radius * radius * (nx * nx + ny * ny + nz * nz) - turned * turned, 0.0)
            depth = moment / (mx * nx + my * ny + mz * nz + math.sqrt(square))
            along = (ax * x + ay * y - az) * depth - along_axis
            if abs(along) <= half:
                return unit_normal(depth, x, y, ox + along * ax, oy + along * ay, oz + along * az)
            reach = half if along > 0.0 else -half
        ox, oy, oz = ox + reach * ax, oy + reach * ay, oz + reach * az
    ux, uy, uz = -oy - oz * y, oz * x + ox, ox * y - oy * x
    square = max(radius * radius * (1.0 + x * x + y * y) - (ux * ux + uy * uy + uz * uz), 0.0)
    depth = (ox * ox + oy * oy + oz * oz - radius * radius) / (ox * x + oy * y - oz + math.sqrt(square))
    return unit_normal(depth, x, y, ox, oy, oz)


@leaf
def unit_normal(depth, x, y, ox, oy, oz):
    """The depth, and the direction from o to the point at that depth of the ray (x, y)."""
    nx, ny, nz = depth * x - ox, depth * y - oy, -depth - oz
    over = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return depth, nx * over, ny * over, nz * over


@leaf
def own_direction(rec, g, nx, ny, nz):
    """A direction in geom g's own frame."""
    return (
        rec[g, TURN] * nx + rec[g, TURN + 3] * ny + rec[g, TURN + 6] * nz,
        rec[g, TURN + 1] * nx + rec[g, TURN + 4] * ny + rec[g, TURN + 7] * nz,
        rec[g, TURN + 2] * nx + rec[g, TURN + 5] * ny + rec[g, TURN + 8] * nz,
    )


@part
def ball_direction(rec, g, x, y):
    """Where the ray (x, y) meets ball g, as a direction in the ball's own frame."""
    _, nx, ny, nz = meet_body(rec, g, PLACE, AXIS, x, y)
    return own_direction(rec, g, nx, ny, nz)


@part
def texel_on_ball(k, rec, texels, table, g, pixels, row, column, nx, ny, nz):
    """Color of the cube map around ball g at a pixel with a normal."""
    texture = int(rec[g, TEXTURE])
    if texture < 0:
        return 1.0, 1.0, 1.0
    step = k[STEP]
    x, y, z = own_direction(rec, g, nx, ny, nz)
    qx, qy = quad_ray(step, pixels, row, column)
    ax, ay, az = ball_direction(rec, g, qx, qy)
    bx, by, bz = ball_direction(rec, g, qx + step, qy)
    cx, cy, cz = ball_direction(rec, g, qx, qy + step)
    return sample_cube(texels, table, texture, x, y, z, bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az)


@part
def shade_body(k, rec, texels, table, g, pixels, row, column, mirrored):
    """(red, green, blue) of body g in the headlight's pass, then in the lamp's; of its mirror image if asked for."""
    place, axis = (MIRRORED_PLACE, MIRRORED_AXIS) if mirrored else (PLACE, AXIS)
    eye, lamp = (MIRRORED, MIRRORED + 3) if mirrored else (EYE, LAMP)
    tint = k[REFLECTANCE] if mirrored else 1.0  # dims color, but no highlight
    x, y = ray_of(k[STEP], pixels, row, column)
    depth, nx, ny, nz = meet_body(rec, g, place, axis, x, y)
    px, py, pz = depth * x, depth * y, -depth
    share, exponent = rec[g, SHARE], int(rec[g, EXPONENT])
    diffuse, specular = headlight_terms(k, eye, px, py, pz, nx, ny, nz, exponent)
    specular *= share
    factor, lamp_diffuse, lamp_specular = 0.0, 0.0, 0.0
    if k[CONE] > 0.0:
        factor, lamp_diffuse, lamp_specular = lamp_terms(k, lamp, px, py, pz, nx, ny, nz, exponent)
        lamp_specular *= share
        if factor * lamp_diffuse > 0.0 and not mirrored and in_shadow(k, rec, px, py, pz, g):
            factor = 0.0
    red, green, blue = texel_on_ball(k, rec, texels, table, g, pixels, row, column, nx, ny, nz)
    own_red, own_green, own_blue = tint * rec[g, RGB], tint * rec[g, RGB + 1], tint * rec[g, RGB + 2]
    return (
        red * min(lit(k, HEADLIGHT, 0, own_red, 1.0, diffuse, specular), 1.0),
        green * min(lit(k, HEADLIGHT, 1, own_green, 1.0, diffuse, specular), 1.0),
        blue * min(lit(k, HEADLIGHT, 2, own_blue, 1.0, diffuse, specular), 1.0),
        red * min(lit(k, SPOT, 0, own_red, factor, lamp_diffuse, lamp_specular), 1.0),
        green * min(lit(k, SPOT, 1, own_green, factor, lamp_diffuse, lamp_specular), 1.0),
        blue * min(lit(k, SPOT, 2, own_blue, factor, lamp_diffuse, lamp_specular), 1.0),
    )


@part
def shade_sky(k, texels, table, pixels, row, column):
    """(red, green, blue) of the sky: a cube of pictures around the eye, turned by 90 degrees around x."""
    texture = int(k[SKY])
    if texture < 0:
        return 0.0, 0.0, 0.0
    step = k[STEP]
    x, y = ray_of(step, pixels, row, column)
    v = VIEW
    return sample_cube(
        texels,
        table,
        texture,
        k[v] * x + k[v + 1] * y - k[v + 2],
        k[v + 6] * x + k[v + 7] * y - k[v + 8],
        -(k[v + 3] * x + k[v + 4] * y - k[v + 5]),
        k[v] * step,
        k[v + 6] * step,
        -k[v + 3] * step,
        k[v + 1] * step,
        k[v + 7] * step,
        -k[v + 4] * step,
    )
