"""Find the policies and videos that a subset is made from, in the release or the package, by digest."""

from __future__ import annotations

import atexit
import contextlib
import functools
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import FileRecord, SubsetRecord
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, DmcvbError, StoreError
from dmcvb_gen.files import sha256_if_readable
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.header import OWN_CODE
from dmcvb_gen.storage.store import NotThere, Store

BUILTIN = "builtin"
"""The videos that the package brings."""


def local_inputs(store: Store, files: Iterable[FileRecord]) -> Path:
    """The folder with a release's copies of policies and videos: its own, or one of this process with what it lacks."""
    if store.folder is not None:
        return store.folder
    folder = _brought(store)
    for file in files:
        if not (folder / file.path).exists():
            with contextlib.suppress(NotThere):  # the package may bring the same
                store.download(file.path, folder / file.path, file.bytes, file.sha256)
    return folder


@functools.cache
def _brought(store: Store) -> Path:
    """A folder of this process for a store's files, which goes with it."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="dmcvb-gen-"))
    except OSError as error:
        raise StoreError(f"no temporary folder can be made ({error}); set TMPDIR to one with room") from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def policy_files(root: str | Path, record: SubsetRecord) -> tuple[str, ...]:
    """Files of a subset's policies: the release's own copies, else the bundled ones, by digest; names of own code.

    Args:
      root: a folder with the release's copies.

    Raises:
      StoreError: neither is there.
    """
    found = []
    for policy in record.policies:
        if policy.header.get("algorithm") == OWN_CODE:
            found.append(policy.name)  # its digest is checked when it is loaded, and its code is let run there
            continue
        candidates = [Path(root) / policy.path] if policy.path else []
        with contextlib.suppress(DmcvbError):  # the release's own copy is enough
            candidates += resolve_policies(record.task, record.level)
        same = (str(path) for path in candidates if sha256_if_readable(path) == policy.digest)
        if (path := next(same, None)) is not None:
            found.append(path)
        else:
            raise StoreError(
                f"policy {policy.name} of {record.name} (digest {policy.digest[:12]}) is neither in the release nor "
                f"bundled with this dmcvb-gen; put its file at {policy.path}"
            )
    return tuple(found)


def background_source(root: str | Path, record: SubsetRecord, moved: str | None = None) -> str:
    """Find a subset's videos and compare them with the manifest's digest.

    Args:
      root: a folder with the release's copies.
      moved: folder of the videos, instead of the manifest's.

    Raises:
      StoreError: they are other videos, or not there.
    """
    if record.backgrounds is None:
        return BUILTIN
    given = video_source(root, record, moved)
    try:
        digest = load_backgrounds(given, record.backgrounds["split"]).digest
    except BackgroundError as error:
        raise StoreError(f"the backgrounds of {record.name} cannot be used: {error}") from None
    if digest != record.backgrounds["digest"]:
        raise StoreError(
            f"backgrounds {given!r} are not those that {record.name} was painted with; give the folder of "
            "those (--backgrounds), or show others: `dmcvb-gen repaint`"
        )
    return given


def shown_videos(subset: Subset, moved: str | None = None) -> str:
    """Return "builtin" or the folder of the videos that a subset shows; those of a URL are fetched.

    Args:
      moved: folder of the videos, instead of the manifest's.
    """
    release, record = subset.release, whose_videos(subset.release, subset.record)
    if subset.setting != "none":
        moved = moved or subset.other_videos
    if moved or (record.backgrounds or {}).get("source", BUILTIN) == BUILTIN:
        return moved or BUILTIN
    return video_source(local_inputs(release.store, release.inputs_of([record.name])), record)


def whose_videos(release: Release, record: SubsetRecord) -> SubsetRecord:
    """The subset whose videos one is painted with: itself, or if it shows none, the release's first with its own."""
    own = (other for other in release.manifest.subsets if (other.backgrounds or {}).get("source", BUILTIN) != BUILTIN)
    return record if record.backgrounds else next(own, record)


def video_source(root: str | Path, record: SubsetRecord, moved: str | None = None) -> str:
    """Return "builtin" or the folder of a subset's videos; nothing is opened.

    Args:
      root: a folder with the release's copies of videos that the package does not bring.
      moved: folder of the videos, instead of the manifest's.
    """
    source = moved or (record.backgrounds or {}).get("source", BUILTIN)
    return source if moved or source == BUILTIN else f"{root}/{source}"
