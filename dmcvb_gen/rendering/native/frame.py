"""One frame's poses in, its picture out: what each sample shows first, then one shading a pixel and surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dmcvb_gen.rendering.native.lighting import aim_shadows, light_vertices
from dmcvb_gen.rendering.native.records import (
    AXIS,
    BOXED,
    CONE,
    EYE,
    GOAL,
    KIND,
    LAMP,
    LENGTH,
    MATERIAL,
    MIRROR,
    MIRRORED,
    MIRRORED_AXIS,
    MIRRORED_PLACE,
    NEAR,
    OPACITY,
    OWN_OPACITY,
    PLACE,
    QUAD,
    RGB,
    SIZE,
    SKY,
    STEP,
    TURN,
    VIEW,
    WINDOW,
)
from dmcvb_gen.rendering.native.sampling import leaf, part
from dmcvb_gen.rendering.native.scene import CAPSULE, OPAQUE, PLANE
from dmcvb_gen.rendering.native.shading import shade_body, shade_plane, shade_sky
from dmcvb_gen.rendering.native.visibility import (
    NOTHING,
    box_of_body,
    box_of_plane,
    draw_capsule,
    draw_plane,
    draw_sphere,
    plane_functions,
)

BACK_OF_PLANE = 0.3
"""A plane seen from behind keeps this share of its opacity (MuJoCo)."""


class Frames(NamedTuple):
    """What differs from frame to frame, a leading frame axis; positions in the world, meters."""

    center: np.ndarray  # (frame, geom, 3)
    turn: np.ndarray  # (frame, geom, 3, 3), columns are the geom's axes
    eye: np.ndarray  # (frame, 3)
    axes: np.ndarray  # (frame, 3, 3), the camera's right, up, back as columns
    lamp: np.ndarray  # (frame, 6), position and direction
    rgb: np.ndarray  # (frame, material, 3)
    look: np.ndarray  # (frame,) row of the looks' records
    sky: np.ndarray  # (frame,) texture of the sky; -1: none


class Still(NamedTuple):
    """What stays the same from frame to frame."""

    looks: np.ndarray  # (look, geom, column) the first columns of `rec`
    constants: np.ndarray  # the first entries of `k`
    boxes: np.ndarray  # (box, 6) solid boxes behind walls, lowest and highest corner
    grid: np.ndarray  # (2, line) vertices of the lit plane
    texels: np.ndarray
    table: np.ndarray
    xs: np.ndarray  # see visibility.sample_tables
    ys: np.ndarray
    offsets: np.ndarray


class Work(NamedTuple):
    """Memory of one painter, used again for every frame."""

    inverse: np.ndarray  # (4 * pixels^2,) float32, inverse depth of each sample
    number: np.ndarray  # uint8, geom of each sample
    behind: np.ndarray  # as `inverse`: of the mirrored bodies, or of a plane that is seen through
    behind_number: np.ndarray
    rec: np.ndarray  # (geom, records.WIDTH)
    k: np.ndarray  # (records.LENGTH,)
    vertices: np.ndarray  # (vertex, vertex, 3) the lamp's color on the lit plane
    heaven: np.ndarray  # (pixels^2, 3) the sky's color where `known`
    known: np.ndarray  # (pixels^2,) bool


def make_work(geoms: int, pixels: int, lines: np.ndarray, width: int) -> Work:
    """Memory for frames of `pixels` a side."""
    samples = 4 * pixels * pixels
    return Work(
        inverse=np.zeros(samples, np.float32),
        number=np.zeros(samples, np.uint8),
        behind=np.zeros(samples, np.float32),
        behind_number=np.zeros(samples, np.uint8),
        rec=np.zeros((geoms, width)),
        k=np.zeros(LENGTH),
        vertices=np.zeros((max(int(lines[0]), 1), max(int(lines[1]), 1), 3)),
        heaven=np.zeros((pixels * pixels, 3)),
        known=np.zeros(pixels * pixels, np.bool_),
    )


# -- poses -----------------------------------------------------------------------------------------


@leaf
def turned(axes, f, row, x, y, z):
    """Component `row` of a world direction in the camera's frame."""
    return axes[f, 0, row] * x + axes[f, 1, row] * y + axes[f, 2, row] * z


