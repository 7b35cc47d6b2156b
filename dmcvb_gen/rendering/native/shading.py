"""Colors of a surface in some pixels: the headlight's pass, then the lamp's, as OpenGL draws them.

Works on rows of `layout`: `aim` fills the rays, `shade_body` or `shade_plane` everything else, and `cover` lays the
color over what BASE holds.
"""

from __future__ import annotations

import math

import numpy as np

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native import lighting
from dmcvb_gen.rendering.native.layout import distinct, get, get3, leaf, part, put, put3, stage
from dmcvb_gen.rendering.native.lighting import terms
from dmcvb_gen.rendering.native.sampling import fill, sample
from dmcvb_gen.rendering.native.scene import CAPSULE, CYLINDER, OPAQUE, PLANE, SPHERE
from dmcvb_gen.rendering.native.visibility import own_point, through_solid

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
        put(s, L.X + i, (f4(column) + f4(0.5) - half) * step)
        put(s, L.Y + i, (half - f4(row) - f4(0.5)) * step)
        put(s, L.QUAD_X + i, (f4(quad_column) + f4(0.5) - half) * step)
        put(s, L.QUAD_Y + i, (half - f4(quad_row) - f4(0.5)) * step)


@part
def light(s, n, k, rec, plane, g, mirrored):
    """Compute headlight and lamp (LAMP_COLOR, LIGHT) on geom g, or its mirror image, at points with normals."""
    exponent, lit = int(rec[g, L.EXPONENT]), not mirrored
    lighting.head_light(s, n, k, i8(L.MIRRORED if mirrored else L.EYE), exponent)
    fill(s, n, i8(L.LIGHT), f4(0))
    if k[L.CONE] > 0.0:
        if rec[g, L.GRIDDED] > 0.0 and not mirrored:
            lit = lighting.lamp_on_plane(s, n, k, rec, plane, g)
        else:
            lighting.lamp_light(s, n, k, i8(L.MIRRORED + 3 if mirrored else L.LAMP), exponent)
            lighting.lamp_everywhere(s, n, k, rec, g, exponent)
        if lit and (rec[g, L.KIND] != PLANE or rec[g, L.OPACITY] >= OPAQUE):
            lighting.cast_shadows(s, n, k, rec, g)  # only opaque surfaces show them
    lighting.raise_row(s, n, i8(L.HEADLIGHT_SPECULAR), exponent)


# -- planes ----------------------------------------------------------------------------------------


@part
def meet_plane(s, n, rec, g, step, wide, high):
    """Find where rays meet plane g: points, places U and V, texture coordinates S and T, and FOOTPRINT.

    Args:
      wide, high: texels of its texture.
    """
    distinct()
    at, one, least = L.FUNCTIONS, f4(1), f4(1e-9)
    a, b, c = f4(rec[g, at]), f4(rec[g, at + 1]), f4(rec[g, at + 2])
    ua, ub, uc = f4(rec[g, at + 3]), f4(rec[g, at + 4]), f4(rec[g, at + 5])
    va, vb, vc = f4(rec[g, at + 6]), f4(rec[g, at + 7]), f4(rec[g, at + 8])
    scale_u, scale_v = f4(rec[g, L.REPEAT] * rec[g, L.SIZE]), f4(rec[g, L.REPEAT + 1] * rec[g, L.SIZE + 1])
    texels_u, texels_v, step = scale_u * f4(wide), scale_v * f4(high), f4(step)
    for i in range(n):
        x, y = get(s, L.X + i), get(s, L.Y + i)
        depth = one / max(a * x + b * y + c, least)
        u, v = (ua * x + ub * y + uc) * depth, (va * x + vb * y + vc) * depth
        put3(s, L.POINT + i, x * depth, y * depth, -depth)
        put(s, L.U + i, u)
        put(s, L.V + i, v)
        put(s, L.S + i, scale_u * (one + u))
        put(s, L.T + i, scale_v * (one - v))
        x, y = get(s, L.QUAD_X + i), get(s, L.QUAD_Y + i)
        w, u, v = a * x + b * y + c, ua * x + ub * y + uc, va * x + vb * y + vc
        over = one / max(w, least)
        right, up = one / max(w + a * step, least), one / max(w + b * step, least)
        u0, v0 = u * over, v * over
        across = max(abs((u + ua * step) * right - u0), abs((u + ub * step) * up - u0)) * texels_u
        down = max(abs((v + va * step) * right - v0), abs((v + vb * step) * up - v0)) * texels_v
        rho = max(across, down)
        put(s, L.FOOTPRINT + i, rho * rho)


