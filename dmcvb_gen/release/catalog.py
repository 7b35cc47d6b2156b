"""List the releases that are published at a place; only their manifests are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import MANIFEST
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.store import open_store


def releases_at(place: str, options: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """The release at a folder or URL, or those in the folders right below it; what is being published is none yet.

    Args:
      options: options of the storage client.

    Returns:
      A dictionary a release: url, name, version, subsets, episodes, digest.

    Raises:
      StoreError: nothing is there, or it cannot be read.
    """
    store = open_store(place, options)
    if store.size(MANIFEST) is not None:
        return [_facts(Release.open(store))]
    below = [open_store(f"{place.rstrip('/')}/{name}", options) for name in store.folders()]
    found = [_facts(Release.open(each)) for each in below if each.size(MANIFEST) is not None]
    if not found:
        raise StoreError(f"{store.place} holds no release, nor do the folders in it; check the URL")
    return found


def _facts(release: Release) -> dict[str, Any]:
    manifest = release.manifest
    return {
        "url": release.place,
        "name": manifest.name,
        "version": manifest.version,
        "subsets": len(manifest.subsets),
        "episodes": sum(record.episodes for record in manifest.subsets),
        "digest": release.digest,
    }
