"""Rendering: `make_renderer("native", task, 64)` gives a renderer; physics states and labels become pictures."""

from __future__ import annotations

from collections.abc import Callable

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.extras import installed
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.tasks.base import Task

RENDERERS = ("native", "warp", "opengl")


def make_renderer(
    name: str,
    task: Task,
    size: int,
    *,
    backgrounds=None,
    floor_alpha: float = 1.0,
    device: str = "cpu",
    samples: int | None = None,
) -> Renderer:
    """A renderer by its name.

    Args:
      size: pixels a side.
      backgrounds: the videos that labels may name (`load_backgrounds`).
      floor_alpha: opacity of the ground plane (`distractors.floor_alpha_for`).
      device: "cpu" or "cuda" (warp).
      samples: samples a pixel; None: the default.

    Raises:
      UnknownNameError, RenderingError: no such renderer, or it cannot start here.
    """
    chosen: Callable[..., Renderer]
    if name == "native":
        from dmcvb_gen.rendering.native import NativeRenderer

        chosen = NativeRenderer
    elif name == "warp":
        from dmcvb_gen.rendering.warp import WarpRenderer

        chosen = WarpRenderer
    elif name == "opengl":
        from dmcvb_gen.rendering.opengl import OpenglRenderer

        chosen = OpenglRenderer
    else:
        raise UnknownNameError("renderer", name, RENDERERS)
    return chosen(task, size, backgrounds=backgrounds, floor_alpha=floor_alpha, device=device, samples=samples)


def available_renderers() -> dict[str, str | None]:
    """Renderer -> None if it can start here, else why not and what to do."""
    from dmcvb_gen.rendering import opengl

    warp = None if installed("mujoco_warp") else "mujoco-warp is not installed: pip install mujoco-warp==3.17.0"
    return {"native": None, "warp": warp, "opengl": opengl.unavailable()}


__all__ = [
    "RENDERERS",
    "Renderer",
    "available_renderers",
    "make_renderer",
]
