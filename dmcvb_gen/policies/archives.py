"""Unpack the package's own policies into the user's cache.

`data/<group>.zip` hold the files, one archive a group (a locomotion task, or all mazes, whose policies repeat one
network), see `packing`; `data/policies.json` lists them by their SHA-256. A file is unpacked once and checked at every
use.
`scripts/pack_policies.py` makes archives and list.
"""

from __future__ import annotations

import functools
import json
import os
import tempfile
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import replacing, sha256_file
from dmcvb_gen.spec import is_maze

INDEX = "policies.json"


def data_folder() -> Traversable:
    """Folder of the archives and their list."""
    return resources.files("dmcvb_gen.policies") / "data"


def group_of(task_id: str) -> str:
    """The archive that holds a task's policies, without its ending."""
    return "ant-maze" if is_maze(task_id) else task_id


@functools.cache
def bundled_digests() -> dict[str, str]:
    """ "<task>/<file>" -> SHA-256 of each bundled policy file."""
    return json.loads((data_folder() / INDEX).read_text())


def bundled_file(name: str) -> Path:
    """Return the path of a bundled file ("<task>/<file>"), unpacked and checked.

    Raises:
      DmcvbError: it cannot be unpacked, because no folder for it can be written.
    """
    path = next((folder / name for folder in cache_folders() if _is_sound(folder / name, name)), None)
    return path or _unpack(name)


def cache_folders() -> list[Path]:
    """Folders for unpacked policies, the preferred one first: the user's cache, then the system's temporary folder."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return [Path(home) / "dmcvb-gen" / "policies", Path(tempfile.gettempdir()) / f"dmcvb-gen-{user}" / "policies"]


def _is_sound(path: Path, name: str) -> bool:
    try:
        return sha256_file(path) == bundled_digests()[name]
    except OSError:
        return False


def _unpack(name: str) -> Path:
    """Unpack a file and the others of its task; a few tenths of a second."""
    from dmcvb_gen.policies.packing import unpack_files  # loads numpy

    task = name.split("/")[0]
    group = unpack_files((data_folder() / f"{group_of(task)}.zip").read_bytes())
    files = {file: content for file, content in group.items() if file.startswith(f"{task}/")}
    reason: OSError | None = None
    for folder in cache_folders():
        try:
            for file, content in files.items():
                with replacing(folder / file) as path:
                    path.write_bytes(content)
        except OSError as error:
            reason = error
            continue
        if _is_sound(folder / name, name):
            return folder / name
    raise DmcvbError(
        f"cannot unpack the policy {name} into {cache_folders()[0]} ({reason or 'other bytes came back'}); set "
        "XDG_CACHE_HOME to a folder that can be written"
    )


def pack(folder: Path, out: Path) -> None:
    """Write archives and list from the policy files <task>/<level>.safetensors of a folder.

    Raises:
      ValueError: a file has arrays that are not float32.
    """
    from dmcvb_gen.policies.packing import pack_files

    # Checkpoints of one run in their order, its last one after them, so that each resembles the one before.
    paths = sorted(
        folder.glob("*/*.safetensors"), key=lambda path: (path.stem == "expert", path.stem == "medium", path)
    )
    groups: dict[str, dict[str, bytes]] = {}
    for path in paths:
        group = groups.setdefault(group_of(path.parent.name), {})
        group[path.relative_to(folder).as_posix()] = path.read_bytes()
    for group_name, contents in groups.items():
        (out / f"{group_name}.zip").write_bytes(pack_files(contents))
    digests = {path.relative_to(folder).as_posix(): sha256_file(path) for path in sorted(paths)}
    (out / INDEX).write_text(json.dumps(digests, indent=1) + "\n")
