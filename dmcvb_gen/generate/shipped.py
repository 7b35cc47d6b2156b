"""Releases that this package describes but does not hold: their manifests and indexes, found by name.

A manifest promises a digest for each subset; the index beside it promises one for each file. So any part of such a
release can be made anywhere, and each of its files is compared with the released one.
"""

from __future__ import annotations

import contextlib
import io
import lzma
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
        with tarfile.open(archive) as file:
            file.extractall(folder, filter="data")
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
    # One stream, because both hold the same digests; without times, so that equal releases give equal archives.
    with lzma.open(out, "wb", preset=9 | lzma.PRESET_EXTREME) as packed:
        with tarfile.open(fileobj=packed, mode="w") as archive:
            for name, content in members.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
    return Path(out).stat().st_size
