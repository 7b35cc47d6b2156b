"""Colors of a surface in some pixels: the headlight's pass, then the lamp's, as OpenGL draws them.

Works on rows of `lanes`: `aim` fills the rays, `shade_body` or `shade_plane` everything else, and `cover_*` lays the
color over what BASE_RED and the others hold.
"""

from __future__ import annotations

import math

import numpy as np

from dmcvb_gen.rendering.native.lanes import (
    BASE_BLUE,
    BASE_GREEN,
    BASE_RED,
    BLUE,
    CHUNK,
    CONE_FACTOR,
    DX,
    FOOTPRINT,
    GREEN,
    HEAD,
    HEAD_SHINE,
    LAMP_BLUE,
    LAMP_DIFFUSE,
    LAMP_GREEN,
    LAMP_RED,
    LAMP_SHINE,
    LIGHT,
    NX,
    NY,
    NZ,
    PX,
    PY,
    PZ,
    QUAD_X,
    QUAD_Y,
    RAY_X,
    RAY_Y,
    RED,
    RIGHT_X,
    UP_X,
    S,
    T,
    U,
    V,
    X,
    Y,
    distinct,
    get,
    part,
    put,
    stage,
)
from dmcvb_gen.rendering.native.lighting import (
    cast_shadows,
    head_light,
    lamp_everywhere,
    lamp_light,
    lamp_on_plane,
    raise_lights,
    raise_row,
)
from dmcvb_gen.rendering.native.records import (
    AXIS,
    CONE,
    EXPONENT,
    EYE,
    FIRST,
    FUNCTIONS,
    GRIDDED,
    HEADLIGHT,
    KIND,
    LAMP,
    MIRRORED,
    MIRRORED_AXIS,
    MIRRORED_PLACE,
    MIRRORED_TURN,
    OPACITY,
    PLACE,
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
from dmcvb_gen.rendering.native.sampling import fill, sample_cube, sample_repeating
from dmcvb_gen.rendering.native.scene import CAPSULE, CYLINDER, OPAQUE, SPHERE
from dmcvb_gen.rendering.native.visibility import half_length, own_origin, through_solid

f4, i4, i8 = np.float32, np.int32, np.int64


@part
def aim(s, n, jobs, room, first, pixels, step):
    """Rays through the pixels of n jobs, and through the first pixels of the two by two where footprints are taken.

    Args:
      jobs: int32, rows, from `room` on columns of all jobs, and from `first` on the numbers of these.
    """
    distinct()
    half, last, step = f4(0.5 * pixels), i4(pixels - 1), f4(step)
    for i in range(n):
        job = get(jobs, first + i)
        row, column = get(jobs, job), get(jobs, job + room)
        quad_row, quad_column = i4(last - i4(i4(last - row) & i4(-2))), i4(column & i4(-2))
        put(s, X + i, (f4(column) + f4(0.5) - half) * step)
        put(s, Y + i, (half - f4(row) - f4(0.5)) * step)
        put(s, QUAD_X + i, (f4(quad_column) + f4(0.5) - half) * step)
        put(s, QUAD_Y + i, (half - f4(quad_row) - f4(0.5)) * step)


# -- planes ----------------------------------------------------------------------------------------


@part
def meet_plane(s, n, rec, g, step, wide, high):
    """Find where rays meet plane g: points, places U and V, texture coordinates S and T, and FOOTPRINT.

    Args:
      wide, high: texels of its texture.
    """
    distinct()
    at, one, least = FUNCTIONS, f4(1), f4(1e-9)
    a, b, c = f4(rec[g, at]), f4(rec[g, at + 1]), f4(rec[g, at + 2])
    ua, ub, uc = f4(rec[g, at + 3]), f4(rec[g, at + 4]), f4(rec[g, at + 5])
    va, vb, vc = f4(rec[g, at + 6]), f4(rec[g, at + 7]), f4(rec[g, at + 8])
    scale_u, scale_v = f4(rec[g, REPEAT] * rec[g, SIZE]), f4(rec[g, REPEAT + 1] * rec[g, SIZE + 1])
    texels_u, texels_v, step = scale_u * f4(wide), scale_v * f4(high), f4(step)
    for i in range(n):
        x, y = get(s, X + i), get(s, Y + i)
        depth = one / max(a * x + b * y + c, least)
        u, v = (ua * x + ub * y + uc) * depth, (va * x + vb * y + vc) * depth
        put(s, PX + i, x * depth)
        put(s, PY + i, y * depth)
        put(s, PZ + i, -depth)
        put(s, U + i, u)
        put(s, V + i, v)
        put(s, S + i, scale_u * (one + u))
        put(s, T + i, scale_v * (one - v))
        x, y = get(s, QUAD_X + i), get(s, QUAD_Y + i)
        w, u, v = a * x + b * y + c, ua * x + ub * y + uc, va * x + vb * y + vc
        over = one / max(w, least)
        right, up = one / max(w + a * step, least), one / max(w + b * step, least)
        u0, v0 = u * over, v * over
        across = max(abs((u + ua * step) * right - u0), abs((u + ub * step) * up - u0)) * texels_u
        down = max(abs((v + va * step) * right - v0), abs((v + vb * step) * up - v0)) * texels_v
        rho = max(across, down)
        put(s, FOOTPRINT + i, rho * rho)


@stage
def shade_plane(s, n, k, rec, texels, width, plane, g, mirrored, tint):
    """Compute texture, headlight and lamp (LAMP_RED etc., LIGHT) on plane g, or its mirror image, along rays."""
    texture = int(rec[g, TEXTURE])
    at = max(texture, 0) * width + FIRST
    meet_plane(s, n, rec, g, k[STEP], texels[at + 1], texels[at + 2])
    if texture >= 0:
        sample_repeating(s, n, texels, width, texture)
    else:
        for c in range(3):
            fill(s, n, RED + c * CHUNK, f4(1))
    for axis in range(3):
        fill(s, n, NX + axis * CHUNK, f4(rec[g, AXIS + axis]))
    exponent = int(rec[g, EXPONENT])
    head_light(s, n, k, i8(MIRRORED if mirrored else EYE), exponent)
    fill(s, n, i8(LIGHT), f4(0))
    if k[CONE] > 0.0:
        if rec[g, GRIDDED] > 0.0 and not mirrored:
            lit = lamp_on_plane(s, n, k, rec, plane, g)
        else:
            lamp_light(s, n, k, i8(MIRRORED + 3 if mirrored else LAMP), exponent)
            lamp_everywhere(s, n, k, rec, g, exponent, tint)
            lit = not mirrored
        if lit and rec[g, OPACITY] >= OPAQUE:
            cast_shadows(s, n, k, rec, g)  # only opaque surfaces show them
    raise_row(s, n, i8(HEAD_SHINE), exponent)


@part
def cover_plane(s, n, k, rec, g, veil, further, tint):
    """Lay plane g over the base colors; with `veil` below 1 blended with them.

    Args:
      veil: share of the base colors that is hidden.
      tint: dims its color, but no highlight.
      further: the first lamp has been laid over them already, and this is the light of another one.
    """
    distinct()
    share, hidden, one = f4(rec[g, SHARE]), f4(veil), f4(1)
    own_r, own_g, own_b = f4(tint * rec[g, RGB]), f4(tint * rec[g, RGB + 1]), f4(tint * rec[g, RGB + 2])
    at = HEADLIGHT
    flat_r, flat_g, flat_b = own_r * f4(k[at]), own_g * f4(k[at + 1]), own_b * f4(k[at + 2])
    matt_r, matt_g, matt_b = own_r * f4(k[at + 3]), own_g * f4(k[at + 4]), own_b * f4(k[at + 5])
    spec_r, spec_g, spec_b = share * f4(k[at + 6]), share * f4(k[at + 7]), share * f4(k[at + 8])
    veiled = hidden < one
    for i in range(n):
        diffuse, shine, light = get(s, HEAD + i), get(s, HEAD_SHINE + i), get(s, LIGHT + i)
        red, green, blue = get(s, RED + i), get(s, GREEN + i), get(s, BLUE + i)
        lit_r = red * get(s, LAMP_RED + i) if light > f4(0) else f4(0)
        lit_g = green * get(s, LAMP_GREEN + i) if light > f4(0) else f4(0)
        lit_b = blue * get(s, LAMP_BLUE + i) if light > f4(0) else f4(0)
        red = red * min(flat_r + matt_r * diffuse + spec_r * shine, one)
        green = green * min(flat_g + matt_g * diffuse + spec_g * shine, one)
        blue = blue * min(flat_b + matt_b * diffuse + spec_b * shine, one)
        base_r, base_g, base_b = get(s, BASE_RED + i), get(s, BASE_GREEN + i), get(s, BASE_BLUE + i)
        if veiled and further:
            red, green, blue = base_r + lit_r * hidden, base_g + lit_g * hidden, base_b + lit_b * hidden
            red, green, blue = min(red, one), min(green, one), min(blue, one)
        elif veiled:
            red = base_r * (one - hidden) + min(red + lit_r, one) * hidden
            green = base_g * (one - hidden) + min(green + lit_g, one) * hidden
            blue = base_b * (one - hidden) + min(blue + lit_b, one) * hidden
        else:
            red = min(min(base_r + red, one) + lit_r, one)
            green = min(min(base_g + green, one) + lit_g, one)
            blue = min(min(base_b + blue, one) + lit_b, one)
        put(s, BASE_RED + i, red)
        put(s, BASE_GREEN + i, green)
        put(s, BASE_BLUE + i, blue)


# -- bodies ----------------------------------------------------------------------------------------


@part
def meet_body(s, n, rec, g, place, axis):
    """Compute points and unit normals where the rays RAY_X, RAY_Y meet ball or capsule g, or at its outline
    where they pass by.

    Args:
      place, axis: the columns of `rec` where its center and axis are.
    """
    distinct()
    ox, oy, oz = rec[g, place], rec[g, place + 1], rec[g, place + 2]
    ax, ay, az = rec[g, axis], rec[g, axis + 1], rec[g, axis + 2]
    half, radius = rec[g, SIZE + 1] if rec[g, KIND] == CAPSULE else 0.0, rec[g, SIZE]
    mx, my, mz = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
    moment, center = mx * mx + my * my + mz * mz - radius * radius, ox * ax + oy * ay + oz * az
    inside = ox * ox + oy * oy + oz * oz - radius * radius + half * half  # of the balls, less 2 * reach * center
    outside, nearer, rr = moment > 0.0, center < 0.0, f4(radius * radius)
    upper, lower = f4(inside + 2.0 * half * center), f4(inside - 2.0 * half * center)
    mx, my, mz, moment, center = f4(mx), f4(my), f4(mz), f4(moment), f4(center)
    ox, oy, oz, ax, ay, az, half, zero = f4(ox), f4(oy), f4(oz), f4(ax), f4(ay), f4(az), f4(half), f4(0)
    for i in range(n):
        x, y = get(s, RAY_X + i), get(s, RAY_Y + i)
        nx, ny, nz = y * az + ay, -ax - x * az, x * ay - y * ax
        turned = mx * x + my * y - mz
        square = max(rr * (nx * nx + ny * ny + nz * nz) - turned * turned, zero)
        depth = moment / (mx * nx + my * ny + mz * nz + math.sqrt(square))
        along = (ax * x + ay * y - az) * depth - center
        side = outside & (abs(along) <= half)
        end = (along > zero) if outside else nearer
        reach = half if end else -half
        ex, ey, ez = ox + reach * ax, oy + reach * ay, oz + reach * az
        ux, uy, uz = -ey - ez * y, ez * x + ex, ex * y - ey * x
        square = max(rr * (f4(1) + x * x + y * y) - (ux * ux + uy * uy + uz * uz), zero)
        ball = (upper if end else lower) / (ex * x + ey * y - ez + math.sqrt(square))
        depth = depth if side else ball
        cx, cy, cz = ox + along * ax if side else ex, oy + along * ay if side else ey, oz + along * az if side else ez
        px, py, pz = depth * x, depth * y, -depth
        nx, ny, nz = px - cx, py - cy, pz - cz
        over = f4(1) / math.sqrt(nx * nx + ny * ny + nz * nz)
        put(s, PX + i, px)
        put(s, PY + i, py)
        put(s, PZ + i, pz)
        put(s, NX + i, nx * over)
        put(s, NY + i, ny * over)
        put(s, NZ + i, nz * over)


@part
def meet_solid(s, n, rec, g, place, turn):
    """Do as `meet_body` for a cylinder, box or ellipsoid.

    Args:
      place, turn: the columns of `rec` where its center and its axes are.
    """
    distinct()
    kind = int(rec[g, KIND])
    ox, oy = (
        f4(own_origin(rec, g, place, turn, 0, 0.0, 0.0, 0.0)),
        f4(own_origin(rec, g, place, turn, 1, 0.0, 0.0, 0.0)),
    )
    oz, deep = f4(own_origin(rec, g, place, turn, 2, 0.0, 0.0, 0.0)), f4(0) if kind == CYLINDER else f4(1)
    a, b, c = 1.0 / half_length(rec, g, 0), 1.0 / half_length(rec, g, 1), 1.0 / half_length(rec, g, 2)
    a1, a2, a3 = f4(rec[g, turn]), f4(rec[g, turn + 3]), f4(rec[g, turn + 6])
    b1, b2, b3 = f4(rec[g, turn + 1]), f4(rec[g, turn + 4]), f4(rec[g, turn + 7])
    c1, c2, c3 = f4(rec[g, turn + 2]), f4(rec[g, turn + 5]), f4(rec[g, turn + 8])
    a, b, c, one = f4(a), f4(b), f4(c), f4(1)
    for i in range(n):
        x, y = get(s, RAY_X + i), get(s, RAY_Y + i)
        dx, dy, dz = a * (a1 * x + a2 * y - a3), b * (b1 * x + b2 * y - b3), c * (c1 * x + c2 * y - c3)
        enter, leave, face = through_solid(kind, ox, oy, oz, dx, dy, dz)
        depth = max(min(enter, leave), f4(1e-6))
        lx, ly, lz = a * (ox + dx * depth), b * (oy + dy * depth), deep * c * (oz + dz * depth)
        lx = lx if face == 0 else ((-one if dx > f4(0) else one) if face == 1 else f4(0))
        ly = ly if face == 0 else ((-one if dy > f4(0) else one) if face == 2 else f4(0))
        lz = lz if face == 0 else ((-one if dz > f4(0) else one) if face == 3 else f4(0))
        over = one / max(math.sqrt(lx * lx + ly * ly + lz * lz), f4(1e-12))
        put(s, PX + i, depth * x)
        put(s, PY + i, depth * y)
        put(s, PZ + i, -depth)
        put(s, NX + i, (a1 * lx + b1 * ly + c1 * lz) * over)
        put(s, NY + i, (a2 * lx + b2 * ly + c2 * lz) * over)
        put(s, NZ + i, (a3 * lx + b3 * ly + c3 * lz) * over)


@part
def meet(s, n, rec, g, mirrored):
    """Do as `meet_body` for any body or its mirror image."""
    if rec[g, KIND] == SPHERE or rec[g, KIND] == CAPSULE:
        meet_body(s, n, rec, g, i8(MIRRORED_PLACE if mirrored else PLACE), i8(MIRRORED_AXIS if mirrored else AXIS))
    else:
        meet_solid(s, n, rec, g, i8(MIRRORED_PLACE if mirrored else PLACE), i8(MIRRORED_TURN if mirrored else TURN))


@part
def turn_rays(s, n, source_x, source_y, dx, dy):
    """RAY_X and RAY_Y from two other rows, moved."""
    for i in range(n):
        put(s, RAY_X + i, get(s, source_x + i) + dx)
    for i in range(n):
        put(s, RAY_Y + i, get(s, source_y + i) + dy)


@part
def own_directions(s, n, rec, g, first, less):
    """Turn normals into geom g's own frame: into the three rows from `first` on, less those from `less` on."""
    for axis in range(3):
        a, b, c = f4(rec[g, TURN + axis]), f4(rec[g, TURN + 3 + axis]), f4(rec[g, TURN + 6 + axis])
        to, off = first + axis * CHUNK, less + axis * CHUNK
        for i in range(n):
            put(s, to + i, a * get(s, NX + i) + b * get(s, NY + i) + c * get(s, NZ + i))
        if less >= 0:
            for i in range(n):
                put(s, to + i, get(s, to + i) - get(s, off + i))


@stage
def cover_ball(s, n, k, rec, texels, width, g):
    """Sample the cube map around ball g along rays."""
    step = f4(k[STEP])
    turn_rays(s, n, i8(QUAD_X), i8(QUAD_Y), f4(0), f4(0))
    meet(s, n, rec, g, False)
    own_directions(s, n, rec, g, i8(DX), i8(-1))
    turn_rays(s, n, i8(QUAD_X), i8(QUAD_Y), step, f4(0))
    meet(s, n, rec, g, False)
    own_directions(s, n, rec, g, i8(RIGHT_X), i8(DX))
    turn_rays(s, n, i8(QUAD_X), i8(QUAD_Y), f4(0), step)
    meet(s, n, rec, g, False)
    own_directions(s, n, rec, g, i8(UP_X), i8(DX))
    turn_rays(s, n, i8(X), i8(Y), f4(0), f4(0))
    meet(s, n, rec, g, False)
    own_directions(s, n, rec, g, i8(DX), i8(-1))
    sample_cube(s, n, texels, width, int(rec[g, TEXTURE]))


@stage
def shade_body(s, n, k, rec, texels, width, g, mirrored):
    """Compute texture, headlight and lamp on body g, or on its mirror image, along rays."""
    exponent = int(rec[g, EXPONENT])
    turn_rays(s, n, i8(X), i8(Y), f4(0), f4(0))
    if rec[g, TEXTURE] >= 0.0:
        cover_ball(s, n, k, rec, texels, width, g)
    else:
        for c in range(3):
            fill(s, n, RED + c * CHUNK, f4(1))
    if mirrored:
        meet(s, n, rec, g, True)
    elif rec[g, TEXTURE] < 0.0:
        meet(s, n, rec, g, False)
    head_light(s, n, k, MIRRORED if mirrored else EYE, exponent)
    if k[CONE] > 0.0:
        lamp_light(s, n, k, MIRRORED + 3 if mirrored else LAMP, exponent)
        if not mirrored:
            cast_shadows(s, n, k, rec, g)
    else:
        fill(s, n, i8(LIGHT), f4(0))
    raise_lights(s, n, k, exponent)


@part
def cover_body(s, n, k, rec, g, tint):
    """Lay body g over the base colors.

    Args:
      tint: dims its color, but no highlight.
    """
    distinct()
    share, one, dim = f4(rec[g, SHARE]), f4(1), f4(tint)
    own_r, own_g, own_b = dim * f4(rec[g, RGB]), dim * f4(rec[g, RGB + 1]), dim * f4(rec[g, RGB + 2])
    at = HEADLIGHT
    flat_r, flat_g, flat_b = own_r * f4(k[at]), own_g * f4(k[at + 1]), own_b * f4(k[at + 2])
    matt_r, matt_g, matt_b = own_r * f4(k[at + 3]), own_g * f4(k[at + 4]), own_b * f4(k[at + 5])
    spec_r, spec_g, spec_b = share * f4(k[at + 6]), share * f4(k[at + 7]), share * f4(k[at + 8])
    at = SPOT
    lamp_r, lamp_g, lamp_b = own_r * f4(k[at]), own_g * f4(k[at + 1]), own_b * f4(k[at + 2])
    beam_r, beam_g, beam_b = own_r * f4(k[at + 3]), own_g * f4(k[at + 4]), own_b * f4(k[at + 5])
    glow_r, glow_g, glow_b = share * f4(k[at + 6]), share * f4(k[at + 7]), share * f4(k[at + 8])
    for i in range(n):
        diffuse, shine, light = get(s, HEAD + i), get(s, HEAD_SHINE + i), get(s, LIGHT + i)
        factor = get(s, CONE_FACTOR + i) if light > f4(0) else f4(0)
        lamp, glow = get(s, LAMP_DIFFUSE + i), get(s, LAMP_SHINE + i)
        red, green, blue = get(s, RED + i), get(s, GREEN + i), get(s, BLUE + i)
        lit_r = red * min(factor * (lamp_r + beam_r * lamp + glow_r * glow), one)
        lit_g = green * min(factor * (lamp_g + beam_g * lamp + glow_g * glow), one)
        lit_b = blue * min(factor * (lamp_b + beam_b * lamp + glow_b * glow), one)
        red = red * min(flat_r + matt_r * diffuse + spec_r * shine, one)
        green = green * min(flat_g + matt_g * diffuse + spec_g * shine, one)
        blue = blue * min(flat_b + matt_b * diffuse + spec_b * shine, one)
        put(s, BASE_RED + i, min(min(get(s, BASE_RED + i) + red, one) + lit_r, one))
        put(s, BASE_GREEN + i, min(min(get(s, BASE_GREEN + i) + green, one) + lit_g, one))
        put(s, BASE_BLUE + i, min(min(get(s, BASE_BLUE + i) + blue, one) + lit_b, one))


# -- sky -------------------------------------------------------------------------------------------


@part
def shade_sky(s, n, k, texels, width):
    """Compute base colors of the sky along rays: a cube of pictures around the eye, turned by 90 degrees around x."""
    texture, step = int(k[SKY]), k[STEP]
    if texture < 0:
        for c in range(3):
            fill(s, n, BASE_RED + c * CHUNK, f4(0))
        return
    for axis in range(3):
        view = VIEW + (0 if axis == 0 else 6 if axis == 1 else 3)
        sign = -1.0 if axis == 2 else 1.0
        a, b, c = f4(sign * k[view]), f4(sign * k[view + 1]), f4(sign * k[view + 2])
        to = DX + axis * CHUNK
        for i in range(n):
            put(s, to + i, a * get(s, X + i) + b * get(s, Y + i) - c)
        fill(s, n, RIGHT_X + axis * CHUNK, f4(sign * k[view] * step))
        fill(s, n, UP_X + axis * CHUNK, f4(sign * k[view + 1] * step))
    sample_cube(s, n, texels, width, texture)
    for c in range(3):
        for i in range(n):
            put(s, BASE_RED + c * CHUNK + i, get(s, RED + c * CHUNK + i))
