"""Unpack the package's own policies into the user's cache.

`data/<group>.xz` hold the files, one archive a group (a locomotion task, or all mazes, whose policies repeat one
network); `data/policies.json` lists them by their SHA-256. A file is unpacked once and checked at every use. An archive
is xz over a list of the files' names and headers and, behind it, the bytes of all float32 weights: first all lowest
bytes, then all second ones, ..., because signs and exponents resemble each other and noise does not.
`scripts/pack_policies.py` adds the picks of runs.
"""

from __future__ import annotations

import functools
import json
import lzma
import os
import tempfile
from collections.abc import Iterable, Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_bytes, sha256_if_readable, write_bytes
from dmcvb_gen.spec import is_maze

INDEX = "policies.json"
WORD = 8
"""Bytes of a length, in an archive as in a safetensors file."""


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
    places = (folder / _place(name) for folder in cache_folders())
    sound = (path for path in places if sha256_if_readable(path) == bundled_digests()[name])
    return next(sound, None) or _unpack(name)


def _place(name: str) -> Path:
    """A file's path below a cache folder; versions of this package that bring other policies share that folder."""
    return Path(bundled_digests()[name][:16]) / name


def cache_folders() -> list[Path]:
    """Folders for unpacked policies, the preferred one first: the user's cache, then the system's temporary folder."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return [Path(home) / "dmcvb-gen" / "policies", Path(tempfile.gettempdir()) / f"dmcvb-gen-{user}" / "policies"]


def _unpack(name: str) -> Path:
    """Unpack a file and the others of its task; a few tenths of a second."""
    task = name.split("/")[0]
    group = unpack_files((data_folder() / f"{group_of(task)}.xz").read_bytes())
    files = {file: content for file, content in group.items() if file.startswith(f"{task}/")}
    reason: OSError | None = None
    for folder in cache_folders():
        try:
            for file, content in files.items():
                write_bytes(folder / _place(file), content)
            return folder / _place(name)
        except OSError as error:
            reason = error
    raise DmcvbError(
        f"cannot unpack the policy {name} into {cache_folders()[0]} ({reason}); set "
        "XDG_CACHE_HOME to a folder that can be written"
    )


def pack_files(contents: dict[str, bytes]) -> bytes:
    """Pack safetensors files of float32 arrays, name -> bytes, into the bytes of one archive."""
    ends = {name: WORD + int.from_bytes(content[:WORD], "little") for name, content in contents.items()}
    index = [[name, content[: ends[name]].decode("latin-1"), len(content)] for name, content in contents.items()]
    listing = json.dumps(index).encode()
    weights = b"".join(content[ends[name] :] for name, content in contents.items())
    planes = b"".join(weights[byte::4] for byte in range(4))
    return lzma.compress(len(listing).to_bytes(WORD, "little") + listing + planes, preset=9 | lzma.PRESET_EXTREME)


def unpack_files(archive: bytes) -> dict[str, bytes]:
    """The files of an archive: name -> bytes."""
    content = lzma.decompress(archive)
    start = WORD + int.from_bytes(content[:WORD], "little")
    planes, weights = content[start:], bytearray(len(content) - start)
    for byte in range(4):
        weights[byte::4] = planes[byte * len(weights) // 4 : (byte + 1) * len(weights) // 4]
    files, at = {}, 0
    for name, head, size in json.loads(content[WORD:start]):
        files[name] = head.encode("latin-1") + weights[at : at + size - len(head)]
        at += size - len(head)
    return files


def pack(files: Mapping[str, bytes], out: Path) -> None:
    """Put the policies of some tasks, "<task>/<file>" -> bytes, into archives and list; keep all others."""

    def others(names: Iterable[str]) -> list[str]:
        return [name for name in names if name.split("/")[0] not in tasks]

    tasks, index = {name.split("/")[0] for name in files}, out / INDEX
    for group in sorted(set(map(group_of, tasks))):
        archive = out / f"{group}.xz"
        old = unpack_files(archive.read_bytes()) if archive.exists() else {}
        held = {name: old[name] for name in others(old)}
        held |= {name: content for name, content in files.items() if group_of(name.split("/")[0]) == group}
        archive.write_bytes(pack_files(dict(sorted(held.items()))))
    listed = json.loads(index.read_text()) if index.exists() else {}
    digests = {name: listed[name] for name in others(listed)}
    digests |= {name: sha256_bytes(content) for name, content in files.items()}
    index.write_text(json.dumps(dict(sorted(digests.items())), indent=1) + "\n")
