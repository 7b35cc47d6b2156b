"""Light at points with normals, as OpenGL's fixed pipeline has it: MuJoCo's headlight, one lamp, its shadows.

A light's color at a point is `material * (ambient + diffuse * N.L) + specular * (N.H)^exponent`, the lamp's times
`cos(angle off its axis)^exponent` inside its cone. As in OpenGL, the lit plane is lit at the vertices that MuJoCo
draws it with, and blended between them. Points and their light lie in rows of `layout`.
"""

from __future__ import annotations

import math

import numpy as np

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native.layout import distinct, get, get3, leaf, part, put, put3, stage
from dmcvb_gen.rendering.native.sampling import fill
from dmcvb_gen.rendering.native.scene import CAPSULE, OPAQUE, PLANE, SPHERE
from dmcvb_gen.rendering.native.visibility import own_axes, own_point, slopes_of_ball, through_solid

f4, i4, i8 = np.float32, np.int32, np.int64
DIM = 0.8
"""Squared (N.H) below which a highlight with a large exponent is left out: less than one part in a thousand."""
SHARP = 64
"""The least of these exponents."""
GRAIN = 1000.0
"""Steps of the shadow map's coordinates, when the extent of some points is measured."""


@leaf
def half_vector(nx, ny, nz, lx, ly, lz, px, py, pz, least):
    """(N.H), 0 where it is negative or its square is below `least`; n and l are of unit length, the eye is at 0."""
    length = math.sqrt(px * px + py * py + pz * pz)
    hx, hy, hz = lx * length - px, ly * length - py, lz * length - pz
    towards = nx * hx + ny * hy + nz * hz
    square = towards * towards / max(hx * hx + hy * hy + hz * hz, f4(1e-30))
    return math.sqrt(square) if (towards > f4(0)) & (square >= least) else f4(0)


@leaf
def least_square(exponent):
    """The squared (N.H) from which a highlight counts."""
    return f4(DIM) if exponent >= SHARP else f4(0)


@part
def head_light(s, n, k, eye, exponent):
    """Compute HEADLIGHT_DIFFUSE, and HEADLIGHT_SPECULAR before it is raised, at points with normals.

    Args:
      eye: index of the eye's direction in k.
    """
    distinct()
    ex, ey, ez, least = f4(k[eye]), f4(k[eye + 1]), f4(k[eye + 2]), least_square(exponent)
    for i in range(n):
        px, py, pz = get3(s, L.POINT + i)
        nx, ny, nz = get3(s, L.NORMAL + i)
        diffuse = -(nx * ex + ny * ey + nz * ez)
        shine = half_vector(nx, ny, nz, -ex, -ey, -ez, px, py, pz, least)
        put(s, L.HEADLIGHT_DIFFUSE + i, max(diffuse, f4(0)))
        put(s, L.HEADLIGHT_SPECULAR + i, shine if diffuse > f4(0) else f4(0))


@part
def lamp_light(s, n, k, lamp, exponent):
    """Compute LAMP_DIFFUSE and LIGHT at points with normals, and CONE_FACTOR and LAMP_SPECULAR before they are raised.

    Args:
      lamp: index of its place and direction in k.
    """
    distinct()
    ox, oy, oz = f4(k[lamp]), f4(k[lamp + 1]), f4(k[lamp + 2])
    ax, ay, az = f4(k[lamp + 3]), f4(k[lamp + 4]), f4(k[lamp + 5])
    cone, least = f4(k[L.CONE]), least_square(exponent)
    for i in range(n):
        px, py, pz = get3(s, L.POINT + i)
        nx, ny, nz = get3(s, L.NORMAL + i)
        lx, ly, lz = ox - px, oy - py, oz - pz
        over = f4(1) / max(math.sqrt(lx * lx + ly * ly + lz * lz), f4(1e-6))
        lx, ly, lz = lx * over, ly * over, lz * over
        off = -(lx * ax + ly * ay + lz * az)
        diffuse = nx * lx + ny * ly + nz * lz
        shine = half_vector(nx, ny, nz, lx, ly, lz, px, py, pz, least)
        put(s, L.CONE_FACTOR + i, off if off >= cone else f4(0))
        put(s, L.LAMP_DIFFUSE + i, max(diffuse, f4(0)))
        put(s, L.LAMP_SPECULAR + i, shine if diffuse > f4(0) else f4(0))
        put(s, L.LIGHT + i, f4(1))


