"""Releases that this package describes but does not hold: their manifests and indexes, found by name.

A manifest promises a digest for each subset; the index beside it promises one for each file. So any part of such a
release can be made anywhere, and each of its files is compared with the released one.
"""

from __future__ import annotations

import contextlib
import tempfile
import zipfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

from dmcvb_gen.dataset.manifest import MANIFEST
from dmcvb_gen.errors import StoreError, UnknownNameError

_FOLDER = resources.files("dmcvb_gen.generate") / "data" / "manifests"
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every file in an archive, so that equal releases give equal archives."""


def shipped_manifests() -> tuple[str, ...]:
    """Names of the releases whose manifests are in the package."""
    return tuple(sorted(path.name.removesuffix(".zip") for path in _FOLDER.iterdir() if path.name.endswith(".zip")))


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
    with tempfile.TemporaryDirectory() as folder, resources.as_file(_FOLDER / f"{source}.zip") as archive:
        with zipfile.ZipFile(archive) as file:
            file.extractall(folder)
        yield Path(folder)


def write_archive(release: str | Path, out: str | Path) -> int:
    """Write the archive that the package ships for a release, from a complete one on this machine.

    Returns:
      The archive's size in bytes.

    Raises:
      StoreError: the release is not complete.
    """
    from dmcvb_gen.dataset.index import INDEX, trusted_index  # loads zarr, which names need not
    from dmcvb_gen.dataset.reader import load_manifest

    root, manifest = load_manifest(release)
    if not manifest.complete or trusted_index(root, manifest) is None:
        raise StoreError(f"{root} is not complete; finish it with the command that began it")
    with zipfile.ZipFile(out, "w", zipfile.ZIP_LZMA) as archive:
        for name in (MANIFEST, INDEX):
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), (root / name).read_bytes(), zipfile.ZIP_LZMA)
    return Path(out).stat().st_size
