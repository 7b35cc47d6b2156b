"""Points and normals in, light out: OpenGL's fixed pipeline with MuJoCo's headlight and one lamp with its shadows.

A light's color at a point is `material * (ambient + diffuse * N.L) + specular * (N.H)^exponent`, the lamp's times
`cos(angle off its axis)^exponent` inside its cone. As in OpenGL, the lit plane is lit at the vertices that MuJoCo
draws it with, and blended between them.
"""

from __future__ import annotations

import math

from dmcvb_gen.rendering.native.records import (
    AXIS,
    BOUNDS,
    CONE,
    EXPONENT,
    EYE,
    HEADLIGHT,
    KIND,
    LAMP,
    LINES,
    OPACITY,
    PLACE,
    RGB,
    SHADOW,
    SHARE,
    SIZE,
    SPOT,
    TURN,
    WINDOW,
)
from dmcvb_gen.rendering.native.sampling import leaf, part
from dmcvb_gen.rendering.native.scene import CAPSULE, OPAQUE, PLANE
from dmcvb_gen.rendering.native.visibility import slopes_of_ball


@leaf
def power(base, exponent):
    """`base` to a whole power by multiplication, so that its bits are the same everywhere."""
    result = 1.0
    while exponent > 0:
        if exponent & 1:
            result *= base
        base *= base
        exponent >>= 1
    return result


@leaf
def highlight(nx, ny, nz, lx, ly, lz, vx, vy, vz, exponent):
    """(N.H)^exponent; n and l are of unit length, v points to the eye."""
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    hx, hy, hz = lx * length + vx, ly * length + vy, lz * length + vz
    towards = nx * hx + ny * hy + nz * hz
    if towards <= 0.0:
        return 0.0
    square = towards * towards / (hx * hx + hy * hy + hz * hz)
    if square < 0.8 and exponent >= 64:  # below one part in a thousand
        return 0.0
    return power(math.sqrt(square), exponent)


@leaf
def headlight_terms(k, eye, px, py, pz, nx, ny, nz, exponent):
    """(N.L, specular) of the headlight at a point p; `eye` is where its direction is in k."""
    diffuse = -(nx * k[eye] + ny * k[eye + 1] + nz * k[eye + 2])
    if diffuse <= 0.0:
        return 0.0, 0.0
    return diffuse, highlight(nx, ny, nz, -k[eye], -k[eye + 1], -k[eye + 2], -px, -py, -pz, exponent)


@part
def lamp_terms(k, lamp, px, py, pz, nx, ny, nz, exponent):
    """(factor of the cone, N.L, specular) of the lamp at a point p; `lamp` is where it is in k."""
    lx, ly, lz = k[lamp] - px, k[lamp + 1] - py, k[lamp + 2] - pz
    length = math.sqrt(lx * lx + ly * ly + lz * lz)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    lx, ly, lz = lx / length, ly / length, lz / length
    off = -(lx * k[lamp + 3] + ly * k[lamp + 4] + lz * k[lamp + 5])
    if off < k[CONE]:
        return 0.0, 0.0, 0.0
    factor = power(off, int(k[CONE + 1]))
    diffuse = nx * lx + ny * ly + nz * lz
    if diffuse <= 0.0:
        return factor, 0.0, 0.0
    return factor, diffuse, highlight(nx, ny, nz, lx, ly, lz, -px, -py, -pz, exponent)


@leaf
def lit(k, light, c, own, factor, diffuse, specular):
    """Channel c of a light's color; `light` is where it is in k, `own` the material's color there."""
    return factor * (own * (k[light + c] + k[light + 3 + c] * diffuse) + k[light + 6 + c] * specular)


# -- shadows ---------------------------------------------------------------------------------------


