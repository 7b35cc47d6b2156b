"""Call compiled entry points. Their code is kept on disk and compiled once on each machine."""

from __future__ import annotations

import functools
import hashlib
import logging
import time
from collections.abc import Callable
from pathlib import Path

_log = logging.getLogger(__name__)


@functools.cache
def _entry(factory: Callable):
    """Return `factory(version)`; the version is the digest of all of this package's source."""
    source = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    return factory(int.from_bytes(hashlib.sha256(source).digest()[:6], "little") | 1)


def call(factory: Callable, *arguments) -> None:
    """Call an entry point; say so if it is compiled first."""
    entry = _entry(factory)
    if entry.signatures:
        entry(*arguments)
        return
    started = time.perf_counter()
    entry(*arguments)
    seconds = time.perf_counter() - started
    if sum(entry.stats.cache_misses.values()):
        _log.info("compiled the painter in %.0f s; later runs read it from %s", seconds, entry.stats.cache_path)