@part
def raise_row(s, n, row, exponent):
    """A row to a whole power, by multiplication, so that its bits are the same everywhere; 0 stays 0."""
    for i in range(n):
        put(s, L.RAISED + i, f4(1) if get(s, row + i) > f4(0) else f4(0))
    while exponent > 0:
        if exponent & 1:
            for i in range(n):
                put(s, L.RAISED + i, get(s, L.RAISED + i) * get(s, row + i))
        for i in range(n):
            base = get(s, row + i)
            put(s, row + i, base * base)
        exponent >>= 1
    for i in range(n):
        put(s, row + i, get(s, L.RAISED + i))


# -- shadows ---------------------------------------------------------------------------------------


@part
def aim_shadows(k, rec):
    """Fill SHADOW with the directions of the lamp's shadow map, and BOUNDS with the bodies' outlines in it."""
    x, y, z = k[L.LAMP + 3], k[L.LAMP + 4], k[L.LAMP + 5]
    ux, uy, uz = 0.0, -z, y  # across the direction and the -x axis, else the y axis
    if y * y + z * z <= 0.01:
        ux, uy, uz = -z, 0.0, x
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    k[L.SHADOW], k[L.SHADOW + 1], k[L.SHADOW + 2] = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    k[L.SHADOW + 3], k[L.SHADOW + 4], k[L.SHADOW + 5] = ux, uy, uz
    k[L.SHADOW + 6], k[L.SHADOW + 7], k[L.SHADOW + 8] = x, y, z
    for g in range(rec.shape[0]):
        kind = rec[g, L.KIND]
        if kind == PLANE:
            continue
        least_x, most_x, least_y, most_y = 1e9, -1e9, 1e9, -1e9
        for end in range(2 if kind == CAPSULE else 1):
            reach = 0.0 if kind != CAPSULE else (rec[g, L.SIZE + 1] if end == 0 else -rec[g, L.SIZE + 1])
            dx = rec[g, L.PLACE] + reach * rec[g, L.AXIS] - k[L.LAMP]
            dy = rec[g, L.PLACE + 1] + reach * rec[g, L.AXIS + 1] - k[L.LAMP + 1]
            dz = rec[g, L.PLACE + 2] + reach * rec[g, L.AXIS + 2] - k[L.LAMP + 2]
            depth = dx * x + dy * y + dz * z
            right = dx * k[L.SHADOW] + dy * k[L.SHADOW + 1] + dz * k[L.SHADOW + 2]
            up = dx * ux + dy * uy + dz * uz
            low, high = slopes_of_ball(right, depth, rec[g, L.BALL])
            least_x, most_x = min(least_x, low), max(most_x, high)
            low, high = slopes_of_ball(up, depth, rec[g, L.BALL])
            least_y, most_y = min(least_y, low), max(most_y, high)
        rec[g, L.BOUNDS], rec[g, L.BOUNDS + 1] = least_x, most_x
        rec[g, L.BOUNDS + 2], rec[g, L.BOUNDS + 3] = least_y, most_y


