"""torch.compile, if it can work here. Otherwise functions run uncompiled, and one line says so."""

from __future__ import annotations

import functools
import logging
import os
import shutil
import sys
from collections.abc import Callable
from typing import Any

import torch

log = logging.getLogger("dmcvb_gen")


def compiler() -> str | None:
    """Path of the C++ compiler that torch.compile would call on this processor; None if there is none."""
    return shutil.which(os.environ.get("CXX") or ("clang++" if sys.platform == "darwin" else "g++"))


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is compiled at its first call; it runs uncompiled if compiling fails."""
    if compiler() is None:
        _tell("there is no C++ compiler")
        return function
    attempt, usable = torch.compile(function), True

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        nonlocal usable
        if usable:
            try:
                return attempt(*arguments)
            except Exception as error:  # torch has many kinds: no headers, no space, an unsupported operation
                if not type(error).__module__.startswith(("torch._inductor", "torch._dynamo")):
                    raise
                usable = False
                _tell(f"compiling failed: {str(error).strip().splitlines()[0]}")
        return function(*arguments)

    return call


@functools.cache
def _tell(reason: str) -> None:
    log.warning("Training runs without torch.compile, which is slower: %s.", reason)
