"""Paint a frame from its poses: find what each sample shows, then shade once for each pixel and surface."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native import lighting, shading, visibility
from dmcvb_gen.rendering.native.layout import distinct, entry, get, leaf, part, put, put3, stage
from dmcvb_gen.rendering.native.scene import CAPSULE, OPAQUE, PLANE, SPHERE
from dmcvb_gen.rendering.native.visibility import NOTHING

f4, i4, i8 = np.float32, np.int32, np.int64
BACK_OF_PLANE = 0.3
"""A plane seen from behind keeps this share of its opacity (MuJoCo)."""
BAND = 8192
"""Pixels shaded together, at most, but at least a row: what that takes in memory."""
ALL, NO_GOAL, NOTHING_MOVING = 0, 1, 2
"""Which geoms are drawn."""


# What numba keeps on disk names these three classes: old code that names another one cannot be read at its old line.


class Frames(NamedTuple):
    """Data that differ from frame to frame, with a leading frame axis; positions in the world, meters."""

    center: np.ndarray  # (frame, geom, 3)
    turn: np.ndarray  # (frame, geom, 3, 3), columns are the geom's axes
    eye: np.ndarray  # (frame, 3)
    axes: np.ndarray  # (frame, 3, 3), the camera's right, up, back as columns
    lamp: np.ndarray  # (frame, lamp, 6), positions and directions
    rgb: np.ndarray  # (frame, material, 3)
    look: np.ndarray  # (frame,) row of the looks' records
    sky: np.ndarray  # (frame,) texture of the sky; -1: none
    inside: np.ndarray  # (frame,) bool, the eye is inside one of the solid boxes behind walls


class SceneConstants(NamedTuple):
    """Data that are the same in all frames."""

    looks: np.ndarray  # (look, geom, column) the first columns of `rec`
    constants: np.ndarray  # the first entries of `k`
    lamps: np.ndarray  # (lamp, 12) their SPOT and CONE; one of zeros if there are none
    texels: np.ndarray  # see textures
    width: int  # of a row of the table of textures
    rays: np.ndarray  # see visibility.sample_rays


class Scratch(NamedTuple):
    """Memory of one painter, used again for every frame; numba pays for every array that it hands over.

    A job is a surface in a pixel. `jobs` has their rows, columns and numbers of samples (each `room` long), then the
    lists of the jobs of each geom and of the sky, then those of what is mirrored in them, or seen through, then the
    lengths of these lists.
    """

    inverse: np.ndarray  # (4 * pixels^2,) float32, inverse depth of each sample
    number: np.ndarray  # uint8, geom of each sample
    behind: np.ndarray  # as `inverse`: of the mirrored bodies, or of a plane that is seen through
    behind_number: np.ndarray
    rec: np.ndarray  # (geom, layout.WIDTH)
    k: np.ndarray  # (layout.LENGTH,)
    plane: np.ndarray  # float32, the lit plane's grid (2, line), the lamp's color at its vertices, then all lights'
    s: np.ndarray  # see layout
    jobs: np.ndarray  # int32, see above
    color: np.ndarray  # float32, (3, room) of each job, then the sky's (3, pixels^2)
    kept: np.ndarray  # (pixels, pixels, 3) uint8, what does not move


def make_scratch(geoms: int, pixels: int, grid: np.ndarray) -> Scratch:
    """Memory for frames of `pixels` a side."""
    samples, room = 4 * pixels * pixels, room_for.py_func(pixels)
    return Scratch(
        inverse=np.zeros(samples, np.float32),
        number=np.zeros(samples, np.uint8),
        behind=np.zeros(samples, np.float32),
        behind_number=np.zeros(samples, np.uint8),
        rec=np.zeros((geoms, L.WIDTH)),
        k=np.zeros(L.LENGTH),
        plane=np.concatenate([grid.ravel(), np.zeros(6 * grid.shape[1] ** 2)]).astype(np.float32),
        s=np.zeros(L.ROWS * L.CHUNK, np.float32),
        jobs=np.empty(lists_at.py_func(room, geoms, 2, 0) + 2 * (geoms + 1), np.int32),  # taken as it is written
        color=np.zeros(3 * room + 3 * pixels * pixels, np.float32),
        kept=np.zeros((pixels, pixels, 3), np.uint8),
    )


@leaf
def room_for(pixels):
    """Most jobs at a time: four for each pixel of some rows that are shaded together."""
    return 4 * pixels * min(max(BAND // pixels, 1), pixels)


@leaf
def lists_at(room, geoms, which, g):
    """Return the index in `jobs` of the list of geom g (`geoms`: the sky), in front (`which` 0) or behind (1)."""
    return (3 + which * (geoms + 1) + g) * room


@leaf
def length_at(room, geoms, which, g):
    """Return the index in `jobs` of the length of that list."""
    return (3 + 2 * (geoms + 1)) * room + which * (geoms + 1) + g


# -- poses -----------------------------------------------------------------------------------------


@leaf
def turned(axes, f, row, x, y, z):
    """Component `row` of a world direction in the camera's frame."""
    return axes[f, 0, row] * x + axes[f, 1, row] * y + axes[f, 2, row] * z


