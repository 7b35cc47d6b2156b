"""Find the nearest geom of every sample from geoms in the camera's frame.

Each pixel has four samples, side by side in memory, where OpenGL on a CPU has them. The ray of a sample is
d = (x, y, -1) in the camera's frame (x right, y up), and what is kept of a hit is the inverse of its depth: larger
is nearer, a plane's is affine in (x, y), and no kernel needs a division.
"""

from __future__ import annotations

import math

import numpy as np

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native.layout import distinct, get, leaf, part, put
from dmcvb_gen.rendering.native.scene import BOX, CAPSULE, CYLINDER

SAMPLES = ((0.375, 0.875), (0.875, 0.625), (0.125, 0.375), (0.625, 0.125))
"""Where the four samples lie in a pixel: to the right and down."""
NOTHING = 255
"""The number in place of a geom where there is none: the sky."""


def sample_rays(size: int, step: float, centers: bool = False) -> np.ndarray:
    """(9 * size,) float32: ray coordinates of all samples.

    First x of (4 * column + sample), then, in the same order, y below the upper edge of a row, then y of these edges.

    Args:
      step: change of x and y from pixel to pixel.
      centers: all samples in the middle of their pixels.
    """
    right, down = np.full((2, 4), 0.5) if centers else np.array(SAMPLES).T
    x = ((np.arange(size)[:, None] + right) * step - size * step / 2).ravel()
    y = size * step / 2 - np.arange(size) * step
    return np.concatenate([x, np.tile(-down * step, size), y]).astype(np.float32)


@part
def slopes_of_ball(side, depth, radius):
    """Least and greatest side / depth of the lines from the origin that touch a disc in the plane (side, depth)."""
    square = depth * depth - radius * radius
    if depth <= radius * 1.0001:
        return -1e9, 1e9
    root = radius * math.sqrt(side * side + square)
    return (side * depth - root) / square, (side * depth + root) / square


@part
def screen_box(left, right, low, high, k, size):
    """Columns and rows (first, past the last) of the pixels that slopes in these ranges touch, inside CLIP."""
    half, step = 0.5 * size, k[L.STEP]
    first_column = int(math.floor(min(max(left / step + half - 0.01, 0.0), size)))
    past_column = int(math.ceil(min(max(right / step + half + 0.01, 0.0), size)))
    first_row = int(math.floor(min(max(half - high / step - 0.01, 0.0), size)))
    past_row = int(math.ceil(min(max(half - low / step + 0.01, 0.0), size)))
    first_column, past_column = max(first_column, int(k[L.CLIP])), min(past_column, int(k[L.CLIP + 1]))
    return first_column, past_column, max(first_row, int(k[L.CLIP + 2])), min(past_row, int(k[L.CLIP + 3]))


@part
def box_of_body(k, rec, g, place, axis, size):
    """Pixels in CLIP that a body can touch; none if it is behind the camera.

    Args:
      place, axis: the columns of `rec` where its center and its axis are.
    """
    left, right, low, high = 1e9, -1e9, 1e9, -1e9
    radius, behind = rec[g, L.BALL], True
    half = rec[g, L.SIZE + 1] if rec[g, L.KIND] == CAPSULE else 0.0
    for end in range(2):
        reach = half if end == 0 else -half
        x, y = rec[g, place] + reach * rec[g, axis], rec[g, place + 1] + reach * rec[g, axis + 1]
        depth = -(rec[g, place + 2] + reach * rec[g, axis + 2])
        behind = behind and depth <= -radius
        least, most = slopes_of_ball(x, depth, radius)
        left, right = min(left, least), max(right, most)
        least, most = slopes_of_ball(y, depth, radius)
        low, high = min(low, least), max(high, most)
    if behind:
        return 0, 0, 0, 0
    return screen_box(left, right, low, high, k, size)


@part
def draw_sphere(inverse, number, rays, c0, c1, r0, r1, rec, g, place, nearest, geom):
    """Put a ball into the buffers, in columns c0 to c1 and rows r0 to r1.

    Args:
      place: the column of `rec` where its center is.
      nearest: the largest inverse depth drawn.
    """
    distinct()
    px, py, pz, radius = rec[g, place], rec[g, place + 1], rec[g, place + 2], rec[g, L.SIZE]
    inside = px * px + py * py + pz * pz - radius * radius
    if inside <= 0.0:
        return  # its back faces are not drawn
    ex, ey, ez = np.float32(px), np.float32(py), np.float32(pz)
    rr, unit, zero, one = np.float32(radius * radius), np.float32(1.0 / inside), np.float32(0), np.float32(1)
    limit = np.float32(nearest)
    size = rays.size // 9
    for row in range(r0, r1):
        top, at = rays[8 * size + row], 4 * size * row
        for i in range(4 * c0, 4 * c1):
            x, y, before = get(rays, i), top + get(rays, 4 * size + i), get(inverse, at + i)
            ux, uy, uz = -ey - ez * y, ez * x + ex, ex * y - ey * x
            square = rr * (one + x * x + y * y) - (ux * ux + uy * uy + uz * uz)
            along = ex * x + ey * y - ez
            w = (along + math.sqrt(max(square, zero))) * unit
            seen = (square > zero) & (along > zero) & (w > before) & (w < limit)
            put(inverse, at + i, w if seen else before)
            put(number, at + i, geom if seen else get(number, at + i))


