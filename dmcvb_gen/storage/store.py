"""Open the store at a folder or URL: `open_store(place)` gives a `Store`, see `dmcvb_gen.storage.interface`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.storage.interface import ANY, NotThere, Store
from dmcvb_gen.storage.places import WEB, Place, unpinned

TAKEN = {"hf": ("endpoint", "token"), **dict.fromkeys(WEB, ("headers",))}
"""Options that places take, but for buckets, whose file systems know theirs."""

__all__ = ["ANY", "NotThere", "Store", "open_store"]


def open_store(place: str | Path, options: Mapping[str, Any] | None = None) -> Store:
    """The store at a folder or URL; nothing is read or made there.

    Args:
      place: a folder, file:, s3://, gs://, az://, http(s):// or hf://datasets/OWNER/NAME. `~` is the home folder; all
        other characters are plain ones.
      options: of the bucket's file system in fsspec (endpoint_url, key, ...), of http "headers", of hf "token" and
        "endpoint".

    Raises:
      StoreError: it is no such place, its package is missing, or it takes no such options.
    """
    if (whole := unpinned(place)) != str(place):
        raise StoreError(f"{place}: this command takes the newest version; leave out what follows {whole}")
    parsed = Place.parse(place)
    if parsed.protocol == "file":
        from dmcvb_gen.storage.folder import LocalStore

        if options:
            raise StoreError(f"--option has no effect: {parsed} is a folder, not a URL; remove it")
        return LocalStore(Path(parsed.path))
    for name in options or ():
        if name not in TAKEN.get(parsed.protocol, [name]):
            raise UnknownNameError(f"option of {parsed.protocol}", name, TAKEN[parsed.protocol])
    if parsed.protocol == "hf":
        from dmcvb_gen.storage.hugging_face import HubStore

        return HubStore.at(parsed, options or {})
    if parsed.protocol in WEB:
        from dmcvb_gen.storage.web import HttpStore

        headers = (options or {}).get("headers", {})
        if not isinstance(headers, Mapping):
            raise StoreError("headers are a dictionary, which only storage_options in Python can give")
        return HttpStore(str(parsed), parsed.login, parsed.query, dict(headers))
    from dmcvb_gen.storage.bucket import ObjectStore

    return ObjectStore(parsed.protocol, parsed.path, options or {})