@part
def ways_from_lamp(s, n, k):
    """Compute the ways from the lamp to points with LIGHT; none (the lamp is seen) outside the shadow map's square
    or if there is no light. Gives the extent of the others in the map: least and greatest right and up, grains.
    """
    distinct()
    ox, oy, oz = f4(k[L.LAMP]), f4(k[L.LAMP + 1]), f4(k[L.LAMP + 2])
    rx, ry, rz = f4(k[L.SHADOW]), f4(k[L.SHADOW + 1]), f4(k[L.SHADOW + 2])
    ux, uy, uz = f4(k[L.SHADOW + 3]), f4(k[L.SHADOW + 4]), f4(k[L.SHADOW + 5])
    fx, fy, fz = f4(k[L.SHADOW + 6]), f4(k[L.SHADOW + 7]), f4(k[L.SHADOW + 8])
    edge, far = f4(k[L.CONE + 2]), i4(1 << 30)
    left, right, low, high = far, i4(-far), far, i4(-far)
    for i in range(n):
        px, py, pz = get3(s, L.POINT + i)
        dx, dy, dz = px - ox, py - oy, pz - oz
        depth = dx * fx + dy * fy + dz * fz
        over = f4(1) / max(depth, f4(1e-6))
        across, up = (dx * rx + dy * ry + dz * rz) * over, (dx * ux + dy * uy + dz * uz) * over
        inside = (depth > f4(0)) & (abs(across) <= edge) & (abs(up) <= edge) & (get(s, L.LIGHT + i) > f4(0))
        a = i4(f4(GRAIN) * min(max(across, f4(-GRAIN)), f4(GRAIN)))
        b = i4(f4(GRAIN) * min(max(up, f4(-GRAIN)), f4(GRAIN)))
        left, right = min(left, a if inside else far), max(right, a if inside else i4(-far))
        low, high = min(low, b if inside else far), max(high, b if inside else i4(-far))
        put3(s, L.WAY + i, dx if inside else f4(0), dy if inside else f4(0), dz if inside else f4(0))
    return left, right, low, high


@leaf
def ball_blocks(dx, dy, dz, ox, oy, oz, square_of_radius):
    """Return True if the way from the origin to d meets a ball around o before its end."""
    square = dx * dx + dy * dy + dz * dz
    along = dx * ox + dy * oy + dz * oz
    rest = along * along - square * (ox * ox + oy * oy + oz * oz - square_of_radius)
    return (rest > f4(0)) & (along > f4(0)) & (along - math.sqrt(max(rest, f4(0))) < square * f4(0.9995))


@part
def cast_shadow(s, n, k, rec, g):
    """Set LIGHT to 0 where capsule or ball g is in the way from the lamp."""
    distinct()
    dx, dy, dz = rec[g, L.PLACE] - k[L.LAMP], rec[g, L.PLACE + 1] - k[L.LAMP + 1], rec[g, L.PLACE + 2] - k[L.LAMP + 2]
    ex, ey, ez = rec[g, L.AXIS], rec[g, L.AXIS + 1], rec[g, L.AXIS + 2]
    half, radius = rec[g, L.SIZE + 1] if rec[g, L.KIND] == CAPSULE else 0.0, rec[g, L.SIZE]
    mx, my, mz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
    moment, center = mx * mx + my * my + mz * mz - radius * radius, dx * ex + dy * ey + dz * ez
    outside = moment > 0.0  # of the endless cylinder
    toward = center <= 0.0  # else only the nearer end can be in the way
    ox, oy, oz, ax, ay, az = f4(dx), f4(dy), f4(dz), f4(ex), f4(ey), f4(ez)
    mx, my, mz, moment, center = f4(mx), f4(my), f4(mz), f4(moment), f4(center)
    half, square_of_radius = f4(half), f4(radius * radius)
    for i in range(n):
        dx, dy, dz = get3(s, L.WAY + i)
        nx, ny, nz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        square, along = nx * nx + ny * ny + nz * nz, mx * nx + my * ny + mz * nz
        rest = along * along - square * moment
        met = (rest > f4(0)) & (along > f4(0))
        share = (along - math.sqrt(max(rest, f4(0)))) / max(square, f4(1e-12))
        place = share * (dx * ax + dy * ay + dz * az) - center
        end = half if ((place > f4(0)) if outside else toward) else -half
        ball = ball_blocks(dx, dy, dz, ox + end * ax, oy + end * ay, oz + end * az, square_of_radius)
        side = share < f4(0.9995)
        blocked = (met & (side if abs(place) <= half else ball)) if outside else ball
        put(s, L.LIGHT + i, f4(0) if blocked else get(s, L.LIGHT + i))


