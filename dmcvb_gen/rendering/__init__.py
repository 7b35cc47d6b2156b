"""Rendering: `make_renderer("native", task, 64)` gives a renderer; physics states and labels become pictures.

A renderer is a module or package beside this file with a subclass of `Renderer` as `RENDERER`; its file name is the
renderer's name. Other packages add theirs under the entry point group `dmcvb_gen.renderers` (name = class).
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable
from importlib import metadata

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.tasks.base import Task

ENTRY_POINTS = "dmcvb_gen.renderers"


def _loader(module: str) -> Callable[[], type[Renderer]]:
    return lambda: importlib.import_module(f"{__name__}.{module}").RENDERER


@functools.cache
def _table() -> dict[str, Callable[[], type[Renderer]]]:
    """Renderer -> what gives its class; nothing is imported before it is asked for."""
    own = {
        found.name: _loader(found.name)
        for found in pkgutil.iter_modules(__path__)
        if found.name not in ("base", "choice")
    }
    return {point.name: point.load for point in metadata.entry_points(group=ENTRY_POINTS)} | own


RENDERERS = tuple(_table())


def renderer_class(name: str) -> type[Renderer]:
    """The class of a renderer.

    Raises:
      UnknownNameError: no renderer has that name.
    """
    if name not in _table():
        raise UnknownNameError("renderer", name, RENDERERS)
    return _table()[name]()


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