@stage
def shade_plane(s, n, k, rec, texels, width, plane, g, mirrored):
    """Compute texture, headlight and lamp (LAMP_COLOR, LIGHT) on plane g, or its mirror image, along rays."""
    texture = int(rec[g, L.TEXTURE])
    at = max(texture, 0) * width + L.FIRST
    meet_plane(s, n, rec, g, k[L.STEP], texels[at + 1], texels[at + 2])
    if texture >= 0:
        sample(s, n, texels, width, texture, True)
    else:
        for c in range(3):
            fill(s, n, L.TEXEL + c * L.CHUNK, f4(1))
    for axis in range(3):
        fill(s, n, L.NORMAL + axis * L.CHUNK, f4(rec[g, L.AXIS + axis]))
    light(s, n, k, rec, plane, g, mirrored)


@part
def set_color(k, rec, g, tint):
    """Set OWN, the color of geom g dimmed by `tint`; of a body it is rounded before it is dimmed."""
    for c in range(3):
        color = rec[g, L.RGB + c]
        k[L.OWN + c] = tint * color if rec[g, L.KIND] == PLANE else f4(tint) * f4(color)


@leaf
def covered(base, color, head, lamp, hidden, further):
    """A channel of a base color with a surface over it: its color in the light of the headlight and of a lamp."""
    one = f4(1)
    color, lit = color * min(head, one), color * lamp
    if hidden < one and further:
        return min(base + lit * hidden, one)
    if hidden < one:
        return base * (one - hidden) + min(color + lit, one) * hidden
    return min(min(base + color, one) + lit, one)


@part
def cover(s, n, k, rec, g, veil, further):
    """Lay geom g of the color OWN over the base colors; with `veil` below 1 blended with them.

    Args:
      veil: share of the base colors that is hidden.
      further: the first lamp has been laid over them already, and this is the light of another one.
    """
    distinct()
    hidden, light = f4(veil), i8(L.HEADLIGHT)
    flat_r, matt_r, glow_r = terms(k, rec, g, light, 0)
    flat_g, matt_g, glow_g = terms(k, rec, g, light, 1)
    flat_b, matt_b, glow_b = terms(k, rec, g, light, 2)
    for i in range(n):
        diffuse, shine = get(s, L.HEADLIGHT_DIFFUSE + i), get(s, L.HEADLIGHT_SPECULAR + i)
        lamp_r, lamp_g, lamp_b = get3(s, L.LAMP_COLOR + i)
        seen = get(s, L.LIGHT + i) > f4(0)
        lamp_r, lamp_g, lamp_b = lamp_r if seen else f4(0), lamp_g if seen else f4(0), lamp_b if seen else f4(0)
        red, green, blue = get3(s, L.TEXEL + i)
        base_r, base_g, base_b = get3(s, L.BASE + i)
        red = covered(base_r, red, flat_r + matt_r * diffuse + glow_r * shine, lamp_r, hidden, further)
        green = covered(base_g, green, flat_g + matt_g * diffuse + glow_g * shine, lamp_g, hidden, further)
        blue = covered(base_b, blue, flat_b + matt_b * diffuse + glow_b * shine, lamp_b, hidden, further)
        put3(s, L.BASE + i, red, green, blue)


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
    half, radius = rec[g, L.SIZE + 1] if rec[g, L.KIND] == CAPSULE else 0.0, rec[g, L.SIZE]
    mx, my, mz = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
    moment, center = mx * mx + my * my + mz * mz - radius * radius, ox * ax + oy * ay + oz * az
    inside = ox * ox + oy * oy + oz * oz - radius * radius + half * half  # of the balls, less 2 * reach * center
    outside, nearer, rr = moment > 0.0, center < 0.0, f4(radius * radius)
    upper, lower = f4(inside + 2.0 * half * center), f4(inside - 2.0 * half * center)
    mx, my, mz, moment, center = f4(mx), f4(my), f4(mz), f4(moment), f4(center)
    ox, oy, oz, ax, ay, az, half, zero = f4(ox), f4(oy), f4(oz), f4(ax), f4(ay), f4(az), f4(half), f4(0)
    for i in range(n):
        x, y = get(s, L.RAY_X + i), get(s, L.RAY_Y + i)
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
        put3(s, L.POINT + i, px, py, pz)
        put3(s, L.NORMAL + i, nx * over, ny * over, nz * over)


