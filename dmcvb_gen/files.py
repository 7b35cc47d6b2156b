"""Write files atomically: bytes, text or JSON become a whole file, flushed to the disk, or none.

A file in the making has a name of its own that ends in `PARTIAL`, beside the one that it becomes, so writers never
disturb each other. The name says who makes it (machine, its start, process namespace, process and its start), so that
files of a killed process can be told from those of a running one, even if the machine was started again since::

    .NAME.<machine>-<start and namespace>[+<host>]@<process>-<its start>.<random>.partial

Containers have process namespaces of their own and no host: their files are left alone, even if they share the
machine's name.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

PARTIAL = ".partial"
"""Ending of files in the making."""
LARGEST_YAML = 100_000
"""Bytes of a file that somebody wrote by hand; PyYAML, which is not fast, takes seconds for it at worst."""
BOOT, HOST = Path("/proc/sys/kernel/random/boot_id"), Path("/etc/machine-id")
"""Files of Linux: an id of the system's start, and one that stays the machine's."""
HOST_NAMESPACE = "pid:[4026531836]"
"""Process namespace of a Linux system itself; containers have others."""
_OWNED = re.compile(
    r"\..+\.(?P<machine>[^.@+]+)(?:\+(?P<host>[0-9a-f]+))?@(?P<process>\d+)(?:-(?P<started>\d+))?\.[^.]+"
    + re.escape(PARTIAL)
)


@contextlib.contextmanager
def replacing(path: str | Path, new: bool = False) -> Iterator[Path]:
    """Give a fresh path to write to; when the block ends well, that file takes the place of `path`, else it goes.

    For writers that want a path; what they write is flushed to the disk before it is put in place.

    Args:
      new: `path` must not be there yet.

    Raises:
      OSError: the folder cannot be made or written; FileExistsError: `path` should be new and is there.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.{_owner()}.", suffix=PARTIAL)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp's files are their owner's alone
        if new:
            os.link(temporary, path)
            temporary.unlink()
        else:
            os.replace(temporary, path)
            temporary.unlink(missing_ok=True)  # it stays if both names were one file already
        flush_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _owner() -> str:
    started, host = _start_of(os.getpid()), _host()
    owner = _machine() + (f"+{host}" if host else "")
    return f"{owner}@{os.getpid()}" + ("" if started is None else f"-{started}")


@functools.cache
def _machine() -> str:
    """Return the scope of process ids: the machine's name, its last start and the process namespace."""
    name = re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname()) or "unknown"
    facts = ""
    with contextlib.suppress(OSError):  # of Linux alone
        facts = BOOT.read_text() + os.readlink("/proc/self/ns/pid")
    return f"{name}-{sha256_bytes(facts.encode())[:8]}"


@functools.cache
def _host() -> str | None:
    """Return what stays the same when this machine is started again; None if that is not known, and in containers."""
    with contextlib.suppress(OSError):
        host = HOST.read_text().strip()
        if len(host) == 32 and os.readlink("/proc/self/ns/pid") == HOST_NAMESPACE:
            return sha256_bytes(f"{socket.gethostname()} {host}".encode())[:8]
    return None


def _umask() -> int:
    """The process's mask of new files' rights, which can only be read by setting it (or from /proc, without)."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("Umask:"):
                return int(line.split()[1], 8)
    except OSError:
        pass
    return 0o022


def flush_folder(folder: Path) -> None:
    """Make a rename last through a power cut, if the file system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return  # not every system opens folders
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


def write_bytes(path: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Put `data` in place of the file at `path`, whole or not at all.

    Raises:
      OSError: it cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)


def write_text(path: str | Path, text: str) -> None:
    """Put `text` (UTF-8) in place of the file at `path`, see `write_bytes`."""
    write_bytes(path, text.encode())


def json_bytes(value: Any) -> bytes:
    """A value (plain, or a pydantic model) as the JSON that the files of a release hold."""
    if hasattr(value, "model_dump"):
        value = value.model_dump(mode="json")
    return (json.dumps(value, indent=1) + "\n").encode()


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
      ValueError: it is not JSON, not UTF-8, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_yaml(path: Path | Traversable) -> Any:
    """A small YAML file as plain values.

    Raises:
      OSError: it cannot be read. ValueError: not text, too large, not YAML, or a key is given twice (in a line).
    """
    import yaml  # reading releases needs none

    with path.open("rb") as file:
        content = file.read(LARGEST_YAML + 1)
    if len(content) > LARGEST_YAML:
        raise ValueError(f"over {LARGEST_YAML // 1000} kB, which no settings need")
    try:
        loader = yaml.SafeLoader(content.decode())
        node = loader.get_single_node()
        twice = _repeated_key(node)
        value = None if node is None or twice else loader.construct_document(node)
    except UnicodeDecodeError:
        raise ValueError("not text in UTF-8") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())}") from None
    if twice:
        raise ValueError(f"{twice.value} is given twice (line {twice.start_mark.line + 1}); keep one")
    return value


