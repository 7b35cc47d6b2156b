"""Where every number lies in the few arrays that compiled code works on, and how loops reach it.

A function compiled by numba pays for each array that it is handed, so all numbers of a geom are one row of `rec`
(geom, WIDTH) float64, and all that belong to a frame as a whole are `k` (LENGTH,) float64. Positions and directions
in them are in the camera's frame: x right, y up, looking along -z, the eye at the origin, meters.

What is computed for up to CHUNK places of a picture lies in `s` (ROWS * CHUNK,) float32, a row a quantity, and the
painter's loops run over the places of a row, written so that the compiler turns them into vector code. numba's own
indexing wraps around and says nothing about arrays that overlap, and either keeps LLVM from making vector code; `get`,
`put` and `distinct` do not. Every operation stands alone (no reassociation, no contraction), so that a place's bits
depend neither on the processor nor on its neighbors. What `entry` compiles is kept on disk.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from dmcvb_gen.kept import kept_njit

CHUNK = 128
"""Places computed together, at most."""

_PLAIN = {"nogil": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Nothing of what Python would need to call a part: making that takes a fifth of the time."""
part = njit(**_PLAIN)
"""For the parts of the entry points."""
leaf = njit(forceinline=True, **_PLAIN)
"""For small parts: numba hands an array over as seven numbers or more, so a call can cost more than its work."""
stage = njit(inline="always", **_PLAIN)
"""For parts that are called once and call others: LLVM works over a part again for each part around it."""
_SOURCE = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
entry = kept_njit(version=hashlib.sha256(_SOURCE).hexdigest(), nogil=True, error_model="numpy")
"""For the entry points, which are kept on disk as long as this package's source stays the same."""


@intrinsic
def get(typing, array, index):
    """array[index] of a flat array, unchecked."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.load(builder.gep(data, [arguments[1]], inbounds=True))

    return array.dtype(array, types.int64), generate


@intrinsic
def put(typing, array, index, value):
    """array[index] = value, unchecked."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        builder.store(arguments[2], builder.gep(data, [arguments[1]], inbounds=True))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), generate


@leaf
def get3(array, index):
    """The numbers at a place of three rows, one after another."""
    return get(array, index), get(array, index + CHUNK), get(array, index + 2 * CHUNK)


@leaf
def put3(array, index, x, y, z):
    """Set the numbers at a place of three rows, one after another."""
    put(array, index, x)
    put(array, index + CHUNK, y)
    put(array, index + 2 * CHUNK, z)


@intrinsic
def distinct(typing):
    """Promise, at the top of a function, that none of its arguments share memory; it stays a function of its own."""

    def generate(context, builder, signature, arguments):
        for argument in builder.function.args:
            if isinstance(argument.type, ir.PointerType) and argument.name.startswith("arg."):
                argument.add_attribute("noalias")
        builder.function.attributes.add("noinline")  # LLVM forgets the promise where it copies a function
        return context.get_dummy_value()

    return types.void(), generate


# -- compiled code ---------------------------------------------------------------------------------
# -- columns of `rec`: what a look says of a geom
KIND = 0  # of `scene`: PLANE, SPHERE, CAPSULE, ...
SIZE = 1  # 3: half lengths, a solid's along its axes, others' as MuJoCo's
GOAL = 4  # 1 for the goal's geoms
MOVING = 5  # 1 for geoms that can move
BOXED = 6  # 1 for a plane on a box's side, seen from behind only from inside the box
MATERIAL = 7  # -1: RGB stays
OPACITY = 8
TEXTURE = 9  # -1: none
REPEAT = 10  # 2: texture coordinates for each meter
SHARE = 12  # of specular light
EXPONENT = 13  # of specular light, whole
OWN_OPACITY = 14  # before it is changed by the side that is seen
BALL = 15  # radius of the ball around a body, less half of a capsule's length
GRIDDED = 16  # 1 for the plane that the lamps light at the vertices of a grid; they light all else in every pixel
CORD = 17  # 1 for a tendon's piece: its third axis is as long as half of it in every frame
# what a frame says of it
RGB = 18  # 3
PLACE = 21  # 3: center
TURN = 24  # 9: axes are its columns
AXIS = 33  # 3: its third axis
MIRRORED_PLACE = 36  # 3
MIRRORED_AXIS = 39  # 3
FUNCTIONS = 42  # 9, of a plane: see visibility.draw_plane
BOUNDS = 51  # 4, of a body: least and greatest slopes of its outline in the shadow map
MIRRORED_TURN = 55  # 9
WIDTH = 64