@part
def pose_geoms(rec, looks, center, turn, eye, axes, rgb, look, f):
    """Fill the records of frame f."""
    rec[:, : looks.shape[2]] = looks[look]
    for g in range(rec.shape[0]):
        x, y, z = center[f, g, 0] - eye[f, 0], center[f, g, 1] - eye[f, 1], center[f, g, 2] - eye[f, 2]
        for row in range(3):
            rec[g, L.PLACE + row] = turned(axes, f, row, x, y, z)
            for column in range(3):
                rec[g, L.TURN + 3 * row + column] = turned(
                    axes, f, row, turn[f, g, 0, column], turn[f, g, 1, column], turn[f, g, 2, column]
                )
        if rec[g, L.CORD] > 0.0:
            x, y, z = rec[g, L.TURN + 2], rec[g, L.TURN + 5], rec[g, L.TURN + 8]
            rec[g, L.SIZE + 1] = max(math.sqrt(x * x + y * y + z * z), 1e-9)
            for row in range(3):
                rec[g, L.TURN + 3 * row + 2] /= rec[g, L.SIZE + 1]
        for row in range(3):
            rec[g, L.AXIS + row] = rec[g, L.TURN + 3 * row + 2]
        if rec[g, L.MATERIAL] >= 0.0:
            rec[g, L.RGB : L.RGB + 3] = rgb[f, int(rec[g, L.MATERIAL])]


@part
def face_planes(rec):
    """Fill the planes' FUNCTIONS, and their OPACITY from the side that is seen."""
    for g in range(rec.shape[0]):
        if rec[g, L.KIND] == PLANE:
            facing = visibility.plane_functions(rec, g)
            rec[g, L.OPACITY] = rec[g, L.OWN_OPACITY] * (1.0 if facing else BACK_OF_PLANE)


@part
def choose_lamp(k, constants, lamps, lamp, eye, axes, f, which):
    """Fill the lamp's entries of k with one of the lamps; the headlight shines with the first one alone."""
    k[L.SPOT : L.SPOT + 12] = lamps[which]
    for i in range(9):
        k[L.HEADLIGHT + i] = constants[L.HEADLIGHT + i] if which == 0 else 0.0
    x, y, z = lamp[f, which, 0] - eye[f, 0], lamp[f, which, 1] - eye[f, 1], lamp[f, which, 2] - eye[f, 2]
    for row in range(3):
        k[L.LAMP + row] = turned(axes, f, row, x, y, z)
        k[L.LAMP + 3 + row] = turned(axes, f, row, lamp[f, which, 3], lamp[f, which, 4], lamp[f, which, 5])


