"""Access to rows of up to CHUNK numbers, written so that the compiler turns the painter's loops into vector code.

What is computed for many places of a picture lies in `s` (ROWS * CHUNK,) float32, a row a quantity, and the loops run
over the places of a row. numba's own indexing wraps around and says nothing about arrays that overlap, and either
keeps LLVM from making vector code; `get`, `look`, `put` and `distinct` do not. Every operation stands alone (no
reassociation, no contraction), so that a place's bits depend neither on the processor nor on its neighbors.
"""

from __future__ import annotations

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

CHUNK = 128
"""Places computed together, at most."""

_PLAIN = {"nogil": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Nothing of what Python would need to call a part: making that takes a fifth of the time."""
part = njit(**_PLAIN)
"""For the parts of the entry points in `frame`, which alone are kept on disk."""
leaf = njit(forceinline=True, **_PLAIN)
"""For small parts: numba hands an array over as seven numbers or more, so a call can cost more than its work."""
stage = njit(inline="always", **_PLAIN)
"""For parts that are called once and call others: LLVM works over a part again for each part around it."""


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


# -- rows of `s` -----------------------------------------------------------------------------------
X = 0 * CHUNK  # ray through the pixel's center
Y = 1 * CHUNK
QUAD_X = 2 * CHUNK  # ray of the first of the two by two pixels that share a texture footprint
QUAD_Y = 3 * CHUNK
RAY_X = 4 * CHUNK  # ray that `shading.meet_body` follows
RAY_Y = 5 * CHUNK
PX = 6 * CHUNK  # point
PY = 7 * CHUNK
PZ = 8 * CHUNK
NX = 9 * CHUNK  # unit normal
NY = 10 * CHUNK
NZ = 11 * CHUNK
U = 12 * CHUNK  # place on a plane, over its half lengths
V = 13 * CHUNK
S = 14 * CHUNK  # texture coordinates
T = 15 * CHUNK
FOOTPRINT = 16 * CHUNK  # squared, texels
LEVEL = 17 * CHUNK  # the finer mip level
MIX = 18 * CHUNK  # share of the next one, in 1/256
FACE = 19 * CHUNK  # of a cube map
RED = 20 * CHUNK  # of the texture
GREEN = 21 * CHUNK
BLUE = 22 * CHUNK
DX = 23 * CHUNK  # direction into a cube map, and what it changes by to the right and upwards
DY = 24 * CHUNK
DZ = 25 * CHUNK
RIGHT_X = 26 * CHUNK
RIGHT_Y = 27 * CHUNK
RIGHT_Z = 28 * CHUNK
UP_X = 29 * CHUNK
UP_Y = 30 * CHUNK
UP_Z = 31 * CHUNK
HEAD = 32 * CHUNK  # headlight: N.L, specular
HEAD_SHINE = 33 * CHUNK
CONE_FACTOR = 34 * CHUNK  # lamp: factor of the cone, N.L, specular
LAMP_DIFFUSE = 35 * CHUNK
LAMP_SHINE = 36 * CHUNK
LAMP_RED = 37 * CHUNK  # lamp's color on the lit plane
LAMP_GREEN = 38 * CHUNK
LAMP_BLUE = 39 * CHUNK
WAY_X = 40 * CHUNK  # from the lamp to the point
WAY_Y = 41 * CHUNK
WAY_Z = 42 * CHUNK
LIGHT = 43 * CHUNK  # 1 where the lamp is seen, else 0
BASE_RED = 44 * CHUNK  # what is mirrored, or seen through; then the color
BASE_GREEN = 45 * CHUNK
BASE_BLUE = 46 * CHUNK
RAISED = 47 * CHUNK  # a power in the making
ROWS = 48
