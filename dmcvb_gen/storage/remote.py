"""What the readers of format 2 call; it goes with them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import fsspec

from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import is_url
from dmcvb_gen.storage.places import shown as public

__all__ = ["check_no_options", "file_system", "is_url", "public", "storage_errors"]


def check_no_options(folder: str | Path, options: Mapping[str, Any] | None) -> None:
    if options:
        raise StoreError(f"--option has no effect: {folder} is a folder, not a URL; remove it")


def file_system(url: str, options: dict[str, Any] | None = None) -> tuple[fsspec.AbstractFileSystem, str]:
    return fsspec.core.url_to_fs(url, **(options or {}))
