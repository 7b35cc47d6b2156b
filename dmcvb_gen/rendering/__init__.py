"""Rendering: `renderer_class("native")(task, 64)` is a renderer; physics states and labels become pictures.

A renderer is a module or package in this folder with a subclass of `Renderer` as `RENDERER`; its file name is the
renderer's name.
"""

from __future__ import annotations

import importlib

from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.rendering.base import Renderer

RENDERERS = ("native", "opengl")


def renderer_class(name: str) -> type[Renderer]:
    """The class of a renderer, imported when it is first asked for.

    Raises:
      UnknownNameError: no renderer has that name.
    """
    if name not in RENDERERS:
        raise UnknownNameError("renderer", name, RENDERERS)
    return importlib.import_module(f"{__name__}.{name}").RENDERER


def available_renderers() -> dict[str, str | None]:
    """Renderer -> None if it can start here, else why not and what to do."""
    # The native one needs nothing but the package, and half a second to load.
    return {name: None if name == "native" else renderer_class(name).unavailable() for name in RENDERERS}


__all__ = ["RENDERERS", "Renderer", "available_renderers", "renderer_class"]