@part
def aim_shadows(k, rec):
    """Fill SHADOW with the directions of the lamp's shadow map, and BOUNDS with the bodies' outlines in it."""
    x, y, z = k[LAMP + 3], k[LAMP + 4], k[LAMP + 5]
    ux, uy, uz = 0.0, -z, y  # across the direction and the -x axis, else the y axis
    if y * y + z * z <= 0.01:
        ux, uy, uz = -z, 0.0, x
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    k[SHADOW], k[SHADOW + 1], k[SHADOW + 2] = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    k[SHADOW + 3], k[SHADOW + 4], k[SHADOW + 5] = ux, uy, uz
    k[SHADOW + 6], k[SHADOW + 7], k[SHADOW + 8] = x, y, z
    for g in range(rec.shape[0]):
        kind = rec[g, KIND]
        if kind == PLANE:
            continue
        least_x, most_x, least_y, most_y = 1e9, -1e9, 1e9, -1e9
        for end in range(2 if kind == CAPSULE else 1):
            reach = 0.0 if kind != CAPSULE else (rec[g, SIZE + 1] if end == 0 else -rec[g, SIZE + 1])
            right, up, depth = in_map(
                k,
                rec[g, PLACE] + reach * rec[g, AXIS],
                rec[g, PLACE + 1] + reach * rec[g, AXIS + 1],
                rec[g, PLACE + 2] + reach * rec[g, AXIS + 2],
            )
            low, high = slopes_of_ball(right, depth, rec[g, SIZE])
            least_x, most_x = min(least_x, low), max(most_x, high)
            low, high = slopes_of_ball(up, depth, rec[g, SIZE])
            least_y, most_y = min(least_y, low), max(most_y, high)
        rec[g, BOUNDS], rec[g, BOUNDS + 1] = least_x, most_x
        rec[g, BOUNDS + 2], rec[g, BOUNDS + 3] = least_y, most_y


@leaf
def in_map(k, px, py, pz):
    """A point as (right, up, depth) of the shadow map."""
    dx, dy, dz = px - k[LAMP], py - k[LAMP + 1], pz - k[LAMP + 2]
    return (
        dx * k[SHADOW] + dy * k[SHADOW + 1] + dz * k[SHADOW + 2],
        dx * k[SHADOW + 3] + dy * k[SHADOW + 4] + dz * k[SHADOW + 5],
        dx * k[SHADOW + 6] + dy * k[SHADOW + 7] + dz * k[SHADOW + 8],
    )


@leaf
def ball_blocks(dx, dy, dz, ox, oy, oz, radius):
    """Whether the way from the origin to d meets a ball around o before its end."""
    square = dx * dx + dy * dy + dz * dz
    along = dx * ox + dy * oy + dz * oz
    rest = along * along - square * (ox * ox + oy * oy + oz * oz - radius * radius)
    if rest <= 0.0 or along <= 0.0:
        return False
    return along - math.sqrt(rest) < square * 0.9995


@part
def capsule_blocks(dx, dy, dz, ox, oy, oz, ax, ay, az, radius, half):
    """Whether the way from the origin to d meets a capsule before its end."""
    nx, ny, nz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
    mx, my, mz = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
    square = nx * nx + ny * ny + nz * nz
    moment = mx * mx + my * my + mz * mz - radius * radius
    along = mx * nx + my * ny + mz * nz
    rest = along * along - square * moment
    reach = half
    if moment > 0.0:
        if rest <= 0.0 or along <= 0.0:
            return False
        part_of_way = (along - math.sqrt(rest)) / square
        place = part_of_way * (dx * ax + dy * ay + dz * az) - (ox * ax + oy * ay + oz * az)
        if abs(place) <= half:
            return part_of_way < 0.9995
        reach = half if place > 0.0 else -half
    elif ox * ax + oy * ay + oz * az > 0.0:
        reach = -half
    return ball_blocks(dx, dy, dz, ox + reach * ax, oy + reach * ay, oz + reach * az, radius)


@part
def in_shadow(k, rec, px, py, pz, itself):
    """Whether a body other than `itself` is between the lamp and a point, inside the square the shadow map sees."""
    right, up, depth = in_map(k, px, py, pz)
    if depth <= 0.0:
        return False
    right, up = right / depth, up / depth
    if abs(right) > k[CONE + 2] or abs(up) > k[CONE + 2]:
        return False
    dx, dy, dz = px - k[LAMP], py - k[LAMP + 1], pz - k[LAMP + 2]
    for g in range(rec.shape[0]):
        if (
            g == itself
            or rec[g, KIND] == PLANE
            or right < rec[g, BOUNDS]
            or right > rec[g, BOUNDS + 1]
            or up < rec[g, BOUNDS + 2]
            or up > rec[g, BOUNDS + 3]
        ):
            continue
        ox, oy, oz = rec[g, PLACE] - k[LAMP], rec[g, PLACE + 1] - k[LAMP + 1], rec[g, PLACE + 2] - k[LAMP + 2]
        if rec[g, KIND] == CAPSULE:
            ax, ay, az = rec[g, AXIS], rec[g, AXIS + 1], rec[g, AXIS + 2]
            if capsule_blocks(dx, dy, dz, ox, oy, oz, ax, ay, az, rec[g, SIZE], rec[g, SIZE + 1]):
                return True
        elif ball_blocks(dx, dy, dz, ox, oy, oz, rec[g, SIZE]):
            return True
    return False


# -- the lit plane ---------------------------------------------------------------------------------