@part
def pose_geoms(rec, looks, center, turn, eye, axes, rgb, look, f):
    """Fill the records of frame f."""
    for g in range(rec.shape[0]):
        for column in range(looks.shape[2]):
            rec[g, column] = looks[look, g, column]
        x, y, z = center[f, g, 0] - eye[f, 0], center[f, g, 1] - eye[f, 1], center[f, g, 2] - eye[f, 2]
        for row in range(3):
            rec[g, PLACE + row] = turned(axes, f, row, x, y, z)
            for column in range(3):
                rec[g, TURN + 3 * row + column] = turned(
                    axes, f, row, turn[f, g, 0, column], turn[f, g, 1, column], turn[f, g, 2, column]
                )
            rec[g, AXIS + row] = rec[g, TURN + 3 * row + 2]
        material = int(rec[g, MATERIAL])
        if material >= 0:
            for c in range(3):
                rec[g, RGB + c] = rgb[f, material, c]


@part
def pose_camera(k, eye, axes, lamp, sky, f):
    """Fill a frame's entries of k."""
    for row in range(3):
        for column in range(3):
            k[VIEW + 3 * row + column] = axes[f, row, column]
        k[LAMP + row] = turned(axes, f, row, lamp[f, 0] - eye[f, 0], lamp[f, 1] - eye[f, 1], lamp[f, 2] - eye[f, 2])
        k[LAMP + 3 + row] = turned(axes, f, row, lamp[f, 3], lamp[f, 4], lamp[f, 5])
    k[EYE], k[EYE + 1], k[EYE + 2] = 0.0, 0.0, -1.0
    k[SKY] = sky[f]
    k[QUAD] = -1.0


@leaf
def mirrored(x, y, z, nx, ny, nz, away):
    """A point mirrored in the plane with unit normal n, `away` from the origin; a direction with `away` 0."""
    twice = 2.0 * (x * nx + y * ny + z * nz - away)
    return x - twice * nx, y - twice * ny, z - twice * nz


@part
def reflect(k, rec):
    """Mirror bodies, lamp and headlight."""
    m = int(k[MIRROR])
    nx, ny, nz = rec[m, AXIS], rec[m, AXIS + 1], rec[m, AXIS + 2]
    away = rec[m, PLACE] * nx + rec[m, PLACE + 1] * ny + rec[m, PLACE + 2] * nz
    for g in range(rec.shape[0]):
        for source, target, far in ((PLACE, MIRRORED_PLACE, away), (AXIS, MIRRORED_AXIS, 0.0)):
            x, y, z = mirrored(rec[g, source], rec[g, source + 1], rec[g, source + 2], nx, ny, nz, far)
            rec[g, target], rec[g, target + 1], rec[g, target + 2] = x, y, z
    for i, far in ((0, 0.0), (3, away), (6, 0.0)):
        x, y, z = mirrored(k[EYE + i], k[EYE + i + 1], k[EYE + i + 2], nx, ny, nz, far)
        k[MIRRORED + i], k[MIRRORED + i + 1], k[MIRRORED + i + 2] = x, y, z


@part
def in_a_box(boxes, eye, f):
    """Whether the eye is inside one of the solid boxes."""
    for b in range(boxes.shape[0]):
        inside = True
        for axis in range(3):
            inside = inside and boxes[b, axis] < eye[f, axis] < boxes[b, 3 + axis]
        if inside:
            return True
    return False


# -- visibility ------------------------------------------------------------------------------------