@part
def cast_solid_shadow(s, n, k, rec, g):
    """Do as `cast_shadow` for a cylinder, box or ellipsoid."""
    distinct()
    kind, x, y, z = int(rec[g, L.KIND]), k[L.LAMP], k[L.LAMP + 1], k[L.LAMP + 2]
    ox, oy, oz = own_point(rec, g, L.PLACE, L.TURN, x, y, z)
    ax, ay, az, bx, by, bz, cx, cy, cz = own_axes(rec, g, L.TURN)
    for i in range(n):
        x, y, z = get3(s, L.WAY + i)
        dx, dy, dz = ax * x + ay * y + az * z, bx * x + by * y + bz * z, cx * x + cy * y + cz * z
        enter, leave, face = through_solid(kind, ox, oy, oz, dx, dy, dz)
        blocked = (enter < leave) & (enter > f4(0)) & (enter < f4(0.9995)) & (abs(x) + abs(y) + abs(z) > f4(0))
        put(s, L.LIGHT + i, f4(0) if blocked else get(s, L.LIGHT + i))


@stage
def cast_shadows(s, n, k, rec, itself):
    """Set LIGHT to 0 at points that a body other than `itself` hides from the lamp."""
    left, right, low, high = ways_from_lamp(s, n, k)
    if left > right:
        return
    for g in range(rec.shape[0]):
        if (
            g != itself
            and rec[g, L.KIND] != PLANE
            and GRAIN * rec[g, L.BOUNDS] <= right + 2
            and GRAIN * rec[g, L.BOUNDS + 1] >= left - 2
            and GRAIN * rec[g, L.BOUNDS + 2] <= high + 2
            and GRAIN * rec[g, L.BOUNDS + 3] >= low - 2
        ):
            if rec[g, L.KIND] == SPHERE or rec[g, L.KIND] == CAPSULE:
                cast_shadow(s, n, k, rec, g)
            else:
                cast_solid_shadow(s, n, k, rec, g)


# -- the lit plane ---------------------------------------------------------------------------------


@part
def cone_slope(cosine, down):
    """Return the radius of the lamp's cone for each meter of height.

    Args:
      cosine: of the cone's half angle; `down` of the angle between the lamp's direction and the way down.
    """
    across = math.sqrt(max(1.0 - down * down, 0.0))
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    below = cosine * down - sine * across  # cosine of the angle of the flattest ray
    if down <= 0.0 or below <= 1e-3:
        return 1e6
    return math.sqrt(max(1.0 - below * below, 0.0)) / below


@part
def lit_window(k, rec, plane, g):
    """Fill WINDOW: the vertices (first, past the last; along two axes) of plane g that the lamp's cone reaches."""
    dx, dy, dz = k[L.LAMP] - rec[g, L.PLACE], k[L.LAMP + 1] - rec[g, L.PLACE + 1], k[L.LAMP + 2] - rec[g, L.PLACE + 2]
    nx, ny, nz = rec[g, L.AXIS], rec[g, L.AXIS + 1], rec[g, L.AXIS + 2]
    height = dx * nx + dy * ny + dz * nz
    reach = height * cone_slope(k[L.CONE], -(k[L.LAMP + 3] * nx + k[L.LAMP + 4] * ny + k[L.LAMP + 5] * nz))
    for axis in range(2):
        middle = dx * rec[g, L.TURN + axis] + dy * rec[g, L.TURN + 3 + axis] + dz * rec[g, L.TURN + 6 + axis]
        lines, first, grid = int(k[L.LINES + axis]), 0, axis * int(k[L.GRID])
        while first < lines and plane[grid + first] < middle - reach:
            first += 1
        past = first
        while past < lines and plane[grid + past] <= middle + reach and height > 0.0:
            past += 1
        # With the dark vertices around it, so that every cell that has any light has all its corners.
        k[L.WINDOW + 2 * axis], k[L.WINDOW + 2 * axis + 1] = max(first - 1, 0), min(past + 1, lines)