@part
def cone_slope(cosine, down):
    """How far from the point below the lamp its cone reaches, for each meter of height.

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
def light_vertices(k, rec, grid, vertices, g):
    """Fill WINDOW (first and past the last along two axes), and `vertices` in it, with the lamp's color on plane g.

    An opaque plane is lit in two passes; on one that is seen through both lights are added before they are cut at 1.
    """
    together = rec[g, OPACITY] < OPAQUE
    dx, dy, dz = k[LAMP] - rec[g, PLACE], k[LAMP + 1] - rec[g, PLACE + 1], k[LAMP + 2] - rec[g, PLACE + 2]
    nx, ny, nz = rec[g, AXIS], rec[g, AXIS + 1], rec[g, AXIS + 2]
    height = dx * nx + dy * ny + dz * nz
    reach = height * cone_slope(k[CONE], -(k[LAMP + 3] * nx + k[LAMP + 4] * ny + k[LAMP + 5] * nz))
    for axis in range(2):
        middle = dx * rec[g, TURN + axis] + dy * rec[g, TURN + 3 + axis] + dz * rec[g, TURN + 6 + axis]
        lines, first = int(k[LINES + axis]), 0
        while first < lines and grid[axis, first] < middle - reach:
            first += 1
        past = first
        while past < lines and grid[axis, past] <= middle + reach and height > 0.0:
            past += 1
        # With the dark vertices around it, so that every cell that has any light has all its corners.
        k[WINDOW + 2 * axis], k[WINDOW + 2 * axis + 1] = max(first - 1, 0), min(past + 1, lines)
    share, exponent = rec[g, SHARE], int(rec[g, EXPONENT])
    for i in range(int(k[WINDOW]), int(k[WINDOW + 1])):
        for j in range(int(k[WINDOW + 2]), int(k[WINDOW + 3])):
            px = rec[g, PLACE] + grid[0, i] * rec[g, TURN] + grid[1, j] * rec[g, TURN + 1]
            py = rec[g, PLACE + 1] + grid[0, i] * rec[g, TURN + 3] + grid[1, j] * rec[g, TURN + 4]
            pz = rec[g, PLACE + 2] + grid[0, i] * rec[g, TURN + 6] + grid[1, j] * rec[g, TURN + 7]
            factor, diffuse, specular = lamp_terms(k, LAMP, px, py, pz, nx, ny, nz, exponent)
            head, head_specular = headlight_terms(k, EYE, px, py, pz, nx, ny, nz, exponent)
            for c in range(3):
                own = rec[g, RGB + c]
                color = min(lit(k, SPOT, c, own, factor, diffuse, specular * share), 1.0)
                if together:
                    first = min(lit(k, HEADLIGHT, c, own, 1.0, head, head_specular * share), 1.0)
                    color = min(color, 1.0 - first)
                vertices[i, j, c] = color


@leaf
def cell_of(grid, axis, lines, x):
    """The cell of a plane's grid that holds x."""
    if x < grid[axis, 1]:
        return 0
    if lines < 4 or x >= grid[axis, lines - 2]:
        return lines - 2
    return min(1 + int((x - grid[axis, 1]) / (grid[axis, 2] - grid[axis, 1])), lines - 3)


@part
def lamp_on_plane(k, grid, vertices, x, y):
    """The lamp's color at (x, y) of the lit plane; OpenGL draws each cell as two triangles."""
    i, j = cell_of(grid, 0, int(k[LINES]), x), cell_of(grid, 1, int(k[LINES + 1]), y)
    if i < k[WINDOW] or i + 1 >= k[WINDOW + 1] or j < k[WINDOW + 2] or j + 1 >= k[WINDOW + 3]:
        return 0.0, 0.0, 0.0
    wide, high = grid[0, i + 1] - grid[0, i], grid[1, j + 1] - grid[1, j]
    a = (x - grid[0, i]) / wide if wide > 0.0 else 0.0
    b = (y - grid[1, j]) / high if high > 0.0 else 0.0
    return (
        blended(vertices, i, j, a, b, 0),
        blended(vertices, i, j, a, b, 1),
        blended(vertices, i, j, a, b, 2),
    )


@leaf
def blended(vertices, i, j, a, b, c):
    """Blend of color c of a cell's corners, (a, b) being the place in it."""
    right, up = vertices[i + 1, j, c], vertices[i, j + 1, c]
    if a + b <= 1.0:
        corner = vertices[i, j, c]
        return corner + a * (right - corner) + b * (up - corner)
    corner = vertices[i + 1, j + 1, c]
    return corner + (1.0 - a) * (up - corner) + (1.0 - b) * (right - corner)