@part
def draw_capsule(inverse, number, rays, c0, c1, r0, r1, rec, g, place, axis, nearest, geom):
    """Put a capsule into the buffers; see `draw_sphere` and `box_of_body`."""
    distinct()
    zero, one = np.float32(0), np.float32(1)
    radius, half = rec[g, L.SIZE], rec[g, L.SIZE + 1]
    px, py, pz = rec[g, place], rec[g, place + 1], rec[g, place + 2]
    dx, dy, dz = rec[g, axis], rec[g, axis + 1], rec[g, axis + 2]
    ax, ay, az = np.float32(dx), np.float32(dy), np.float32(dz)
    along_axis = px * dx + py * dy + pz * dz
    mx, my, mz = py * dz - pz * dy, pz * dx - px * dz, px * dy - py * dx
    moment = mx * mx + my * my + mz * mz - radius * radius
    cx, cy, cz = np.float32(mx), np.float32(my), np.float32(mz)
    rr, h, oa, limit = np.float32(radius * radius), np.float32(half), np.float32(along_axis), np.float32(nearest)
    outside = moment > 0.0
    unit = np.float32(1.0 / moment) if outside else zero
    # The two ends' balls.
    ux, uy, uz = np.float32(px + half * dx), np.float32(py + half * dy), np.float32(pz + half * dz)
    lx, ly, lz = np.float32(px - half * dx), np.float32(py - half * dy), np.float32(pz - half * dz)
    square_of_center = px * px + py * py + pz * pz + half * half - radius * radius
    upper, lower = square_of_center + 2 * half * along_axis, square_of_center - 2 * half * along_axis
    if not outside and (abs(along_axis) <= half or min(upper, lower) <= 0.0):
        return  # the camera is inside
    if upper <= 0.0 or lower <= 0.0:
        return
    upper_unit, lower_unit = np.float32(1.0 / upper), np.float32(1.0 / lower)
    toward = along_axis < 0.0  # seen from inside the endless cylinder, the near end is this one
    size = rays.size // 9
    for row in range(r0, r1):
        top, at = rays[8 * size + row], 4 * size * row
        for i in range(4 * c0, 4 * c1):
            x, y, before = get(rays, i), top + get(rays, 4 * size + i), get(inverse, at + i)
            nx, ny, nz = y * az + ay, -ax - x * az, x * ay - y * ax  # d x axis
            moment_along = cx * x + cy * y - cz
            square = rr * (nx * nx + ny * ny + nz * nz) - moment_along * moment_along
            w_side = (cx * nx + cy * ny + cz * nz + math.sqrt(max(square, zero))) * unit
            place_along = ax * x + ay * y - az - w_side * oa  # times depth: along the axis
            side = outside & (abs(place_along) <= h * w_side)
            up = (place_along > zero) if outside else toward
            ex, ey, ez = ux if up else lx, uy if up else ly, uz if up else lz
            bx, by, bz = -ey - ez * y, ez * x + ex, ex * y - ey * x
            ball = rr * (one + x * x + y * y) - (bx * bx + by * by + bz * bz)
            along = ex * x + ey * y - ez
            w_end = (along + math.sqrt(max(ball, zero))) * (upper_unit if up else lower_unit)
            w = w_side if side else w_end
            hit = (side & (square > zero)) | ((not side) & (ball > zero) & (along > zero))
            seen = hit & (w > before) & (w < limit)
            put(inverse, at + i, w if seen else before)
            put(number, at + i, geom if seen else get(number, at + i))


# -- cylinders, boxes, ellipsoids ------------------------------------------------------------------
# In a solid's own frame, with each axis divided by its half length, these are a cylinder, a cube and a ball of size 1.


@leaf
def own_point(rec, g, place, turn, x, y, z):
    """The camera-frame point (x, y, z) in a solid's own frame, float32."""
    x, y, z = x - rec[g, place], y - rec[g, place + 1], z - rec[g, place + 2]
    a = (rec[g, turn] * x + rec[g, turn + 3] * y + rec[g, turn + 6] * z) * (1.0 / rec[g, L.SIZE])
    b = (rec[g, turn + 1] * x + rec[g, turn + 4] * y + rec[g, turn + 7] * z) * (1.0 / rec[g, L.SIZE + 1])
    c = (rec[g, turn + 2] * x + rec[g, turn + 5] * y + rec[g, turn + 8] * z) * (1.0 / rec[g, L.SIZE + 2])
    return np.float32(a), np.float32(b), np.float32(c)