def _repeated_key(root: Any) -> Any:
    """The node of the first key that a mapping below a YAML node has twice, None if there is none.

    PyYAML would keep the last value and drop the others without a word. Merge keys (`<<`) may repeat: none is lost.
    """
    nodes, seen, found = [root], set(), []
    while nodes:
        node = nodes.pop()
        if isinstance(node, tuple):  # a key and its value
            nodes += node
        elif id(node) not in seen and isinstance(getattr(node, "value", None), list):  # an alias is its anchor's node
            seen.add(id(node))
            nodes += node.value
            known = set()
            for key in (pair[0] for pair in node.value if isinstance(pair, tuple)):
                name = (key.tag, str(key.value))
                if name in known and not key.tag.endswith(":merge"):
                    found.append(key)
                known.add(name)
    return min(found, key=lambda key: key.start_mark.index, default=None)


def write_json(path: str | Path, value: Any) -> None:
    """Put `value` (plain, or a pydantic model) as JSON in place of the file at `path`, see `write_bytes`."""
    write_bytes(path, json_bytes(value))


def copy_file(source: str | Path, target: str | Path) -> None:
    """Copy a file so that `target` is whole or not there, see `write_bytes`."""
    with Path(source).open("rb") as read, replacing(target) as temporary, temporary.open("wb") as file:
        while piece := read.read(1 << 20):
            file.write(piece)


def link_or_copy(source: str | Path, target: str | Path) -> None:
    """Make `target`, which is not there yet, a hard link to a file, or a copy if the file systems cannot link."""
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another disk, or none that links
        copy_file(source, target)


@contextlib.contextmanager
def folder_in_the_making(parent: str | Path, name: str) -> Iterator[Path]:
    """A fresh folder in `parent` for files that will be moved to where they belong; it is gone when the block ends.

    Raises:
      OSError: it cannot be made.
    """
    made = Path(tempfile.mkdtemp(dir=parent, prefix=f".{name}.{_owner()}.", suffix=PARTIAL))
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def remove_partial(folder: str | Path, *, foreign: bool = False, below: bool = True) -> None:
    """Delete what killed processes of this machine left in the making in a folder; files of others stay.

    Args:
      foreign: delete also what does not say whose it is (other libraries' partial files), for folders where no writer
        can be at work.
      below: look in the folders below, too.
    """
    for path in _partial_files(Path(folder), below):
        owner = _OWNED.fullmatch(path.name)
        if not (_is_dead(owner) if owner else foreign):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def others_at_work(folder: str | Path) -> list[str]:
    """Other running processes that are making something in a folder: "process 12", or "a process of machine NAME"."""
    found = set()
    for path in _partial_files(Path(folder), below=False):
        owner = _OWNED.fullmatch(path.name)
        if owner is None or _is_dead(owner):
            continue
        machine, process = owner["machine"], int(owner["process"])
        if machine != _machine():
            found.add(f"a process of machine {machine.rpartition('-')[0]}")
        elif process != os.getpid():
            found.add(f"process {process}")
    return sorted(found)


def _is_dead(owner: re.Match[str]) -> bool:
    """Return True if a process of this machine has ended, at the latest when the machine was started again."""
    if owner["machine"] == _machine():
        return not _alive(int(owner["process"]), owner["started"])
    return owner["host"] is not None and owner["host"] == _host()


def _partial_files(folder: Path, below: bool) -> list[Path]:
    """Files and folders in the making; what is inside such a folder belongs to its owner and is not listed."""
    if not below:
        return list(folder.glob(f"*{PARTIAL}"))
    found = []
    for parent, folders, names in os.walk(folder):
        found += [Path(parent, name) for name in (*folders, *names) if name.endswith(PARTIAL)]
        folders[:] = [name for name in folders if not name.endswith(PARTIAL)]
    return found


def _start_of(process: int) -> str | None:
    """When a process started, in ticks since the system's start; None if the system does not tell (Linux does)."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _alive(process: int, started: str | None) -> bool:
    """Return True if a process is running, and did not take over the number of one that started at another time."""
    if os.name == "nt":
        return True  # os.kill would end it
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return started in (None, _start_of(process) or started)


def free_bytes(folder: str | Path) -> int:
    """Bytes that are free on the disk where a folder is, or would be."""
    path = Path(folder).absolute()
    return shutil.disk_usage(next(place for place in (path, *path.parents) if place.exists())).free


def sha256_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, in hex."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_bytes(data: bytes) -> str:
    """SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()