@part
def draw_body(inverse, number, xs, ys, offsets, k, rec, g, place, axis):
    """Draw a body, whose center and axis are in these columns of its record."""
    capsule = rec[g, KIND] == CAPSULE
    half = rec[g, SIZE + 1] if capsule else 0.0
    c0, c1, r0, r1 = box_of_body(rec, g, place, axis, half, ys.size, k[STEP])
    if c0 >= c1 or r0 >= r1:
        return
    nearest, geom = 1.0 / k[NEAR], np.uint8(g)
    if capsule:
        draw_capsule(inverse, number, xs, ys, offsets, c0, c1, r0, r1, rec, g, place, axis, nearest, geom)
    else:
        px, py, pz = rec[g, place], rec[g, place + 1], rec[g, place + 2]
        draw_sphere(inverse, number, xs, ys, offsets, c0, c1, r0, r1, px, py, pz, rec[g, SIZE], nearest, geom)


@part
def draw_flat(inverse, number, xs, ys, offsets, k, rec, g):
    """Draw a plane."""
    c0, c1, r0, r1 = box_of_plane(rec, g, k[NEAR], ys.size, k[STEP])
    if c0 < c1 and r0 < r1:
        draw_plane(inverse, number, xs, ys, offsets, c0, c1, r0, r1, k, rec, g, np.uint8(g))


@part
def draw_front(inverse, number, xs, ys, offsets, k, rec, hide_goal, inside):
    """Fill the buffers with the opaque surfaces. Gives whether there may be others to see through.

    Args:
      inside: the eye is inside a box.
    """
    inverse[:] = 0.0
    number[:] = NOTHING
    veiled = False
    for g in range(rec.shape[0]):
        if rec[g, KIND] != PLANE:
            if not (hide_goal and rec[g, GOAL] > 0.0):
                draw_body(inverse, number, xs, ys, offsets, k, rec, g, PLACE, AXIS)
            continue
        facing = plane_functions(rec, g)
        rec[g, OPACITY] = rec[g, OWN_OPACITY] * (1.0 if facing else BACK_OF_PLANE)
        if rec[g, OPACITY] >= OPAQUE:
            draw_flat(inverse, number, xs, ys, offsets, k, rec, g)
        elif facing or inside or rec[g, BOXED] == 0.0:
            veiled = True
    return veiled


@part
def draw_behind(inverse, behind, behind_number, xs, ys, offsets, k, rec, hide_goal, veiled):
    """Fill the second buffers: planes to be seen through (`veiled`), in front of the first ones; or mirror images."""
    behind_number[:] = NOTHING
    if veiled:
        behind[:] = inverse
        for g in range(rec.shape[0]):
            if rec[g, KIND] == PLANE and rec[g, OPACITY] < OPAQUE:
                draw_flat(behind, behind_number, xs, ys, offsets, k, rec, g)
    elif k[MIRROR] >= 0.0:
        behind[:] = 0.0
        reflect(k, rec)
        for g in range(rec.shape[0]):
            if rec[g, KIND] != PLANE and not (hide_goal and rec[g, GOAL] > 0.0):
                draw_body(behind, behind_number, xs, ys, offsets, k, rec, g, MIRRORED_PLACE, MIRRORED_AXIS)


# -- colors ----------------------------------------------------------------------------------------


