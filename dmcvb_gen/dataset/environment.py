"""Name the versions and the processor that can change a bit of the data."""

from __future__ import annotations

import contextlib
import functools
import platform
from importlib import metadata
from pathlib import Path

from dmcvb_gen.version import __version__

PACKAGES = ("mujoco", "dm-control", "scikit-fmm", "numba", "numpy", "scipy", "zarr", "numcodecs")


@functools.cache
def environment() -> dict[str, str]:
    """Versions and processor of this process."""
    versions = {}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):  # one who only reads needs few of them
            versions[name] = metadata.version(name)
    return {
        "dmcvb-gen": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_name(),
        **versions,
    }


def _cpu_name() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"