@leaf
def own_axes(rec, g, turn):
    """The three axes of a solid over their half lengths, nine float32."""
    f4, a, b, c = np.float32, 1.0 / rec[g, L.SIZE], 1.0 / rec[g, L.SIZE + 1], 1.0 / rec[g, L.SIZE + 2]
    ax, ay, az = f4(a * rec[g, turn]), f4(a * rec[g, turn + 3]), f4(a * rec[g, turn + 6])
    bx, by, bz = f4(b * rec[g, turn + 1]), f4(b * rec[g, turn + 4]), f4(b * rec[g, turn + 7])
    cx, cy, cz = f4(c * rec[g, turn + 2]), f4(c * rec[g, turn + 5]), f4(c * rec[g, turn + 8])
    return ax, ay, az, bx, by, bz, cx, cy, cz


@leaf
def slab(origin, direction):
    """Return where a line enters and leaves the slab from -1 to 1 of a coordinate."""
    tiny = np.float32(1e-9)
    over = np.float32(1) / (direction if abs(direction) > tiny else tiny)
    one, two = (np.float32(-1) - origin) * over, (np.float32(1) - origin) * over
    return min(one, two), max(one, two)


@leaf
def through_solid(kind, ox, oy, oz, dx, dy, dz):
    """Return where a line enters and leaves a solid: both distances over d's length, and the face that it enters by.

    Faces: 0 the round one, 1 to 3 the flat ones across the axes. A line that passes by leaves before it enters.
    """
    zero, far = np.float32(0), np.float32(1e9)
    enter, leave, face = -far, far, np.int32(0)
    if kind != BOX:
        deep = zero if kind == CYLINDER else np.float32(1)
        square = dx * dx + dy * dy + deep * dz * dz
        along = ox * dx + oy * dy + deep * oz * dz
        rest = along * along - square * (ox * ox + oy * oy + deep * oz * oz - np.float32(1))
        over = np.float32(1) / max(square, np.float32(1e-12))
        root = math.sqrt(max(rest, zero))
        enter, leave = (-along - root) * over, (-along + root) * over
        leave = leave if rest > zero else enter - np.float32(1e-6) * abs(enter)
    if kind == BOX:
        low, high = slab(ox, dx)
        face, enter, leave = np.int32(1), low, high
        low, high = slab(oy, dy)
        face, enter, leave = (np.int32(2) if low > enter else face), max(enter, low), min(leave, high)
    if kind == BOX or kind == CYLINDER:
        low, high = slab(oz, dz)
        face, enter, leave = (np.int32(3) if low > enter else face), max(enter, low), min(leave, high)
    return enter, leave, face


@part
def draw_solid(inverse, number, rays, c0, c1, r0, r1, rec, g, place, turn, nearest, geom):
    """Put a cylinder, box or ellipsoid into the buffers; see `draw_sphere`.

    Args:
      turn: the column of `rec` where its axes are.
    """
    distinct()
    f4, kind = np.float32, int(rec[g, L.KIND])
    ox, oy, oz = own_point(rec, g, place, turn, 0.0, 0.0, 0.0)
    ax, ay, az, bx, by, bz, cx, cy, cz = own_axes(rec, g, turn)
    limit, tiny, size = f4(nearest), f4(1e-6), rays.size // 9
    for row in range(r0, r1):
        top, at = rays[8 * size + row], 4 * size * row
        for i in range(4 * c0, 4 * c1):
            x, y, before = get(rays, i), top + get(rays, 4 * size + i), get(inverse, at + i)
            dx, dy, dz = ax * x + ay * y - az, bx * x + by * y - bz, cx * x + cy * y - cz
            enter, leave, face = through_solid(kind, ox, oy, oz, dx, dy, dz)
            w = f4(1) / max(enter, tiny)
            seen = (enter < leave) & (enter > tiny) & (w > before) & (w < limit)
            put(inverse, at + i, w if seen else before)
            put(number, at + i, geom if seen else get(number, at + i))