@part
def shade_surface(k, rec, texels, table, grid, vertices, heaven, known, geom, behind, veiled, pixels, row, column):
    """(red, green, blue) in [0, 1] of what samples of a pixel show.

    Args:
      geom: in front; `behind`: what is mirrored in it or, if `veiled`, what it is seen through.
    """
    red, green, blue = 0.0, 0.0, 0.0
    if behind != NOTHING and not veiled:
        a, b, c, d, e, f = shade_body(k, rec, texels, table, behind, pixels, row, column, True)
        red, green, blue = min(a + d, 1.0), min(b + e, 1.0), min(c + f, 1.0)
    if geom == NOTHING:
        at = row * pixels + column
        if not known[at]:
            known[at] = True
            heaven[at, 0], heaven[at, 1], heaven[at, 2] = shade_sky(k, texels, table, pixels, row, column)
        red, green, blue = heaven[at, 0], heaven[at, 1], heaven[at, 2]
    else:
        if rec[geom, KIND] == PLANE:
            a, b, c, d, e, f = shade_plane(k, rec, texels, table, grid, vertices, geom, pixels, row, column)
        else:
            a, b, c, d, e, f = shade_body(k, rec, texels, table, geom, pixels, row, column, False)
        red = min(min(red + a, 1.0) + d, 1.0)
        green = min(min(green + b, 1.0) + e, 1.0)
        blue = min(min(blue + c, 1.0) + f, 1.0)
    if behind != NOTHING and veiled:
        a, b, c, d, e, f = shade_plane(k, rec, texels, table, grid, vertices, behind, pixels, row, column)
        rest = (1.0 - rec[behind, OPACITY]) * (1.0 - rec[behind, OPACITY])  # MuJoCo draws what is transparent twice
        red = red * rest + min(a + d, 1.0) * (1.0 - rest)
        green = green * rest + min(b + e, 1.0) * (1.0 - rest)
        blue = blue * rest + min(c + f, 1.0) * (1.0 - rest)
    return red, green, blue


@leaf
def drop_hidden_images(number, inverse, behind, behind_number, first, mirror):
    """Keep a pixel's mirror images where the mirror is in front, and the image beyond it."""
    for s in range(first, first + 4):
        if behind_number[s] != NOTHING and (number[s] != mirror or behind[s] >= inverse[s]):
            behind_number[s] = NOTHING


@leaf
def share_of(number, behind_number, first, s):
    """How many of a pixel's samples show what sample s does; 0 if one before it does."""
    count = 1
    for t in range(first, first + 4):
        if t != s and number[t] == number[s] and behind_number[t] == behind_number[s]:
            if t < s:
                return 0
            count += 1
    return count


