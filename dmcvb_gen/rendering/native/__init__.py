"""The package's own renderer: a ray tracer in numba for dm_control's scenes.

It follows MuJoCo's OpenGL pipeline term by term, as a CPU runs it: four visibility samples a pixel, one shading
a pixel and surface, light computed at the floor's vertices, textures from the same mip levels.

A map for new developers. One frame goes through these kernels (`frame.paint_frames`):

    pose_geoms, choose_lamp    records of geoms and lamps, in the camera's frame          frame.py, layout.py
    light_frame                the lamp's light at the floor's vertices, its shadow map   lighting.py
    draw                       the nearest geom of each of four samples a pixel:          visibility.py
                               draw_sphere, draw_capsule, draw_solid (cylinder, box,
                               ellipsoid), draw_plane; mirror images and what is seen
                               through a plane go to a second buffer
    list_jobs                  a job is a surface in a pixel, with its number of samples  frame.py
    shade_jobs                 colors of all jobs, geom by geom, once for each lamp:      shading.py
                               meet_body, meet_solid, meet_plane (points and normals),
                               head_light, lamp_light, cast_shadow, cast_solid_shadow,    lighting.py
                               sample, shade_sky                                         sampling.py
    write_pixels               jobs weighed by their samples                              frame.py

Around them:

    scene.py       a task's model -> geoms, sites and tendons that can be seen, lamps, materials by look
    textures.py    pictures and a video's frames -> mip levels in one buffer
    layout.py      where every number lies, how loops reach it, what is compiled once a machine (about a minute)
    renderer.py    the `Renderer`: batches, caches, hidden goals

A new kind of convex geom needs `visibility.through_solid` (where a ray enters and leaves it), a radius in
`scene._ball_radius`, and its number in `scene`. Meshes, skins, height fields and transparent bodies are missing.
"""

from dmcvb_gen.rendering.native.renderer import NativeRenderer

RENDERER = NativeRenderer

__all__ = ["RENDERER", "NativeRenderer"]
