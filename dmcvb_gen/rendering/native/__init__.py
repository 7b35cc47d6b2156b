"""The painter of our own: a tracer in numba for exactly our scenes; physics states and labels in, pictures out.

It follows MuJoCo's OpenGL pipeline term by term, as a CPU runs it: four visibility samples a pixel, one shading
a pixel and surface, light computed at the floor's vertices, textures from the same mip levels.

    lanes.py       how loops touch memory so that they become vector code
    scene.py       a task's model -> arrays of what can be seen, lights, materials by look
    textures.py    pictures -> mip levels in one buffer
    skies.py       a video's frames -> mip levels of skies
    sampling.py    texture coordinates -> colors
    visibility.py  geoms in the camera's frame -> the nearest of each sample
    lighting.py    points and normals -> light, shadows
    frame.py       one frame from its poses
    compiled.py    entry points, compiled once a machine
    renderer.py    the `Renderer`: batches, caches, hidden goals
"""

from dmcvb_gen.rendering.native.renderer import NativeRenderer

__all__ = ["NativeRenderer"]
