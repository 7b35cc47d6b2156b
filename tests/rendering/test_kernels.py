"""Native's hardest kernels against MuJoCo's own rays and against a few lines of numpy."""

import mujoco
import numpy as np
import pytest
from numba import njit
from scipy import ndimage

from dmcvb_gen.rendering.native import layout as L
from dmcvb_gen.rendering.native.lighting import aim_shadows, cast_shadows, lamp_on_plane
from dmcvb_gen.rendering.native.sampling import sample
from dmcvb_gen.rendering.native.textures import Textures, levels

SOLIDS = """<mujoco><worldbody><geom type="sphere" size=".3" pos="-.9 .5 0"/>
<geom type="capsule" size=".15 .3" pos="-.3 .5 0" euler="30 50 0"/><geom type="box" size=".2 .1 .3" pos=".4 .5 .1"
euler="20 40 60"/><geom type="cylinder" size=".2 .3" pos="-.7 -.4 0" euler="70 10 0"/>
<geom type="ellipsoid" size=".3 .1 .2" pos=".4 -.4 .2" euler="0 40 60"/></worldbody></mujoco>"""


@njit
def shadowed(s, n, k, rec):
    aim_shadows(k, rec)
    cast_shadows(s, n, k, rec, -1)


@njit
def sampled(s, n, texels, width):
    sample(s, n, texels, width, 0, True)


@njit
def lit(s, n, k, rec, plane):
    lamp_on_plane(s, n, k, rec, plane, 0)


def rows(s, first, count=3):
    """(count, CHUNK) rows of the scratch memory, to read and to write."""
    return s[first : first + count * L.CHUNK].reshape(count, L.CHUNK)


@pytest.mark.slow
def test_shadows_fall_where_mujocos_rays_are_blocked():
    solids = mujoco.MjModel.from_xml_string(SOLIDS)
    data = mujoco.MjData(solids)
    mujoco.mj_forward(solids, data)
    rec, k, rng = np.zeros((solids.ngeom, L.WIDTH)), np.zeros(L.LENGTH), np.random.default_rng(0)
    rec[:, L.KIND], rec[:, L.SIZE : L.SIZE + 3], rec[:, L.BALL] = solids.geom_type, solids.geom_size, 1.0
    cylinders = solids.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER
    rec[cylinders, L.SIZE + 1 : L.SIZE + 3] = solids.geom_size[cylinders, :2]  # along the axes
    rec[:, L.PLACE : L.PLACE + 3], rec[:, L.TURN : L.TURN + 9] = data.geom_xpos, data.geom_xmat
    rec[:, L.AXIS : L.AXIS + 3] = data.geom_xmat[:, 2::3]
    lamp = np.array([0.2, 0.1, 2.5])
    k[L.LAMP : L.LAMP + 6], k[L.CONE : L.CONE + 3] = [*lamp, 0, 0, -1], [0.1, 0, 1e6]
    agree, blocked = [], []
    for _ in range(20):
        s = np.zeros(L.ROWS * L.CHUNK, np.float32)
        points = rng.uniform([-1.5, -1.2, -1.0], [1.2, 1.2, -0.6], (L.CHUNK, 3))
        rows(s, L.POINT)[:], rows(s, L.LIGHT, 1)[:] = points.T, 1
        shadowed(s, L.CHUNK, k, rec)
        ways = points - lamp
        found = [mujoco.mj_ray(solids, data, lamp, way, None, 1, -1, np.zeros(1, np.int32)) for way in ways]
        blocked += [0 <= distance < 1 for distance in found]
        agree += (rows(s, L.LIGHT, 1)[0] == 0).tolist()
    assert 0.1 < np.mean(blocked) < 0.9 and np.mean(np.array(agree) == np.array(blocked)) > 0.999


@pytest.mark.slow
def test_a_texture_is_a_blend_of_texels_of_the_two_nearest_levels():
    noise = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><texture name="t" type="2d" builtin="checker" rgb1=".1 .4 .9" rgb2=".9 .6 .2" width="16" '
        'height="16" colorspace="linear" random=".3" mark="random" markrgb="1 1 1"/></asset></mujoco>'
    )
    textures = Textures(noise, None, 0)
    textures.make_ready(0)
    picture = noise.tex_data.reshape(16, 16, 3)
    rng, s = np.random.default_rng(0), np.zeros(L.ROWS * L.CHUNK, np.float32)
    (across, down), footprint = rng.uniform(-2, 2, (2, L.CHUNK)), 4.0 ** rng.uniform(0, 4, L.CHUNK)
    for row, values in ((L.S, across), (L.T, down), (L.FOOTPRINT, footprint)):
        rows(s, row, 1)[:] = values
    sampled(s, L.CHUNK, textures.texels, textures.table.shape[1])

    def blended(level):
        """(color, point) between the four nearest texels of a level, which repeats."""
        place = [down * len(level) - 0.5, across * len(level) - 0.5]
        colors = np.moveaxis(level.astype(float), -1, 0)
        return np.stack([ndimage.map_coordinates(color, place, order=1, mode="grid-wrap") for color in colors])

    pyramid = np.stack([blended(level) for level in levels(picture)])
    power = np.floor(np.log2(footprint))
    detail = 0.5 * (power + footprint / 2**power - 1) + 0.25  # linear between powers of two
    share, near = np.clip(2 * (detail % 1) - 1, 0, 1), detail.astype(int)
    near, far = (pyramid[np.minimum(level, len(pyramid) - 1), :, np.arange(L.CHUNK)].T for level in (near, near + 1))
    np.testing.assert_allclose(rows(s, L.TEXEL), (near * (1 - share) + far * share) / 255, atol=0.02)


@pytest.mark.slow
def test_light_on_the_plane_is_blended_between_the_corners_of_triangles():
    rng, count = np.random.default_rng(0), 6
    line, colors = np.linspace(-2, 2, count), rng.random((count, count, 3))
    plane = np.concatenate([line, line, colors.ravel()]).astype(np.float32)
    rec, k, s = np.zeros((1, L.WIDTH)), np.zeros(L.LENGTH), np.zeros(L.ROWS * L.CHUNK, np.float32)
    rec[0, L.SIZE : L.SIZE + 2] = 2.0
    k[L.LINES : L.LINES + 2], k[L.GRID], k[L.WINDOW : L.WINDOW + 4] = count, count, [0, count, 0, count]
    place = rng.uniform(-0.99, 0.99, (2, L.CHUNK))
    rows(s, L.U, 2)[:] = place
    lit(s, L.CHUNK, k, rec, plane)

    cells = (place * 2 + 2) / (line[1] - line[0])
    (r, c), (a, b) = np.floor(cells).astype(int), cells % 1
    near, far = colors[r, c], colors[r + 1, c + 1]
    right, up = colors[r + 1, c], colors[r, c + 1]
    lower = near.T + a * (right - near).T + b * (up - near).T
    upper = far.T + (1 - b) * (right - far).T + (1 - a) * (up - far).T
    np.testing.assert_allclose(rows(s, L.LAMP_COLOR), np.where(a + b <= 1, lower, upper), atol=1e-4)
