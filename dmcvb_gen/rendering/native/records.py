"""Columns of every number in the few arrays that compiled code works on.

A function compiled by numba pays for each array that it is handed, so all numbers of a geom are one row of `rec`
(geom, WIDTH) float64, and all that belong to a frame as a whole are `k` (LENGTH,) float64. Positions and directions
in them are in the camera's frame: x right, y up, looking along -z, the eye at the origin, meters.
"""

from __future__ import annotations

# -- columns of `rec`: what a look says of a geom
KIND = 0  # of `scene`: PLANE, SPHERE, CAPSULE, ...
SIZE = 1  # 3: half lengths, as MuJoCo's
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
LENGTH = 75

# -- columns of the table of textures (texture, ...)
LEVELS = 0
FACES = 1
FIRST = 2  # then start, width and height of each level
"""A texture's row is LEVELS, FACES, and three numbers a level from FIRST on."""