@part
def draw_plane(inverse, number, rays, c0, c1, r0, r1, k, rec, g, geom):
    """Put a rectangle into the buffers, from its FUNCTIONS, as far as the sky does not hide it."""
    distinct()
    at = L.FUNCTIONS
    a, b, c = np.float32(rec[g, at]), np.float32(rec[g, at + 1]), np.float32(rec[g, at + 2])
    ua, ub, uc = np.float32(rec[g, at + 3]), np.float32(rec[g, at + 4]), np.float32(rec[g, at + 5])
    va, vb, vc = np.float32(rec[g, at + 6]), np.float32(rec[g, at + 7]), np.float32(rec[g, at + 8])
    least, most = np.float32(1.0 / k[L.FAR]), np.float32(1.0 / k[L.NEAR])
    at, over = L.VIEW, 1.0 / k[L.HORIZON]  # a ray's run in the world's horizontal plane, over the horizon
    ea, eb, ec = np.float32(k[at] * over), np.float32(k[at + 1] * over), np.float32(k[at + 2] * over)
    na, nb, nc = np.float32(k[at + 3] * over), np.float32(k[at + 4] * over), np.float32(k[at + 5] * over)
    size = rays.size // 9
    for row in range(r0, r1):
        top, at = rays[8 * size + row], 4 * size * row
        for i in range(4 * c0, 4 * c1):
            x, y, before = get(rays, i), top + get(rays, 4 * size + i), get(inverse, at + i)
            w = a * x + b * y + c
            u, v = ua * x + ub * y + uc, va * x + vb * y + vc
            east, north = ea * x + eb * y - ec, na * x + nb * y - nc
            seen = (w > before) & (w >= least) & (w <= most) & (abs(u) <= w) & (abs(v) <= w)
            seen &= east * east + north * north <= w * w
            put(inverse, at + i, w if seen else before)
            put(number, at + i, geom if seen else get(number, at + i))


@part
def plane_functions(rec, g):
    """Fill a plane's FUNCTIONS: inverse depth, and its two coordinates over their half lengths times the inverse
    depth, each as an affine function of the ray's (x, y). Gives whether the plane faces the camera."""
    px, py, pz = rec[g, L.PLACE], rec[g, L.PLACE + 1], rec[g, L.PLACE + 2]
    nx, ny, nz = rec[g, L.AXIS], rec[g, L.AXIS + 1], rec[g, L.AXIS + 2]
    toward = px * nx + py * ny + pz * nz
    if toward == 0.0:
        rec[g, L.FUNCTIONS : L.FUNCTIONS + 9] = 0.0
        return False
    a, b, c = nx / toward, ny / toward, -nz / toward
    rec[g, L.FUNCTIONS], rec[g, L.FUNCTIONS + 1], rec[g, L.FUNCTIONS + 2] = a, b, c
    for axis in range(2):
        ex, ey, ez = rec[g, L.TURN + axis], rec[g, L.TURN + 3 + axis], rec[g, L.TURN + 6 + axis]
        along, over = px * ex + py * ey + pz * ez, 1.0 / rec[g, L.SIZE + axis]
        at = L.FUNCTIONS + 3 + 3 * axis
        rec[g, at], rec[g, at + 1], rec[g, at + 2] = (
            (ex - along * a) * over,
            (ey - along * b) * over,
            (-ez - along * c) * over,
        )
    return toward < 0.0


@part
def corner_of_plane(rec, g, corner):
    """Side, height and depth of one of a rectangle's four corners, in turn."""
    a = rec[g, L.SIZE] if corner == 1 or corner == 2 else -rec[g, L.SIZE]
    b = rec[g, L.SIZE + 1] if corner == 2 or corner == 3 else -rec[g, L.SIZE + 1]
    return (
        rec[g, L.PLACE] + a * rec[g, L.TURN] + b * rec[g, L.TURN + 1],
        rec[g, L.PLACE + 1] + a * rec[g, L.TURN + 3] + b * rec[g, L.TURN + 4],
        -(rec[g, L.PLACE + 2] + a * rec[g, L.TURN + 6] + b * rec[g, L.TURN + 7]),
    )


@part
def box_of_plane(k, rec, g, near, size):
    """Pixels that a rectangle can touch: the outline of its corners, cut off at the near plane."""
    left, right, low, high = 1e9, -1e9, 1e9, -1e9
    for corner in range(4):
        x, y, depth = corner_of_plane(rec, g, corner)
        next_x, next_y, next_depth = corner_of_plane(rec, g, (corner + 1) & 3)
        if depth >= near:
            left, right = min(left, x / depth), max(right, x / depth)
            low, high = min(low, y / depth), max(high, y / depth)
        if (depth >= near) != (next_depth >= near):
            share = (near - depth) / (next_depth - depth)
            cut_x, cut_y = (x + share * (next_x - x)) / near, (y + share * (next_y - y)) / near
            left, right, low, high = min(left, cut_x), max(right, cut_x), min(low, cut_y), max(high, cut_y)
    if left > right:
        return 0, 0, 0, 0
    return screen_box(left, right, low, high, k, size)
