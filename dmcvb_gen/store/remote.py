"""Places outside: a URL in, its file system out; errors that say what to install, and never show a secret."""

from __future__ import annotations

import re
from typing import Any

import fsspec

from dmcvb_gen.errors import StoreError

EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gs", "gcs": "gs", "hf": "hf"}
"""Protocol -> the extra of dmcvb-gen that brings its file system."""


def is_url(path: str) -> bool:
    """Whether a path is a URL rather than a folder ("file:..." counts as a URL)."""
    return "://" in path or path.startswith("file:")


def public(url: str) -> str:
    """A URL without user, password, query and fragment, fit for logs and manifests."""
    bare = re.sub(r"[?#].*$", "", url)
    return re.sub(r"^([A-Za-z][\w+.-]*://)[^/@]*@", r"\1", bare)


def file_system(url: str, options: dict[str, Any] | None = None) -> tuple[fsspec.AbstractFileSystem, str]:
    """The file system of a URL, and the path in it.

    Args:
      options: passed to fsspec, e.g. {"endpoint_url": ..., "key": ..., "secret": ...} for S3.

    Raises:
      StoreError: its protocol is unknown or not installed (says which extra to install).
    """
    protocol = url.split(":", 1)[0]
    try:
        filesystem, base = fsspec.core.url_to_fs(url, **(options or {}))
    except ImportError as error:
        extra = EXTRAS.get(protocol)
        cure = f'pip install "dmcvb-gen[{extra}]"' if extra else str(error)
        raise StoreError(f"{protocol}:// needs a package that is not installed: {cure}") from None
    except ValueError as error:
        raise StoreError(
            f"cannot use {public(url)} ({error}); give file:, s3://, gs://, hf:// or another fsspec URL"
        ) from None
    return filesystem, base.rstrip("/")


def reason(error: BaseException) -> str:
    """One line of an error for a person, with anything that looks like a secret struck out."""
    text = " ".join(str(error).split()) or type(error).__name__
    text = re.sub(r"(?i)((?:secret|password|token|key|signature|credential)[\w-]*[\"']?\s*[=:]\s*)\S+", r"\1...", text)
    text = re.sub(r"([A-Za-z][\w+.-]*://)[^/\s@]*@", r"\1", text)
    return text[:300]