@part
def meet_solid(s, n, rec, g, place, turn):
    """Do as `meet_body` for a cylinder, box or ellipsoid.

    Args:
      place, turn: the columns of `rec` where its center and its axes are.
    """
    distinct()
    kind = int(rec[g, L.KIND])
    ox, oy, oz = own_point(rec, g, place, turn, 0.0, 0.0, 0.0)
    deep = f4(0) if kind == CYLINDER else f4(1)
    a, b, c = 1.0 / rec[g, L.SIZE], 1.0 / rec[g, L.SIZE + 1], 1.0 / rec[g, L.SIZE + 2]
    a1, a2, a3 = f4(rec[g, turn]), f4(rec[g, turn + 3]), f4(rec[g, turn + 6])
    b1, b2, b3 = f4(rec[g, turn + 1]), f4(rec[g, turn + 4]), f4(rec[g, turn + 7])
    c1, c2, c3 = f4(rec[g, turn + 2]), f4(rec[g, turn + 5]), f4(rec[g, turn + 8])
    a, b, c, one = f4(a), f4(b), f4(c), f4(1)
    for i in range(n):
        x, y = get(s, L.RAY_X + i), get(s, L.RAY_Y + i)
        dx, dy, dz = a * (a1 * x + a2 * y - a3), b * (b1 * x + b2 * y - b3), c * (c1 * x + c2 * y - c3)
        enter, leave, face = through_solid(kind, ox, oy, oz, dx, dy, dz)
        depth = max(min(enter, leave), f4(1e-6))
        lx, ly, lz = a * (ox + dx * depth), b * (oy + dy * depth), deep * c * (oz + dz * depth)
        lx = lx if face == 0 else ((-one if dx > f4(0) else one) if face == 1 else f4(0))
        ly = ly if face == 0 else ((-one if dy > f4(0) else one) if face == 2 else f4(0))
        lz = lz if face == 0 else ((-one if dz > f4(0) else one) if face == 3 else f4(0))
        over = one / max(math.sqrt(lx * lx + ly * ly + lz * lz), f4(1e-12))
        put3(s, L.POINT + i, depth * x, depth * y, -depth)
        nx, ny, nz = a1 * lx + b1 * ly + c1 * lz, a2 * lx + b2 * ly + c2 * lz, a3 * lx + b3 * ly + c3 * lz
        put3(s, L.NORMAL + i, nx * over, ny * over, nz * over)


@part
def meet(s, n, rec, g, mirrored):
    """Do as `meet_body` for any body or its mirror image."""
    place = i8(L.MIRRORED_PLACE if mirrored else L.PLACE)
    if rec[g, L.KIND] == SPHERE or rec[g, L.KIND] == CAPSULE:
        meet_body(s, n, rec, g, place, i8(L.MIRRORED_AXIS if mirrored else L.AXIS))
    else:
        meet_solid(s, n, rec, g, place, i8(L.MIRRORED_TURN if mirrored else L.TURN))