@part
def store_vertices(s, n, k, rec, plane, g, first, high, lines, several, which):
    """Store the lamp's color (red, green, blue) at some vertices of the lit plane.

    Args:
      first: of these vertices in the window, which is `high` vertices high; `lines`: of the grid's second axis.
    """
    together = rec[g, L.OPACITY] < OPAQUE
    share = rec[g, L.SHARE]
    for i in range(n):
        row, column = int(k[L.WINDOW]) + (first + i) // high, int(k[L.WINDOW + 2]) + (first + i) % high
        at = 2 * int(k[L.GRID]) + 3 * (row * lines + column)
        for c in range(3):
            own = rec[g, L.RGB + c]
            color = own * (k[L.SPOT + c] + k[L.SPOT + 3 + c] * s[L.LAMP_DIFFUSE + i])
            color += k[L.SPOT + 6 + c] * share * s[L.LAMP_SPECULAR + i]
            color = min(s[L.CONE_FACTOR + i] * color, 1.0)
            if together:
                head = own * (k[L.HEADLIGHT + c] + k[L.HEADLIGHT + 3 + c] * s[L.HEADLIGHT_DIFFUSE + i])
                head = min(head + k[L.HEADLIGHT + 6 + c] * share * s[L.HEADLIGHT_SPECULAR + i], 1.0)
                if which > 0:
                    head = plane[at + c + 3 * int(k[L.GRID]) * int(k[L.GRID])]
                color = min(color, 1.0 - head)
                if several:
                    plane[at + c + 3 * int(k[L.GRID]) * int(k[L.GRID])] = head + color
            plane[at + c] = color