# -- entries of `k`: what a camera, a scene says
STEP = 0  # of a ray's x and y from pixel to pixel
NEAR = 1
FAR = 2
MIRROR = 3  # geom, -1: none
REFLECTANCE = 4
HEADLIGHT = 5  # 9: ambient, diffuse, specular RGB
SPOT = 14  # 9: of the lamp at work
CONE = 23  # 3: cosine of the cut-off angle (0: no lamp), exponent, tangent of the shadow map's half angle
LINES = 26  # 2: vertices of the lit plane along its axes
GRID = 28  # lines in each row of the lit plane's grid
HORIZON = 29
# what a frame says
EYE = 30  # 3: direction of the headlight's light
LAMP = 33  # 6: position, direction
MIRRORED = 39  # 9: EYE and LAMP mirrored
SHADOW = 48  # 9: right, up and forward directions of the shadow map
WINDOW = 57  # 4: the vertices (first, past the last; two axes) that the lamp's cone reaches
VIEW = 61  # 9: the camera's axes in the world, columns right, up, back
SKY = 70  # texture of the sky, -1: none
CLIP = 71  # 4: first and past the last column, first and past the last row that are painted
OWN = 75  # 3: color of the geom at work
LENGTH = 78

# -- columns of the table of textures (texture, ...)
LEVELS = 0
FACES = 1
FIRST = 2  # then start, width and height of each level
"""A texture's row is LEVELS, FACES, and three numbers a level from FIRST on."""

# -- rows of `s`; what has three numbers lies in three rows, one after another ----------------------
X = 0 * CHUNK  # ray through the pixel's center
Y = 1 * CHUNK
QUAD_X = 2 * CHUNK  # ray of the first of the two by two pixels that share a texture footprint
QUAD_Y = 3 * CHUNK
RAY_X = 4 * CHUNK  # ray that `shading.meet_body` follows
RAY_Y = 5 * CHUNK
POINT = 6 * CHUNK  # 3
NORMAL = 9 * CHUNK  # 3: of unit length
U = 12 * CHUNK  # place on a plane, over its half lengths
V = 13 * CHUNK
S = 14 * CHUNK  # texture coordinates
T = 15 * CHUNK
FOOTPRINT = 16 * CHUNK  # squared, texels
LEVEL = 17 * CHUNK  # the finer mip level
MIX = 18 * CHUNK  # share of the next one, in 1/256
FACE = 19 * CHUNK  # of a cube map
TEXEL = 20 * CHUNK  # 3: color of the texture
DIRECTION = 23 * CHUNK  # 3: into a cube map, and what it changes by to the right and upwards
RIGHT = 26 * CHUNK  # 3
UP = 29 * CHUNK  # 3
HEADLIGHT_DIFFUSE = 32 * CHUNK  # N.L, then the specular factor
HEADLIGHT_SPECULAR = 33 * CHUNK
CONE_FACTOR = 34 * CHUNK  # lamp: factor of the cone, N.L, specular factor
LAMP_DIFFUSE = 35 * CHUNK
LAMP_SPECULAR = 36 * CHUNK
LAMP_COLOR = 37 * CHUNK  # 3: the lamp's light on the geom
WAY = 40 * CHUNK  # 3: from the lamp to the point
LIGHT = 43 * CHUNK  # 1 where the lamp is seen, else 0
BASE = 44 * CHUNK  # 3: what is mirrored, or seen through; then the color
RAISED = 47 * CHUNK  # a power in the making
ROWS = 48
