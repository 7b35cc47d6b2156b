"""Measure how much main memory is free."""

from __future__ import annotations

import contextlib
from pathlib import Path

UNKNOWN_MEMORY = 4 * 2**30
"""Bytes to assume if the system does not tell."""
CONTAINER = Path("/sys/fs/cgroup")
"""Where Linux tells the limits of a container, a batch system's job or a service (cgroup v2)."""
GROUP = Path("/proc/self/cgroup")
"""Where it tells the group of this process."""


def free_memory() -> int | None:
    """Bytes of main memory that this process may still use; None if the system does not tell."""
    free = [value for value in (_system(), *map(_left_in, groups())) if value is not None]
    return min(free) if free else None


def groups() -> list[Path]:
    """Folders of the groups whose limits hold for this process: its own and all above it."""
    own = ""
    with contextlib.suppress(OSError, StopIteration):
        own = next(line[4:] for line in GROUP.read_text().splitlines() if line.startswith("0::/"))
    folder = CONTAINER / own
    return [group for group in (folder, *folder.parents) if group.is_relative_to(CONTAINER)]


def _system() -> int | None:
    with contextlib.suppress(OSError, KeyError, ValueError):
        facts = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        return int(facts["MemAvailable"].split()[0]) * 1024
    return None


def _left_in(group: Path) -> int | None:
    try:
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return max(0, limit - used + int(cached.get("inactive_file", 0)))
    except (OSError, ValueError):  # no group of version 2, or one without a limit ("max")
        return None
