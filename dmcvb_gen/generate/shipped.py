"""Releases that this package describes but does not hold: their manifests and indexes, found by name.

A manifest promises a digest for each subset; the index beside it promises one for each file. So any part of such a
release can be made anywhere, and each of its files is compared with the released one.
"""

from __future__ import annotations

import contextlib
import io
import lzma
import re
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.errors import StoreError, UnknownNameError

if TYPE_CHECKING:
    from dmcvb_gen.dataset.index import Index

_FOLDER = resources.files("dmcvb_gen.generate") / "data" / "manifests"
ENDING = ".tar.xz"
DIGESTS = "digests"
"""Member of an archive with the 32 bytes of each digest of the others, as they come; in text, digests
take more room even compressed."""
_DIGEST = re.compile(rb"[0-9a-f]{64}")
_NEW, _KNOWN = b"\0", b"\1"
"""Bytes that JSON never holds: the next digest of `DIGESTS`, or the one whose number follows in three bytes."""
_PLACES = re.compile(rb"\x00|\x01(...)", re.DOTALL)


def shipped_manifests() -> tuple[str, ...]:
    """Names of the releases whose manifests are in the package."""
    names = [path.name for path in _FOLDER.iterdir()]
    return tuple(sorted(name.removesuffix(ENDING) for name in names if name.endswith(ENDING)))


@contextlib.contextmanager
def manifest_source(source: str | Path) -> Iterator[Path]:
    """A manifest's file or, for the name of a shipped one, a folder with manifest and index.

    Raises:
      UnknownNameError: a plain name that is neither a file nor a shipped manifest's.
      StoreError: there is no such file.
    """
    path = Path(source)
    if path.is_file():
        yield path
        return
    if path.is_dir():
        raise StoreError(f"{path} is a folder; give it without --manifest, or the file {path / MANIFEST}")
    if path.suffix or path.name != str(source):
        raise StoreError(f"{path} is not there; give a manifest's file or a name: {', '.join(shipped_manifests())}")
    if str(source) not in shipped_manifests():
        raise UnknownNameError("manifest", str(source), shipped_manifests())
    with tempfile.TemporaryDirectory() as folder, resources.as_file(_FOLDER / f"{source}{ENDING}") as archive:
        for name, content in unpack(archive).items():
            (Path(folder) / name).write_bytes(content)
        yield Path(folder)


def write_archive(release: str | Path, out: str | Path) -> int:
    """Write the archive that the package ships for a release, from a complete one on this machine.

    Returns:
      The archive's size in bytes.

    Raises:
      StoreError: the release is not complete.
    """
    from dmcvb_gen.dataset.index import INDEX

    read_complete(release)
    return pack({name: (Path(release) / name).read_bytes() for name in (MANIFEST, INDEX)}, out)


def read_complete(release: str | Path) -> tuple[Manifest, Index]:
    """The manifest and index of a complete release on this machine, of which the data need not be there.

    Raises:
      StoreError: the release is not complete.
    """
    from dmcvb_gen.dataset.index import trusted_index  # loads zarr, which names need not
    from dmcvb_gen.dataset.reader import load_manifest

    root, manifest = load_manifest(release)
    index = trusted_index(root, manifest)
    if not manifest.complete or index is None:
        raise StoreError(f"{root} is not complete; finish it with the command that began it")
    return manifest, index


def pack(members: Mapping[str, bytes], out: str | Path) -> int:
    """Write an archive, see `write_archive`.

    Args:
      members: the bytes of manifest and index, by their names in a release.
    """
    known: dict[bytes, int] = {}
    shortened = {name: _without_digests(content, known) for name, content in members.items()}
    shortened[DIGESTS] = b"".join(bytes.fromhex(digest.decode()) for digest in known)
    # One stream, because both have much in common; without times, so that equal releases give equal archives.
    with lzma.open(out, "wb", preset=9 | lzma.PRESET_EXTREME) as packed:
        with tarfile.open(fileobj=packed, mode="w") as archive:
            for name, content in shortened.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
    return Path(out).stat().st_size


def unpack(archive: str | Path) -> dict[str, bytes]:
    """The bytes of manifest and index of an archive, by their names in a release."""
    with tarfile.open(archive) as file:
        members = {member.name: file.extractfile(member).read() for member in file}  # type: ignore[union-attr]
    data = members.pop(DIGESTS).hex().encode()
    digests = [data[place : place + 64] for place in range(0, len(data), 64)]
    fresh = iter(digests)

    def digest(found: re.Match[bytes]) -> bytes:
        return digests[int.from_bytes(found[1], "big")] if found[1] else next(fresh)

    return {name: _PLACES.sub(digest, content) for name, content in members.items()}


def _without_digests(content: bytes, known: dict[bytes, int]) -> bytes:
    """JSON with a byte in place of each new digest, and a number in place of one that is known; see `DIGESTS`."""

    def place(found: re.Match[bytes]) -> bytes:
        if found[0] in known:
            return _KNOWN + known[found[0]].to_bytes(3, "big")
        known[found[0]] = len(known)
        return _NEW

    return _DIGEST.sub(place, content)
