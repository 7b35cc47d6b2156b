"""Compile functions with numba and keep their code on disk, where that works: a cache that fails stops nothing."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from typing import Any

from numba import njit

_log = logging.getLogger(__name__)


def kept_njit(version: str = "", **options: Any) -> Callable[[Callable], Any]:
    """numba's `njit(cache=True, ...)`, which goes on without the cache if it cannot be read or written.

    Args:
      version: code that was kept under another one is not read; numba itself looks at the date of one file alone.
    """

    def decorate(function: Callable) -> Any:
        compiled = njit(**options)(function)
        try:
            compiled.enable_caching()
        except RuntimeError:  # numba finds no folder that it may write to
            _log.info("%s is compiled in every process: numba has no folder to keep it in", function.__name__)
            return compiled
        cache = compiled._cache
        key_of = cache._index_key
        cache._index_key = lambda signature, codegen: (*key_of(signature, codegen), version)
        cache.load_overload = _forgiving(cache, cache.load_overload)
        cache.save_overload = _forgiving(cache, cache.save_overload)
        return compiled

    return decorate


def _forgiving(cache: Any, work: Callable) -> Callable:
    """Wrap a function of a cache: it returns None if the disk fails, and empties the cache if a file is damaged."""

    def attempt(*arguments: Any) -> Any:
        try:
            return work(*arguments)
        except Exception as error:  # a damaged file is of pickle's kinds, or any
            _log.info("compiled code is not kept: %s", error)
            if not isinstance(error, OSError):
                with contextlib.suppress(OSError):
                    cache.flush()
            return None

    return attempt
