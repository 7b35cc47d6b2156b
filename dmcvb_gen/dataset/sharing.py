"""Store equal files of a release once, as hard links.

The settings of a task and level share their episodes by default, so their states, actions, rewards and physics are
equal byte for byte. If the file system has hard links, these take room once. Every subset stays complete by itself
and no reader notices. Writers put new files in the place of old ones and never write into a file, so linked files do
not change each other.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from dmcvb_gen.dataset.manifest import CommitRecord, FileRecord, Manifest, subset_path
from dmcvb_gen.files import folder_in_the_making, sha256_file

Commits = Mapping[str, Mapping[int, CommitRecord]]
"""Subset -> shard -> commit record."""


def link_equal_files(root: Path, manifest: Manifest, commits: Commits, changed: Collection[str] | None = None) -> int:
    """Make files of sibling subsets (one task and level) that have equal bytes links to one file.

    A file that does not have its digest any more is never linked to.

    Args:
      changed: of a repair: paths of files that are new. Only these, and damaged files, become links then. By default
        all files do that have their digests; damaged ones are left for `verify` to find.

    Returns:
      How many files became links. 0 if the folder cannot be written or has no hard links.
    """
    linked = 0
    try:
        with folder_in_the_making(root, "links") as scratch:
            for equal in equal_files(manifest, commits):
                linked += _link_all(root, equal, scratch / "link", changed)
    except OSError:
        pass  # the release is whole without links
    return linked


def equal_files(manifest: Manifest, commits: Commits) -> Iterable[list[FileRecord]]:
    """Files with one digest, of the same array and shard of sibling subsets."""
    groups: dict[tuple[str, ...], list[FileRecord]] = {}
    for record in manifest.subsets:
        start = len(subset_path(record.name))
        for commit in commits.get(record.name, {}).values():
            for file in commit.files:
                groups.setdefault((record.task, record.level, file.path[start:], file.sha256), []).append(file)
    return [files for files in groups.values() if len(files) > 1]


def _link_all(root: Path, files: list[FileRecord], temporary: Path, changed: Collection[str] | None) -> int:
    """Replace files by links to the first one that has its digest; see `link_equal_files` for which.

    Raises:
      OSError: the file system has no links, or a file vanished.
    """
    if changed is not None and not any(file.path in changed for file in files):
        return 0
    nodes = {file.path: os.stat(root / file.path) for file in files}
    if len({(node.st_dev, node.st_ino) for node in nodes.values()}) == 1:
        return 0
    sound = [file for file in files if sha256_file(root / file.path) == file.sha256]
    if not sound:
        return 0
    first = min(sound, key=lambda file: changed is not None and file.path in changed)
    linked = 0
    for file in files:
        kept = file not in sound if changed is None else file in sound and file.path not in changed
        if not kept and not os.path.samestat(nodes[file.path], nodes[first.path]):
            os.link(root / first.path, temporary)
            os.replace(temporary, root / file.path)
            temporary.unlink(missing_ok=True)  # it stays if both names were one file already
            linked += 1
    return linked


def link_known(root: Path, file: FileRecord, others: Iterable[str]) -> bool:
    """Make a file of a release, which is not there yet, a link to another one that has its bytes.

    Args:
      others: paths in the release of files that should have these bytes.

    Returns:
      False if none has them, or links do not work here.
    """
    target = root / file.path
    for other in others:
        with contextlib.suppress(OSError):
            if not target.exists() and (root / other).stat().st_size == file.bytes:
                if sha256_file(root / other) == file.sha256:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    os.link(root / other, target)
                    return True
    return False


def disk_bytes(root: Path, paths: Iterable[str]) -> int:
    """Bytes that some files of a folder take on the disk: a file with several names counts once."""
    nodes = {(node.st_dev, node.st_ino): node.st_size for path in paths if (node := _stat(root / path))}
    return sum(nodes.values())


def _stat(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except OSError:
        return None
