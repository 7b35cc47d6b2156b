"""Storage of releases: local folders, object stores and the Hugging Face Hub. Begin with `open_storage`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmcvb_gen.storage.base import Storage
from dmcvb_gen.storage.remote import check_no_options, check_place, file_system, is_url


def open_storage(place: str | Path, options: Mapping[str, Any] | None = None) -> Storage:
    """The storage at a folder or URL; nothing is read or made there.

    Args:
      options: options of fsspec, for a URL, e.g. {"endpoint_url": ...}.

    Raises:
      StoreError: the URL's protocol is unknown or not installed, or it names no bucket; options for a folder,
        which file: URLs name, too.
    """
    from dmcvb_gen.storage.local import LocalStorage
    from dmcvb_gen.storage.object_store import ObjectStorage

    url = str(place)
    if not is_url(url):
        check_place(url)
        check_no_options(url, options)
        return LocalStorage(Path(place))
    protocol, pairs = url.split(":", 1)[0], tuple(sorted((options or {}).items()))
    if protocol == "hf":
        from dmcvb_gen.storage.hub import HubStorage

        return HubStorage(url, pairs)
    if protocol in ("file", "local"):
        _, base = file_system(url)
        check_no_options(base, options)
        return LocalStorage(Path(base), url)
    file_system(url, dict(pairs))  # says now what is wrong with it
    return ObjectStorage(url, pairs)
