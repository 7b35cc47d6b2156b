"""Measure how much main memory is free."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

UNKNOWN_MEMORY = 4 * 2**30
"""Bytes to assume if the system does not tell."""
CONTAINER = Path("/sys/fs/cgroup")
"""Where Linux tells a container its limit of memory (cgroup v2)."""


def free_memory() -> int | None:
    """Bytes of main memory that this process may still use; None if the system does not tell."""
    free = [value for value in (_system(), _container()) if value is not None]
    return min(free) if free else None


def _system() -> int | None:
    with contextlib.suppress(OSError, KeyError, ValueError):
        facts = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        return int(facts["MemAvailable"].split()[0]) * 1024
    if "SC_AVPHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _container() -> int | None:
    try:
        limit, used = (int((CONTAINER / f"memory.{name}").read_text()) for name in ("max", "current"))
        cached = dict(line.split() for line in (CONTAINER / "memory.stat").read_text().splitlines())
        return max(0, limit - used + int(cached.get("inactive_file", 0)))
    except (OSError, ValueError):  # no container, or one without a limit ("max")
        return None
