"""Rendering: `make_renderer("native", task, 64)` gives a renderer; physics states and labels become pictures.

A renderer is a module or package in this folder with a subclass of `Renderer` as `RENDERER`; its file name is the
renderer's name.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.tasks.base import Task

RENDERERS = ("native", "opengl")


def renderer_class(name: str) -> type[Renderer]:
    """The class of a renderer, imported when it is first asked for.

    Raises:
      UnknownNameError: no renderer has that name.
    """
    if name not in RENDERERS:
        raise UnknownNameError("renderer", name, RENDERERS)
    return importlib.import_module(f"{__name__}.{name}").RENDERER


def make_renderer(
    name: str,
    task: Task,
    size: int,
    *,
    backgrounds=None,
    floor_alpha: float = 1.0,
    samples: int | None = None,
) -> Renderer:
    """A renderer by its name.

    Args:
      size: pixels a side.
      backgrounds: the videos that labels may name (`load_backgrounds`).
      floor_alpha: opacity of the ground plane (`distractors.floor_alpha_for`).
      samples: samples a pixel; None: the default.

    Raises:
      UnknownNameError, RenderingError: no such renderer, or it cannot start here.
    """
    chosen: Callable[..., Renderer] = renderer_class(name)
    return chosen(task, size, backgrounds=backgrounds, floor_alpha=floor_alpha, samples=samples)


def available_renderers() -> dict[str, str | None]:
    """Renderer -> None if it can start here, else why not and what to do."""
    # The native one needs nothing but the package, and half a second to load.
    return {name: None if name == "native" else renderer_class(name).unavailable() for name in RENDERERS}


__all__ = [
    "RENDERERS",
    "Renderer",
    "available_renderers",
    "make_renderer",
    "renderer_class",
]
