"""Where every number lies in the few arrays that compiled code works on.

A function compiled by numba pays for each array that it is handed, so all numbers of a geom are one row of `rec`
(geom, WIDTH) float64, and all that belong to a frame as a whole are `k` (LENGTH,) float64. Positions and directions
in them are in the camera's frame: x right, y up, looking along -z, the eye at the origin, meters.
"""

from __future__ import annotations

# -- columns of `rec`: what a look says of a geom
KIND = 0  # PLANE, SPHERE or CAPSULE
SIZE = 1  # 3: half lengths, as MuJoCo's
GOAL = 4  # 1 for the goal's geoms
BOXED = 5  # 1 for a plane on a box's side, seen from behind only from inside the box
MATERIAL = 6  # -1: RGB stays
OPACITY = 7
TEXTURE = 8  # -1: none
REPEAT = 9  # 2: texture coordinates for each meter
SHARE = 11  # of specular light
EXPONENT = 12  # of specular light, whole
OWN_OPACITY = 13  # before it is changed by the side that is seen
# what a frame says of it
RGB = 14  # 3
PLACE = 17  # 3: center
TURN = 20  # 9: axes are its columns
AXIS = 29  # 3: its third axis
MIRRORED_PLACE = 32  # 3
MIRRORED_AXIS = 35  # 3
FUNCTIONS = 38  # 9, of a plane: see visibility.draw_plane
BOUNDS = 47  # 4, of a body: least and greatest slopes of its outline in the shadow map
WIDTH = 51

# -- entries of `k`: what a camera, a scene says
STEP = 0  # of a ray's x and y from pixel to pixel
NEAR = 1
FAR = 2
MIRROR = 3  # geom, -1: none
REFLECTANCE = 4
HEADLIGHT = 5  # 9: ambient, diffuse, specular RGB
SPOT = 14  # 9: the lamp's
CONE = 23  # 3: cosine of the cut-off angle (0: no lamp), exponent, tangent of the shadow map's half angle
LINES = 26  # 2: vertices of the lit plane along its axes
HORIZON = 28
# what a frame says
EYE = 29  # 3: direction of the headlight's light
LAMP = 32  # 6: position, direction
MIRRORED = 38  # 9: EYE and LAMP mirrored
SHADOW = 47  # 9: right, up and forward directions of the shadow map
WINDOW = 56  # 4: the vertices (first, past the last; two axes) that the lamp's cone reaches
VIEW = 60  # 9: the camera's axes in the world, columns right, up, back
SKY = 69  # texture of the sky, -1: none
QUAD = 70  # 3: number, geom and squared footprint of the two by two pixels shaded last
LENGTH = 73

# -- columns of the table of textures (texture, ...), int64
LEVELS = 0
FACES = 1
FIRST = 2  # then start, width and height of each level
"""A texture's row is LEVELS, FACES, and three numbers a level from FIRST on."""