@stage
def light_vertices(s, k, rec, plane, g, several, which):
    """Fill WINDOW, and the vertices in it, with the lamp's color on plane g.

    An opaque plane is lit in two passes; on one that is seen through all lights are added before they are cut at 1.

    Args:
      several: there are several lamps, and this is number `which`; they are asked for in their order.
    """
    lit_window(k, rec, plane, g)
    if several:
        k[L.WINDOW], k[L.WINDOW + 1], k[L.WINDOW + 2], k[L.WINDOW + 3] = 0, k[L.LINES], 0, k[L.LINES + 1]
    high, exponent = int(k[L.WINDOW + 3] - k[L.WINDOW + 2]), int(rec[g, L.EXPONENT])
    total = int(k[L.WINDOW + 1] - k[L.WINDOW]) * high
    for first in range(0, total, L.CHUNK):
        n = min(L.CHUNK, total - first)
        for i in range(n):
            x = plane[int(k[L.WINDOW]) + (first + i) // high]
            y = plane[int(k[L.GRID] + k[L.WINDOW + 2]) + (first + i) % high]
            for c in range(3):
                place = rec[g, L.PLACE + c] + x * rec[g, L.TURN + 3 * c] + y * rec[g, L.TURN + 3 * c + 1]
                s[L.POINT + c * L.CHUNK + i] = place
        for axis in range(3):
            fill(s, n, L.NORMAL + axis * L.CHUNK, f4(rec[g, L.AXIS + axis]))
        head_light(s, n, k, i8(L.EYE), exponent)
        lamp_light(s, n, k, i8(L.LAMP), exponent)
        raise_row(s, n, i8(L.HEADLIGHT_SPECULAR), exponent)
        raise_row(s, n, i8(L.LAMP_SPECULAR), exponent)
        raise_row(s, n, i8(L.CONE_FACTOR), int(k[L.CONE + 1]))
        store_vertices(s, n, k, rec, plane, g, first, high, int(k[L.LINES + 1]), several, which)


@leaf
def terms(k, rec, g, light, c):
    """Channel c of the ambient, diffuse and specular terms on geom g of the color OWN of the light at `light` in k."""
    own, share = f4(k[L.OWN + c]), f4(rec[g, L.SHARE])
    return own * f4(k[light + c]), own * f4(k[light + 3 + c]), share * f4(k[light + 6 + c])


@part
def lamp_everywhere(s, n, k, rec, g, exponent):
    """Compute LAMP_COLOR on geom g of the color OWN from what `lamp_light` has computed, without a grid."""
    distinct()
    raise_row(s, n, i8(L.LAMP_SPECULAR), exponent)
    raise_row(s, n, i8(L.CONE_FACTOR), int(k[L.CONE + 1]))
    one, spot = f4(1), i8(L.SPOT)
    flat_r, matt_r, glow_r = terms(k, rec, g, spot, 0)
    flat_g, matt_g, glow_g = terms(k, rec, g, spot, 1)
    flat_b, matt_b, glow_b = terms(k, rec, g, spot, 2)
    for i in range(n):
        cone, diffuse, shine = get3(s, L.CONE_FACTOR + i)
        red, green = flat_r + matt_r * diffuse + glow_r * shine, flat_g + matt_g * diffuse + glow_g * shine
        blue = flat_b + matt_b * diffuse + glow_b * shine
        put3(s, L.LAMP_COLOR + i, min(cone * red, one), min(cone * green, one), min(cone * blue, one))


@leaf
def cell_of(place, first, over, lines):
    """The cell of a grid that holds a place: `over` is the inverse of all cells' width but the outermost ones'."""
    return min(max(np.floor((place - first) * over) + f4(1), f4(0)), lines - f4(2))


@leaf
def lamp_color(plane, corner, right, up, a, b, c):
    """Blend of color c of three vertices, a and b being the shares of two of them."""
    middle = get(plane, corner + c)
    return middle + a * (get(plane, right + c) - middle) + b * (get(plane, up + c) - middle)


@part
def lamp_on_plane(s, n, k, rec, plane, g):
    """Compute LAMP_COLOR, and LIGHT where there is any, at U and V on the lit plane g.

    OpenGL draws each cell of the grid as two triangles. Gives whether there is any light.
    """
    distinct()
    wide, high = f4(k[L.LINES]), f4(k[L.LINES + 1])
    count, second = i4(k[L.LINES + 1]), i4(k[L.GRID])
    x1, y1 = plane[1], plane[second + 1]
    over_x = f4(1) / (plane[2] - x1) if wide > f4(2) else f4(0)
    over_y = f4(1) / (plane[second + 2] - y1) if high > f4(2) else f4(0)
    half_x, half_y = f4(rec[g, L.SIZE]), f4(rec[g, L.SIZE + 1])
    i0, i1, j0, j1 = f4(k[L.WINDOW]), f4(k[L.WINDOW + 1]), f4(k[L.WINDOW + 2]), f4(k[L.WINDOW + 3])
    any_light = i4(0)
    for i in range(n):
        x, y = get(s, L.U + i) * half_x, get(s, L.V + i) * half_y
        row, column = cell_of(x, x1, over_x, wide), cell_of(y, y1, over_y, high)
        seen = (row >= i0) & (row + f4(1) < i1) & (column >= j0) & (column + f4(1) < j1)
        r, c = i4(row), i4(column)
        left, low = get(plane, r), get(plane, i4(second + c))
        a = (x - left) / max(get(plane, i4(r + i4(1))) - left, f4(1e-9))
        b = (y - low) / max(get(plane, i4(second + c + i4(1))) - low, f4(1e-9))
        at = i4(i4(r * count) + c) if seen else i4(0)
        right, up = i4(at + count), i4(at + i4(1))
        lower = a + b <= f4(1)
        corner = at if lower else i4(at + count + i4(1))
        a, b = (a if lower else f4(1) - b), (b if lower else f4(1) - a)
        first = i4(i4(2) * second)
        corner, right, up = i4(first + corner * i4(3)), i4(first + right * i4(3)), i4(first + up * i4(3))
        red = lamp_color(plane, corner, right, up, a, b, 0) if seen else f4(0)
        green = lamp_color(plane, corner, right, up, a, b, 1) if seen else f4(0)
        blue = lamp_color(plane, corner, right, up, a, b, 2) if seen else f4(0)
        put3(s, L.LAMP_COLOR + i, red, green, blue)
        lit = red + green + blue > f4(0)
        put(s, L.LIGHT + i, f4(1) if lit else f4(0))
        any_light = max(any_light, i4(1) if lit else i4(0))
    return any_light > 0
