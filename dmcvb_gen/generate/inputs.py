"""Find the policies and videos that a subset is made from, in the release or the package, by digest."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, DmcvbError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.policies.header import OWN_CODE

BUILTIN = "builtin"
"""The videos that the package brings."""


@dataclass(frozen=True)
class Inputs:
    """The files that a subset is made from, on this machine.

    Attributes:
      policies: files of the behaviour policies, in the record's order; none for uniform random actions.
      backgrounds: "builtin", or the folder of the videos.
    """

    policies: tuple[str, ...] = ()
    backgrounds: str = BUILTIN


def release_inputs(root: Path, records: Iterable[SubsetRecord], backgrounds: str | None = None) -> dict[str, Inputs]:
    """Policies and videos of a release's subsets, checked by digest.

    Args:
      root: the release's folder, which has copies of what the package does not bring.
      backgrounds: folder of the videos, instead of the manifest's.

    Raises:
      StoreError: a policy or the videos are not there, or not those of the manifest.
    """
    return {
        record.name: Inputs(policy_files(root, record), background_source(root, record, backgrounds))
        for record in records
    }


def policy_files(root: Path, record: SubsetRecord) -> tuple[str, ...]:
    """Files of a subset's policies: the release's own copies, else the bundled ones, by digest; names of own code.

    Raises:
      StoreError: neither is there.
    """
    found = []
    for policy in record.policies:
        if policy.header.get("algorithm") == OWN_CODE:
            found.append(policy.name)  # its digest is checked when it is loaded, and its code is let run there
            continue
        candidates = [root / policy.path] if policy.path else []
        with contextlib.suppress(DmcvbError):  # the release's own copy is enough
            candidates += resolve_policies(record.task, record.level)
        same = (str(path) for path in candidates if _digest(path) == policy.digest)
        if (path := next(same, None)) is not None:
            found.append(path)
        else:
            raise StoreError(
                f"policy {policy.name} of {record.name} (digest {policy.digest[:12]}) is neither in the release nor "
                f"bundled with this dmcvb-gen; put its file at {policy.path}"
            )
    return tuple(found)


def _digest(path: Path) -> str | None:
    """The digest of a policy file, None if it cannot be read."""
    try:
        return sha256_file(path)
    except OSError:
        return None


def background_source(root: Path, record: SubsetRecord, moved: str | None = None) -> str:
    """Find a subset's videos and compare them with the manifest's digest.

    Args:
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


def video_source(root: str | Path, record: SubsetRecord, moved: str | None = None) -> str:
    """Return "builtin" or the folder of a subset's videos; nothing is opened.

    Args:
      root: the release's folder, which has copies of videos that the package does not bring.
      moved: folder of the videos, instead of the manifest's.
    """
    source = moved or (record.backgrounds or {}).get("source", BUILTIN)
    inside = not (moved or source == BUILTIN or Path(source).is_absolute())  # absolute: in releases of version 1
    return f"{root}/{source}" if inside else source
