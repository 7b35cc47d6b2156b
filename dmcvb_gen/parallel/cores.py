"""Count the cores that this process may use: a batch system or container often grants few of a machine's.

The number of workers follows from them, unless it is given.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from dmcvb_gen.parallel.memory import free_memory, groups


def default_workers(pieces: int, memory: int = 0) -> int:
    """The default number of workers: a core each, as far as there is work and memory for them; at least 1.

    Args:
      pieces: pieces of work. memory: bytes that a worker needs; 0 if it needs little.
    """
    free = free_memory()
    room = pieces if free is None or not memory else free // memory
    return max(1, min(usable_cores(), pieces, room))


def usable_cores() -> int:
    """Return the number of cores that the system lets this process use, at least 1."""
    return max(1, int(min(_allowed(), *map(_granted_by, groups()))))


def _allowed() -> float:
    """Cores that the process may run on: those of its CPU affinity, which Slurm and taskset set."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS and Windows do not tell
        return os.cpu_count() or 1


def _granted_by(group: Path) -> float:
    """Cores whose time a container or job may take, rounded up (cgroup v2)."""
    try:
        quota, period = (group / "cpu.max").read_text().split()
        return math.ceil(int(quota) / int(period))
    except (OSError, ValueError):  # no group of version 2, or one without a limit ("max")
        return math.inf