@part
def shade_picture(
    k, rec, texels, table, grid, vertices, heaven, known,
    inverse, number, behind, behind_number, veiled, pixels, out, f,
):  # fmt: skip
    """Write frame f of `out`: each surface in a pixel is shaded once and weighted by its samples."""
    mirror, layered = int(k[MIRROR]), veiled or k[MIRROR] >= 0.0
    half = (pixels + 1) // 2
    for place in range(4 * half * half):  # two by two, as texture footprints are shared
        quad, corner = place >> 2, place & 3
        row, column = 2 * (quad // half) + (corner >> 1) - (pixels & 1), 2 * (quad % half) + (corner & 1)
        if row < 0 or row >= pixels or column >= pixels:
            continue
        first = 4 * (row * pixels + column)
        if layered and not veiled:
            drop_hidden_images(number, inverse, behind, behind_number, first, mirror)
        red, green, blue, left, s = 0.0, 0.0, 0.0, 4, first
        while left > 0:
            count = share_of(number, behind_number, first, s)
            if count > 0:
                a, b, c = shade_surface(
                    k, rec, texels, table, grid, vertices, heaven, known,
                    int(number[s]), int(behind_number[s]), veiled, pixels, row, column,
                )  # fmt: skip
                red, green, blue, left = red + count * a, green + count * b, blue + count * c, left - count
            s += 1
        out[f, row, column, 0] = np.uint8(red * 63.75 + 0.5)
        out[f, row, column, 1] = np.uint8(green * 63.75 + 0.5)
        out[f, row, column, 2] = np.uint8(blue * 63.75 + 0.5)


@leaf
def same_sky(axes, sky, f):
    """Whether frame f shows the sky as the frame before it did."""
    same = f > 0 and sky[f] == sky[f - 1]
    for row in range(3):
        for column in range(3):
            same = same and axes[f, row, column] == axes[f - 1, row, column]
    return same


@part
def light_frame(k, rec, grid, vertices):
    """Make the lamp's light on the lit plane and its shadow map ready."""
    for i in range(4):
        k[WINDOW + i] = 0.0
    if k[CONE] <= 0.0:
        return
    aim_shadows(k, rec)
    for g in range(rec.shape[0]):
        if rec[g, KIND] == PLANE:
            light_vertices(k, rec, grid, vertices, g)


@part
def paint_frames(
    looks, constants, boxes, grid, texels, table, xs, ys, offsets,
    center, turn, eye, axes, lamp, rgb, look, sky,
    inverse, number, behind, behind_number, rec, k, vertices, heaven, known,
    hide_goal, out,
):  # fmt: skip
    """Paint frames into `out` (frame, pixels, pixels, 3) uint8; arguments as `Still`, `Frames` and `Work` name them."""
    k[: constants.size] = constants
    for f in range(look.size):
        pose_geoms(rec, looks, center, turn, eye, axes, rgb, look[f], f)
        pose_camera(k, eye, axes, lamp, sky, f)
        veiled = draw_front(inverse, number, xs, ys, offsets, k, rec, hide_goal, in_a_box(boxes, eye, f))
        draw_behind(inverse, behind, behind_number, xs, ys, offsets, k, rec, hide_goal, veiled)
        light_frame(k, rec, grid, vertices)
        if not same_sky(axes, sky, f):
            known[:] = False
        shade_picture(
            k, rec, texels, table, grid, vertices, heaven, known,
            inverse, number, behind, behind_number, veiled, ys.size, out, f,
        )  # fmt: skip


@part
def label_frames(
    looks, constants, boxes, grid, texels, table, xs, ys, offsets,
    center, turn, eye, axes, lamp, rgb, look, sky,
    inverse, number, behind, behind_number, rec, k, vertices, heaven, known,
    depth, geom,
):  # fmt: skip
    """Depth (0: sky) and geom (-1: sky) of frames, from each pixel's first sample. Planes hide what is behind them."""
    k[: constants.size] = constants
    for f in range(look.size):
        pose_geoms(rec, looks, center, turn, eye, axes, rgb, look[f], f)
        pose_camera(k, eye, axes, lamp, sky, f)
        rec[:, OWN_OPACITY] = 1.0 / BACK_OF_PLANE
        draw_front(inverse, number, xs, ys, offsets, k, rec, False, False)
        for row in range(ys.size):
            for column in range(ys.size):
                sample = 4 * (row * ys.size + column)
                sky_there = number[sample] == NOTHING
                depth[f, row, column] = np.float32(0) if sky_there else np.float32(1) / inverse[sample]
                geom[f, row, column] = -1 if sky_there else number[sample]


def painter(version: int):
    """`paint_frames` compiled and kept on disk under a version: numba itself looks at one file's date alone."""

    @njit(nogil=True, error_model="numpy", cache=True)
    def paint(
        looks, constants, boxes, grid, texels, table, xs, ys, offsets,
        center, turn, eye, axes, lamp, rgb, look, sky,
        inverse, number, behind, behind_number, rec, k, vertices, heaven, known,
        hide_goal, out,
    ):  # fmt: skip
        if version != 0:
            paint_frames(
                looks, constants, boxes, grid, texels, table, xs, ys, offsets,
                center, turn, eye, axes, lamp, rgb, look, sky,
                inverse, number, behind, behind_number, rec, k, vertices, heaven, known,
                hide_goal, out,
            )  # fmt: skip

    return paint


def labeler(version: int):
    """`label_frames` compiled and kept on disk under a version."""

    @njit(nogil=True, error_model="numpy", cache=True)
    def label(
        looks, constants, boxes, grid, texels, table, xs, ys, offsets,
        center, turn, eye, axes, lamp, rgb, look, sky,
        inverse, number, behind, behind_number, rec, k, vertices, heaven, known,
        depth, geom,
    ):  # fmt: skip
        if version != 0:
            label_frames(
                looks, constants, boxes, grid, texels, table, xs, ys, offsets,
                center, turn, eye, axes, lamp, rgb, look, sky,
                inverse, number, behind, behind_number, rec, k, vertices, heaven, known,
                depth, geom,
            )  # fmt: skip

    return label