@part
def turn_rays(s, n, source, dx, dy):
    """RAY_X and RAY_Y from two rows from `source` on, moved."""
    for i in range(n):
        put(s, L.RAY_X + i, get(s, source + i) + dx)
    for i in range(n):
        put(s, L.RAY_Y + i, get(s, source + L.CHUNK + i) + dy)


@part
def own_directions(s, n, rec, g, first, less):
    """Turn normals into geom g's own frame: into the three rows from `first` on, less those from `less` on."""
    for axis in range(3):
        a, b, c = f4(rec[g, L.TURN + axis]), f4(rec[g, L.TURN + 3 + axis]), f4(rec[g, L.TURN + 6 + axis])
        to, off = first + axis * L.CHUNK, less + axis * L.CHUNK
        for i in range(n):
            x, y, z = get3(s, L.NORMAL + i)
            put(s, to + i, a * x + b * y + c * z)
        if less >= 0:
            for i in range(n):
                put(s, to + i, get(s, to + i) - get(s, off + i))


@stage
def cover_ball(s, n, k, rec, texels, width, g):
    """Sample the cube map around ball g along rays."""
    step = k[L.STEP]
    for source, right, up, first, less in (
        (L.QUAD_X, 0, 0, L.DIRECTION, -1),
        (L.QUAD_X, 1, 0, L.RIGHT, L.DIRECTION),
        (L.QUAD_X, 0, 1, L.UP, L.DIRECTION),
        (L.X, 0, 0, L.DIRECTION, -1),
    ):
        turn_rays(s, n, source, f4(right * step), f4(up * step))
        meet(s, n, rec, g, False)
        own_directions(s, n, rec, g, first, less)
    sample(s, n, texels, width, int(rec[g, L.TEXTURE]), False)


@stage
def shade_body(s, n, k, rec, texels, width, plane, g, mirrored):
    """Compute texture, headlight and lamp on body g, or on its mirror image, along rays."""
    turn_rays(s, n, i8(L.X), f4(0), f4(0))
    if rec[g, L.TEXTURE] >= 0.0:
        cover_ball(s, n, k, rec, texels, width, g)
    else:
        for c in range(3):
            fill(s, n, L.TEXEL + c * L.CHUNK, f4(1))
    if mirrored or rec[g, L.TEXTURE] < 0.0:  # else `cover_ball` has met it last
        meet(s, n, rec, g, mirrored)
    light(s, n, k, rec, plane, g, mirrored)


# -- sky -------------------------------------------------------------------------------------------


@part
def shade_sky(s, n, k, texels, width):
    """Compute base colors of the sky along rays: a cube of pictures around the eye, turned by 90 degrees around x."""
    texture, step = int(k[L.SKY]), k[L.STEP]
    if texture < 0:
        for c in range(3):
            fill(s, n, L.BASE + c * L.CHUNK, f4(0))
        return
    for axis in range(3):
        view = L.VIEW + (0 if axis == 0 else 6 if axis == 1 else 3)
        sign = -1.0 if axis == 2 else 1.0
        a, b, c = f4(sign * k[view]), f4(sign * k[view + 1]), f4(sign * k[view + 2])
        to = L.DIRECTION + axis * L.CHUNK
        for i in range(n):
            put(s, to + i, a * get(s, L.X + i) + b * get(s, L.Y + i) - c)
        fill(s, n, L.RIGHT + axis * L.CHUNK, f4(sign * k[view] * step))
        fill(s, n, L.UP + axis * L.CHUNK, f4(sign * k[view + 1] * step))
    sample(s, n, texels, width, texture, False)
    for c in range(3):
        for i in range(n):
            put(s, L.BASE + c * L.CHUNK + i, get(s, L.TEXEL + c * L.CHUNK + i))
