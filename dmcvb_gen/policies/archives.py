"""The package's own policies: a task and a file's name in, the file unpacked into the user's cache out.

`data/<group>.tar.xz` hold the files, one archive a group (a locomotion task, or all mazes, whose policies repeat one
network); `data/policies.json` lists them by their SHA-256. A file is unpacked once and checked at every use.
`scripts/pack_policies.py` makes archives and list.
"""

from __future__ import annotations

import functools
import io
import json
import lzma
import os
import tarfile
import tempfile
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import IO, cast

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import replacing, sha256_file
from dmcvb_gen.spec import is_maze

INDEX = "policies.json"
LZMA_FILTERS = [
    {"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": 1 << 25, "lc": 0, "lp": 2, "pb": 2}  # lp, pb: float32 weights
]


def data_folder() -> Traversable:
    """Where archives and their list lie."""
    return resources.files("dmcvb_gen.policies") / "data"


def group_of(task_id: str) -> str:
    """The archive that holds a task's policies, without its ending."""
    return "ant-maze" if is_maze(task_id) else task_id


@functools.cache
def bundled_digests() -> dict[str, str]:
    """ "<task>/<file>" -> SHA-256 of each bundled policy file."""
    return json.loads((data_folder() / INDEX).read_text())


def bundled_file(name: str) -> Path:
    """Where a bundled file ("<task>/<file>") lies, unpacked and checked.

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
    task = name.split("/")[0]
    packed = (data_folder() / f"{group_of(task)}.tar.xz").read_bytes()
    with tarfile.open(fileobj=io.BytesIO(lzma.decompress(packed))) as archive:
        members = [member for member in archive if member.name.startswith(f"{task}/")]
        files = {member.name: cast(IO[bytes], archive.extractfile(member)).read() for member in members}
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
    """Write archives and list from the policy files <task>/<level>.safetensors of a folder."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.glob("*/*.safetensors"))
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(group_of(name.split("/")[0]), []).append(name)
    for group, members in groups.items():
        raw = io.BytesIO()
        with tarfile.open(fileobj=raw, mode="w", format=tarfile.USTAR_FORMAT) as archive:
            for name in members:
                content = (folder / name).read_bytes()
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        packed = lzma.compress(raw.getvalue(), format=lzma.FORMAT_XZ, filters=LZMA_FILTERS)
        (out / f"{group}.tar.xz").write_bytes(packed)
    digests = {name: sha256_file(folder / name) for name in names}
    (out / INDEX).write_text(json.dumps(digests, indent=1) + "\n")