@leaf
def mirrored(x, y, z, nx, ny, nz, away):
    """A point mirrored in the plane with unit normal n, `away` from the origin; a direction with `away` 0."""
    twice = 2.0 * (x * nx + y * ny + z * nz - away)
    return x - twice * nx, y - twice * ny, z - twice * nz


@part
def reflect(k, rec):
    """Mirror bodies, lamp and headlight."""
    m = int(k[L.MIRROR])
    nx, ny, nz = rec[m, L.AXIS], rec[m, L.AXIS + 1], rec[m, L.AXIS + 2]
    away = rec[m, L.PLACE] * nx + rec[m, L.PLACE + 1] * ny + rec[m, L.PLACE + 2] * nz
    for g in range(rec.shape[0]):
        for source, target, far in ((L.PLACE, L.MIRRORED_PLACE, away), (L.AXIS, L.MIRRORED_AXIS, 0.0)):
            x, y, z = mirrored(rec[g, source], rec[g, source + 1], rec[g, source + 2], nx, ny, nz, far)
            rec[g, target], rec[g, target + 1], rec[g, target + 2] = x, y, z
        for c in range(3):
            x, y, z = mirrored(rec[g, L.TURN + c], rec[g, L.TURN + 3 + c], rec[g, L.TURN + 6 + c], nx, ny, nz, 0.0)
            rec[g, L.MIRRORED_TURN + c], rec[g, L.MIRRORED_TURN + 3 + c], rec[g, L.MIRRORED_TURN + 6 + c] = x, y, z
    for i, far in ((0, 0.0), (3, away), (6, 0.0)):
        x, y, z = mirrored(k[L.EYE + i], k[L.EYE + i + 1], k[L.EYE + i + 2], nx, ny, nz, far)
        k[L.MIRRORED + i], k[L.MIRRORED + i + 1], k[L.MIRRORED + i + 2] = x, y, z


@part
def swap_with_image(rec, g):
    """Exchange plane g and its mirror image; gives whether what is at its place now faces the camera."""
    for there, here, count in (
        (L.MIRRORED_PLACE, L.PLACE, 3),
        (L.MIRRORED_TURN, L.TURN, 9),
        (L.MIRRORED_AXIS, L.AXIS, 3),
    ):
        for i in range(count):
            rec[g, there + i], rec[g, here + i] = rec[g, here + i], rec[g, there + i]
    return visibility.plane_functions(rec, g)


# -- visibility ------------------------------------------------------------------------------------


@leaf
def drawn(rec, g, which):
    """Return True if geom g is drawn (ALL, NO_GOAL, NOTHING_MOVING)."""
    return which == ALL or (rec[g, L.GOAL] == 0.0 and (which == NO_GOAL or rec[g, L.MOVING] == 0.0))


