"""List the releases that are published at a URL; only their manifests are read."""

from __future__ import annotations

from typing import Any

from dmcvb_gen.dataset.manifest import MANIFEST, parse_manifest
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.remote import file_system, public, storage_errors


def releases_at(url: str, options: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """The release at a URL, or those in the folders right below it; what is being published is none yet.

    Args:
      options: options of fsspec.

    Returns:
      A dictionary a release: url, name, version, subsets, episodes, complete, digest.

    Raises:
      StoreError: nothing is there, or it cannot be read.
    """
    place = public(url).rstrip("/")
    filesystem, base = file_system(url, options)
    with storage_errors(url):
        if filesystem.isfile(f"{base}/{MANIFEST}"):
            found = {place: base}
        else:
            folders = sorted(
                entry["name"] for entry in filesystem.ls(base, detail=True) if entry["type"] == "directory"
            )
            found = {f"{place}/{folder.rstrip('/').rsplit('/', 1)[-1]}": folder.rstrip("/") for folder in folders}
        paths = [f"{folder}/{MANIFEST}" for folder in found.values()]
        texts = filesystem.cat(paths, on_error="return") if paths else {}
        if not isinstance(texts, dict):  # fsspec gives what a single path has
            texts = {paths[0]: texts}
        for error in texts.values():
            if isinstance(error, BaseException) and not isinstance(error, FileNotFoundError | NotADirectoryError):
                raise error
    texts = {path.lstrip("/"): text for path, text in texts.items() if isinstance(text, bytes)}
    releases = []
    for where, folder in found.items():
        text = texts.get(f"{folder}/{MANIFEST}".lstrip("/"))
        if text is not None:
            releases.append(_facts(where, text))
    if not releases:
        raise StoreError(f"{place} holds no release, nor do the folders in it; check the URL")
    return releases


def _facts(where: str, text: bytes) -> dict[str, Any]:
    manifest = parse_manifest(text, f"{where}/{MANIFEST}")
    return {
        "url": where,
        "name": manifest.name,
        "version": manifest.version,
        "subsets": len(manifest.subsets),
        "episodes": sum(record.episodes for record in manifest.subsets),
        "complete": manifest.complete,
        "digest": manifest.digest,
    }
