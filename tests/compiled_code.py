"""Pytest plugin that shares numba's compiled code between checkouts and runs, so that tests compile only what is new.

numba keeps compiled code in the `__pycache__` of the source. A fresh checkout has none, and compiling the native
renderer takes a core most of a minute. This plugin copies compiled code from a folder in the user's cache before the
tests, and back after them. That folder's name is a digest of the source, so other source finds nothing there. numba
itself compares its own digest of the source, the processor and its version before it uses what it finds.
"""

import hashlib
import os
import platform
import shutil
from pathlib import Path

import numba
import pytest

import dmcvb_gen

ROOMS = [Path(dmcvb_gen.__file__).parent / room for room in ("rendering/native", "policies")]
"""Packages with functions that numba compiles and keeps."""
KEPT = 20
"""Folders of compiled code that are kept, the last used ones."""


def cache_root() -> Path:
    """Folder of all compiled code that tests share."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dmcvb-gen-tests"


def shared(room: Path) -> Path:
    """Folder of the compiled code of a package as its source is now."""
    digest = hashlib.sha256(f"{numba.__version__} {platform.python_version()}".encode())
    for path in sorted(room.glob("*.py")):
        digest.update(path.read_bytes())
    return cache_root() / f"{room.name}-{digest.hexdigest()[:16]}"


def copy(source: Path, target: Path, since: float = 0) -> None:
    """Copy compiled code that was changed after a moment; who reads meanwhile sees whole files."""
    for path in sorted(source.glob("*.nb?")):  # the code before the index that names it
        changed = path.stat().st_mtime
        there = target / path.name
        if changed > since and not (there.exists() and there.stat().st_mtime == changed):
            target.mkdir(parents=True, exist_ok=True)
            part = target / f"{path.name}.{os.getpid()}"
            shutil.copy2(path, part)
            part.replace(there)


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):  # not in the workers of pytest-xdist, which start later
        for room in ROOMS:
            copy(shared(room), room / "__pycache__")


def pytest_unconfigure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):
        return
    for room in ROOMS:
        copy(room / "__pycache__", shared(room), since=max(path.stat().st_mtime for path in room.glob("*.py")))
    folders = sorted(cache_root().glob("*-*"), key=lambda folder: folder.stat().st_mtime)
    for folder in folders[:-KEPT]:
        shutil.rmtree(folder, ignore_errors=True)