@part
def draw_bodies(inverse, number, rays, k, rec, which, place, axis):
    """Draw all bodies (`drawn`); their centers and axes are in these columns of their records."""
    nearest = 1.0 / k[L.NEAR]
    for g in range(rec.shape[0]):
        if rec[g, L.KIND] == PLANE or not drawn(rec, g, which):
            continue
        c0, c1, r0, r1 = visibility.box_of_body(k, rec, g, place, axis, rays.size // 9)
        geom = np.uint8(g)
        if c0 >= c1 or r0 >= r1:
            continue
        if rec[g, L.KIND] == CAPSULE:
            visibility.draw_capsule(inverse, number, rays, c0, c1, r0, r1, rec, g, place, axis, nearest, geom)
        elif rec[g, L.KIND] == SPHERE:
            visibility.draw_sphere(inverse, number, rays, c0, c1, r0, r1, rec, g, place, nearest, geom)
        else:
            turn = i8(L.TURN if place == L.PLACE else L.MIRRORED_TURN)
            visibility.draw_solid(inverse, number, rays, c0, c1, r0, r1, rec, g, place, turn, nearest, geom)


@part
def draw_seen_plane(inverse, number, rays, k, rec, g):
    """Draw a plane where it can be seen."""
    c0, c1, r0, r1 = visibility.box_of_plane(k, rec, g, k[L.NEAR], rays.size // 9)
    if c0 < c1 and r0 < r1:
        visibility.draw_plane(inverse, number, rays, c0, c1, r0, r1, k, rec, g, np.uint8(g))


@part
def draw_planes(inverse, number, rays, k, rec, opaque):
    """Draw the planes that are opaque, or the others."""
    for g in range(rec.shape[0]):
        if rec[g, L.KIND] == PLANE and (rec[g, L.OPACITY] >= OPAQUE) == opaque:
            draw_seen_plane(inverse, number, rays, k, rec, g)


@part
def draw_mirrored_planes(inverse, number, rays, k, rec):
    """Draw the mirror images of the other planes, as far as their front is seen in the mirror."""
    for g in range(rec.shape[0]):
        if rec[g, L.KIND] == PLANE and g != int(k[L.MIRROR]):
            if swap_with_image(rec, g):
                draw_seen_plane(inverse, number, rays, k, rec, g)
            swap_with_image(rec, g)


@part
def veils(rec, inside):
    """Return True if there may be transparent planes.

    Args:
      inside: the eye is inside a box.
    """
    for g in range(rec.shape[0]):
        if rec[g, L.KIND] == PLANE and rec[g, L.OPACITY] < OPAQUE:
            facing = rec[g, L.OPACITY] == rec[g, L.OWN_OPACITY]
            if facing or inside or rec[g, L.BOXED] == 0.0:
                return True
    return False


@part
def clear(inverse, number, k, pixels):
    """Empty the samples in CLIP."""
    distinct()
    first, past = 4 * int(k[L.CLIP]), 4 * int(k[L.CLIP + 1])
    for row in range(int(k[L.CLIP + 2]), int(k[L.CLIP + 3])):
        at = 4 * row * pixels
        for i in range(at + first, at + past):
            put(inverse, i, f4(0))
            put(number, i, np.uint8(NOTHING))


@part
def copy_depths(inverse, behind, k, pixels):
    """Make `behind` as deep as `inverse` in CLIP."""
    distinct()
    first, past = 4 * int(k[L.CLIP]), 4 * int(k[L.CLIP + 1])
    for row in range(int(k[L.CLIP + 2]), int(k[L.CLIP + 3])):
        at = 4 * row * pixels
        for i in range(at + first, at + past):
            put(behind, i, get(inverse, i))


@part
def drop_hidden_images(inverse, number, behind, behind_number, k, pixels):
    """Keep mirror images where the mirror is in front and the image beyond it."""
    distinct()
    mirror = np.uint8(k[L.MIRROR])
    for i in range(4 * pixels * int(k[L.CLIP + 2]), 4 * pixels * int(k[L.CLIP + 3])):
        seen = (get(number, i) == mirror) & (get(behind, i) < get(inverse, i))
        put(behind_number, i, get(behind_number, i) if seen else np.uint8(NOTHING))


@part
def draw(scratch, rays, which, veiled):
    """Fill the buffers with the opaque surfaces, and the second ones with the planes to be seen through (`veiled`),
    in front of them, or else with mirror images."""
    inverse, number, k, rec = scratch.inverse, scratch.number, scratch.k, scratch.rec
    behind, behind_number = scratch.behind, scratch.behind_number
    pixels = rays.size // 9
    clear(inverse, number, k, pixels)
    clear(behind, behind_number, k, pixels)
    draw_bodies(inverse, number, rays, k, rec, which, i8(L.PLACE), i8(L.AXIS))
    draw_planes(inverse, number, rays, k, rec, True)
    if veiled:
        copy_depths(inverse, behind, k, pixels)
        draw_planes(behind, behind_number, rays, k, rec, False)
    elif k[L.MIRROR] >= 0.0:
        reflect(k, rec)
        draw_bodies(behind, behind_number, rays, k, rec, which, i8(L.MIRRORED_PLACE), i8(L.MIRRORED_AXIS))
        draw_mirrored_planes(behind, behind_number, rays, k, rec)
        drop_hidden_images(inverse, number, behind, behind_number, k, pixels)


# -- jobs ------------------------------------------------------------------------------------------


@leaf
def share_of(number, behind_number, first, sample):
    """Count the samples of a pixel that show the same as one of them; 0 if an earlier sample shows it too."""
    count = 1
    geom, behind = get(number, sample), get(behind_number, sample)
    for t in range(first, first + 4):
        if t != sample and get(number, t) == geom and get(behind_number, t) == behind:
            if t < sample:
                return 0
            count += 1
    return count


@leaf
def add_job(jobs, color, room, geoms, count, row, column, geom, behind, share):
    """List a job: `share` of a pixel's samples show `geom` with something behind."""
    put(jobs, count, i4(row))
    put(jobs, room + count, i4(column))
    put(jobs, 2 * room + count, i4(share))
    for c in range(3):
        put(color, c * room + count, f4(0))
    g = geoms if geom == NOTHING else geom
    length = length_at(room, geoms, 0, g)
    put(jobs, lists_at(room, geoms, 0, g) + get(jobs, length), i4(count))
    put(jobs, length, i4(get(jobs, length) + 1))
    if behind != NOTHING:
        length = length_at(room, geoms, 1, behind)
        put(jobs, lists_at(room, geoms, 1, behind) + get(jobs, length), i4(count))
        put(jobs, length, i4(get(jobs, length) + 1))


@part
def list_jobs(number, behind_number, jobs, color, k, pixels, geoms, first_row, past_row):
    """List the jobs of some rows, inside CLIP, a pixel's one after the other. Gives how many there are."""
    distinct()
    room = room_for(pixels)
    for i in range(length_at(room, geoms, 0, 0), length_at(room, geoms, 2, 0)):
        put(jobs, i, i4(0))
    count = 0
    for row in range(first_row, past_row):
        for column in range(int(k[L.CLIP]), int(k[L.CLIP + 1])):
            first = 4 * (row * pixels + column)
            for sample in range(first, first + 4):
                share = share_of(number, behind_number, first, sample)
                if share > 0:
                    geom, behind = np.int64(get(number, sample)), np.int64(get(behind_number, sample))
                    add_job(jobs, color, room, geoms, count, row, column, geom, behind, share)
                    count += 1
    return count


@part
def write_pixels(jobs, color, room, count, out):
    """Weigh the colors of each pixel's jobs by their samples into a picture (row, column, 3) uint8."""
    j = 0
    while j < count:
        row, column, left = get(jobs, j), get(jobs, room + j), i4(4)
        red, green, blue = f4(0), f4(0), f4(0)
        while left > 0:
            share = get(jobs, 2 * room + j)
            weight = f4(share)
            red += weight * get(color, j)
            green += weight * get(color, room + j)
            blue += weight * get(color, 2 * room + j)
            left, j = i4(left - share), j + 1
        out[row, column, 0] = np.uint8(i4(red * f4(63.75) + f4(0.5)))
        out[row, column, 1] = np.uint8(i4(green * f4(63.75) + f4(0.5)))
        out[row, column, 2] = np.uint8(i4(blue * f4(63.75) + f4(0.5)))


# -- colors ----------------------------------------------------------------------------------------


@part
def take_base(s, n, jobs, color, room, first):
    """Copy the colors under n jobs into the base colors."""
    distinct()
    for i in range(n):
        job = get(jobs, first + i)
        put3(s, L.BASE + i, get(color, job), get(color, room + job), get(color, 2 * room + job))


@part
def give_base(s, n, jobs, color, room, first):
    """The base colors back to their jobs."""
    for i in range(n):
        job = get(jobs, first + i)
        for c in range(3):
            put(color, c * room + job, get(s, L.BASE + c * L.CHUNK + i))


@stage
def shade_geom(scene, scratch, pixels, which, g, mirrored, veil, further):
    """Lay geom g over the colors of its jobs.

    Args:
      which: of its lists (0: in front); `mirrored`: its mirror image; `veil`, `further`: see `shading.cover`.
    """
    s, k, rec, jobs, color = scratch.s, scratch.k, scratch.rec, scratch.jobs, scratch.color
    geoms, room = rec.shape[0], room_for(pixels)
    first, total = lists_at(room, geoms, which, g), np.int64(get(jobs, length_at(room, geoms, which, g)))
    shading.set_color(k, rec, g, k[L.REFLECTANCE] if mirrored else 1.0)
    for at in range(first, first + total, L.CHUNK):
        n = min(L.CHUNK, first + total - at)
        shading.aim(s, n, jobs, room, at, pixels, k[L.STEP])
        take_base(s, n, jobs, color, room, at)
        if rec[g, L.KIND] == PLANE:
            if mirrored:
                swap_with_image(rec, g)
            shading.shade_plane(s, n, k, rec, scene.texels, scene.width, scratch.plane, g, mirrored)
            if mirrored:
                swap_with_image(rec, g)
        else:
            shading.shade_body(s, n, k, rec, scene.texels, scene.width, scratch.plane, g, mirrored)
        shading.cover(s, n, k, rec, g, veil, further)
        give_base(s, n, jobs, color, room, at)


@part
def shade_sky_jobs(s, k, texels, width, jobs, color, pixels, first, total):
    """Colors of `total` jobs of the sky, listed from `first` on."""
    room = room_for(pixels)
    for at in range(first, first + total, L.CHUNK):
        n = min(L.CHUNK, first + total - at)
        shading.aim(s, n, jobs, room, at, pixels, k[L.STEP])
        shading.shade_sky(s, n, k, texels, width)
        give_base(s, n, jobs, color, room, at)


@part
def keep_sky(s, k, texels, width, jobs, color, pixels, geoms):
    """Fill the last part of `color` with the sky in every pixel."""
    room, total = room_for(pixels), pixels * pixels
    at = lists_at(room, geoms, 0, 0)
    for first in range(0, total, L.CHUNK):
        n = min(L.CHUNK, total - first)
        for i in range(n):
            jobs[i], jobs[room + i], jobs[at + i] = (first + i) // pixels, (first + i) % pixels, i
        shade_sky_jobs(s, k, texels, width, jobs, color, pixels, at, n)
        for c in range(3):
            for i in range(n):
                put(color, 3 * room + c * total + first + i, get(color, c * room + i))


@part
def take_sky(jobs, color, room, pixels, first, total):
    """Do as `shade_sky_jobs`, with the colors that `keep_sky` has stored."""
    for i in range(first, first + total):
        job = get(jobs, i)
        pixel = 3 * room + get(jobs, job) * pixels + get(jobs, room + job)
        for c in range(3):
            put(color, c * room + job, get(color, c * pixels * pixels + pixel))


@stage
def shade_jobs(scene, scratch, pixels, veiled, known, further):
    """Colors of all listed jobs: mirror images, what is in front, what that is seen through.

    Args:
      known: the sky is kept.
      further: add the light of another lamp to the colors that they have.
    """
    s, k, rec, jobs, color = scratch.s, scratch.k, scratch.rec, scratch.jobs, scratch.color
    geoms, room = rec.shape[0], room_for(pixels)
    for layer in range(3):
        if (layer == 0 and veiled) or (layer == 2 and not veiled):
            continue
        which = 0 if layer == 1 else 1
        for g in range(geoms):
            if get(jobs, length_at(room, geoms, which, g)) > 0:
                rest = (1.0 - rec[g, L.OPACITY]) * (1.0 - rec[g, L.OPACITY])  # what is transparent is drawn twice
                veil = 1.0 - rest if layer == 2 else 1.0
                shade_geom(scene, scratch, pixels, which, g, layer == 0, veil, further)
        if further or layer != 1:
            continue
        first, total = lists_at(room, geoms, 0, geoms), np.int64(get(jobs, length_at(room, geoms, 0, geoms)))
        if known:
            take_sky(jobs, color, room, pixels, first, total)
        else:
            shade_sky_jobs(s, k, scene.texels, scene.width, jobs, color, pixels, first, total)


# -- pictures --------------------------------------------------------------------------------------


@part
def clip(k, c0, c1, r0, r1):
    """Paint this part of the picture only."""
    k[L.CLIP], k[L.CLIP + 1], k[L.CLIP + 2], k[L.CLIP + 3] = c0, c1, r0, r1


@part
def clip_to_some(k, rec, pixels, goal):
    """Paint only where the goal's geoms are (`goal` 1), or all others that move (0); gives whether they can be seen."""
    clip(k, i8(0), pixels, i8(0), pixels)
    left, right, top, bottom = pixels, 0, pixels, 0
    for g in range(rec.shape[0]):
        if rec[g, L.KIND] != PLANE and rec[g, L.GOAL] == goal and (goal or rec[g, L.MOVING] > 0.0):
            c0, c1, r0, r1 = visibility.box_of_body(k, rec, g, i8(L.PLACE), i8(L.AXIS), pixels)
            if c0 < c1 and r0 < r1:
                left, right, top, bottom = min(left, c0), max(right, c1), min(top, r0), max(bottom, r1)
    if goal and (k[L.CONE] > 0.0 or k[L.MIRROR] >= 0.0):
        return True  # its shadow and mirror image may be anywhere
    clip(k, left, right, top, bottom)
    return left < right


@stage
def paint(scene, frames, scratch, f, which, inside, known, out):
    """Paint the CLIP of frame f into a picture (row, column, 3)."""
    k, rec = scratch.k, scratch.rec
    pixels, bottom = scene.rays.size // 9, int(k[L.CLIP + 3])
    veiled, room = veils(rec, inside), room_for(pixels)
    draw(scratch, scene.rays, which, veiled)
    for row in range(int(k[L.CLIP + 2]), bottom, room // (4 * pixels)):
        past_row = min(row + room // (4 * pixels), bottom)
        number, behind_number, jobs, color = scratch.number, scratch.behind_number, scratch.jobs, scratch.color
        count = list_jobs(number, behind_number, jobs, color, k, pixels, rec.shape[0], row, past_row)
        for at in range(len(scene.lamps)):
            if len(scene.lamps) > 1:
                light_frame(scene, frames, scratch, f, at)
                if k[L.MIRROR] >= 0.0:
                    reflect(k, rec)
            shade_jobs(scene, scratch, pixels, veiled, known, at > 0)
        write_pixels(jobs, color, room, count, out)


@part
def same(array, f):
    """Return True if array[f] is equal to array[f - 1]."""
    return np.array_equal(array[f], array[f - 1])


@part
def same_sky(axes, sky, f):
    """Return True if frame f shows the same sky as the frame before it."""
    return 0 < f < sky.size and sky[f] == sky[f - 1] and same(axes, f)


@part
def light_frame(scene, frames, scratch, f, which):
    """Make a lamp's light on the lit plane and its shadow map ready."""
    k, rec = scratch.k, scratch.rec
    choose_lamp(k, scene.constants, scene.lamps, frames.lamp, frames.eye, frames.axes, f, which)
    k[L.WINDOW : L.WINDOW + 4] = 0.0
    if k[L.CONE] <= 0.0:
        return
    lighting.aim_shadows(k, rec)
    for g in range(rec.shape[0]):
        if rec[g, L.GRIDDED] > 0.0:
            lighting.light_vertices(scratch.s, k, rec, scratch.plane, g, len(scene.lamps) > 1, which)


@stage
def pose(scene, frames, scratch, f, pixels):
    """Transform everything of frame f into the camera's frame."""
    k, eye, axes = scratch.k, frames.eye, frames.axes
    pose_geoms(scratch.rec, scene.looks, frames.center, frames.turn, eye, axes, frames.rgb, frames.look[f], f)
    k[L.VIEW : L.VIEW + 9] = axes[f].ravel()
    k[L.EYE], k[L.EYE + 1], k[L.EYE + 2], k[L.SKY] = 0.0, 0.0, -1.0, frames.sky[f]
    clip(k, i8(0), pixels, i8(0), pixels)


@part
def looks_as_before(frames, f):
    """Return True if all that does not move looks in frame f as in the frame before it."""
    same_look = same_sky(frames.axes, frames.sky, f) and frames.look[f] == frames.look[f - 1]
    return same_look and same(frames.eye, f) and same(frames.rgb, f)


@entry
def paint_frames(scene, frames, scratch, stays, shown, hidden):
    """Paint frames into `shown`, and without the goal into `hidden`, each (frame, pixels, pixels, 3) uint8, or of no
    frames if it is not wanted.

    Args:
      stays: no plane, shadow or mirror image ever moves.
    """
    k, rec, kept, axes, sky = scratch.k, scratch.rec, scratch.kept, frames.axes, frames.sky
    k[: scene.constants.size] = scene.constants
    pixels, has_kept, known = scene.rays.size // 9, False, False
    all_, both = ALL if len(shown) else NO_GOAL, len(shown) > 0 and len(hidden) > 0
    for f in range(frames.look.size):
        out = shown[f] if len(shown) else hidden[f]
        pose(scene, frames, scratch, f, pixels)
        face_planes(rec)
        light_frame(scene, frames, scratch, f, i8(0))
        known = known and same_sky(axes, sky, f)
        if not known and same_sky(axes, sky, f + 1):
            jobs, color = scratch.jobs, scratch.color
            keep_sky(scratch.s, k, scene.texels, scene.width, jobs, color, pixels, rec.shape[0])
            known = True
        still = stays and looks_as_before(frames, f)
        has_kept = has_kept and still
        # What does not move, once; what moves; the goal; the goal's place without it.
        for step in range(4):
            picture, which = out, all_
            if step == 0 and still:
                if has_kept:
                    continue
                picture, which, has_kept = kept, NOTHING_MOVING, True
            elif step == 1 and still:
                out[:] = kept
                if not clip_to_some(k, rec, pixels, i8(0)):
                    continue
            elif step == 2 and still and all_ == ALL:
                if not clip_to_some(k, rec, pixels, i8(1)):
                    continue
            elif step == 3 and both:
                picture, which = hidden[f], NO_GOAL
                picture[:] = out
                if not clip_to_some(k, rec, pixels, i8(1)):
                    continue
            elif step > 0:
                continue
            paint(scene, frames, scratch, f, which, frames.inside[f], known, picture)


@entry
def label_frames(scene, frames, scratch, depth, geom):
    """Depth (0: sky) and geom (-1: sky) of frames, from each pixel's first sample. Planes hide what is behind them,
    but for those that are not painted."""
    k, rec, inverse, number = scratch.k, scratch.rec, scratch.inverse, scratch.number
    k[: scene.constants.size] = scene.constants
    pixels = scene.rays.size // 9
    for f in range(frames.look.size):
        pose(scene, frames, scratch, f, pixels)
        for g in range(rec.shape[0]):
            rec[g, L.OWN_OPACITY] = 1.0 / BACK_OF_PLANE if rec[g, L.OWN_OPACITY] > 0.0 else 0.0
        face_planes(rec)
        clear(inverse, number, k, pixels)
        draw_bodies(inverse, number, scene.rays, k, rec, i8(ALL), i8(L.PLACE), i8(L.AXIS))
        draw_planes(inverse, number, scene.rays, k, rec, True)
        firsts = number[::4].copy().reshape(pixels, pixels)
        depth[f] = np.where(firsts == NOTHING, f4(0), f4(1) / inverse[::4].copy().reshape(pixels, pixels))
        geom[f] = np.where(firsts == NOTHING, -1, firsts)
