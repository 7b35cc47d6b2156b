"""Find the file system of a folder or URL, and turn its errors into one line that names the cure.

`storage_errors` is the one place that turns errors of disks, networks, credentials, missing packages and damaged
bytes into a `StoreError`; it never shows a secret. Whatever touches storage runs inside it::

    with storage_errors(path, "read"):
        ...
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import errno
import functools
import logging
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import fsspec

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.storage.places import is_url
from dmcvb_gen.storage.places import shown as public

PACKAGES = {"s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "hf": "huggingface_hub", "http": "aiohttp"}
PACKAGES |= {"https": "aiohttp", "az": "adlfs", "abfs": "adlfs"}
"""Protocol -> the package on PyPI that brings its file system."""
CLIENTS = (
    "aiobotocore aiohttp asyncio botocore fsspec gcsfs google httpcore httpx huggingface_hub requests s3fs ssl "
    "urllib3 zarr numcodecs azure adlfs"
).split()
"""Packages whose exceptions come from storage."""
REFUSALS = ("Credential", "AccessDenied", "Forbidden", "InvalidAccessKeyId", "SignatureDoesNotMatch", "Unauthorized")
"""Words of errors that are about who is asking."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


BUCKET_PROTOCOLS = ("s3", "gs", "gcs", "az", "abfs", "hf")


def check_no_options(folder: str | Path, options: Mapping[str, Any] | None) -> None:
    """Raises StoreError for options of a file system, which have no effect on a folder."""
    if options:
        raise StoreError(f"--option has no effect: {folder} is a folder, not a URL; remove it")


_ONE_SLASH = re.compile(r"([A-Za-z][\w+.-]+):/")


def check_place(place: str) -> None:
    """Refuse a URL with a slash too few, which would silently name a folder "s3:".

    Raises:
      StoreError: it is one.
    """
    if not is_url(place) and (found := _ONE_SLASH.match(place)):
        meant = public(f"{found[1]}://{place[found.end() :]}")
        raise StoreError(f"{public(place)} is neither a folder nor a URL; did you mean {meant}?")


def local_path(path: str | Path) -> Path:
    """A folder or file here, to be written to: what takes no URLs checks its `out` with this.

    Raises:
      StoreError: it is a URL; a `Path` would silently make a folder "s3:".
    """
    if is_url(str(path)) or (isinstance(path, Path) and _ONE_SLASH.match(str(path))):  # `Path` makes s3:/x of s3://x
        raise StoreError(
            f"{public(str(path))} is a URL; give a local one, a folder or file of this machine (`dmcvb-gen publish "
            "FOLDER URL` puts a release at a URL)"
        )
    check_place(str(path))
    return Path(path)


def file_system(url: str, options: dict[str, Any] | None = None) -> tuple[fsspec.AbstractFileSystem, str]:
    """The file system of a URL, and the path in it.

    Args:
      options: passed to fsspec, e.g. {"endpoint_url": ..., "key": ..., "secret": ...} for S3.

    Raises:
      StoreError: its protocol is unknown or not installed (says which extra to install), or it names no bucket.
    """
    protocol = url.split(":", 1)[0]
    try:
        filesystem, base = fsspec.core.url_to_fs(url, **(options or {}))
    except ImportError as error:
        package = PACKAGES.get(protocol)
        cure = f"pip install {package}" if package else str(error)
        raise StoreError(f"{protocol}:// needs a package that is not installed: {cure}") from None
    except ValueError as error:
        raise StoreError(
            f"cannot use {public(url)} ({error}); give file:, s3://, gs://, hf:// or another fsspec URL"
        ) from None
    base = base.rstrip("/")
    if protocol in BUCKET_PROTOCOLS and not base:
        raise StoreError(f"{public(url)} names no bucket; give {protocol}://BUCKET/NAME")
    return filesystem, base


_SECRETS = (
    # Bounded, or a message that quotes 100,000 letters of somebody's file would take a minute.
    (
        re.compile(r"(?i)((?:secret|password|token|key|signature|credential)[\w-]{0,40}[\"']?\s*[=:]\s*)\S+"),
        r"\1...",
    ),
    (re.compile(r"([A-Za-z][\w+.-]{0,20}://)[^/\s@]*@"), r"\1"),
)
"""What of a message is struck out, and what stands for it."""


def reason(error: BaseException) -> str:
    """One line of an error for a person, with anything that looks like a secret struck out."""
    text = " ".join(str(error).split()) or type(error).__name__
    for pattern, shown in _SECRETS:
        text = pattern.sub(shown, text)
    return text[:300]


def is_refusal(error: BaseException) -> bool:
    """Return True if an error is about permissions, so that trying again does not help."""
    words = f"{type(error).__name__} {error}"
    return isinstance(error, PermissionError) or any(word in words for word in REFUSALS)


def refused(place: str, error: BaseException) -> StoreError:
    """The error for missing or wrong credentials."""
    return StoreError(
        f"{place} refuses access ({reason(error)}); set valid credentials in the environment or the provider's own "
        "configuration (e.g. AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, gcloud, HF_TOKEN)"
    )


def _explained(error: BaseException, place: str, doing: str) -> str:
    """Explain what went wrong at a location, and name the cure."""
    remote, writing = is_url(place), doing != "read"
    if isinstance(error, ImportError):
        name = error.name or reason(error)
        return f"{name.split('.')[0]} is needed for {place} and not installed: pip install {name.split('.')[0]}"
    number = error.errno if isinstance(error, OSError) else None
    if isinstance(error, OSError) and number in NO_ROOM:
        return f"no room to {doing} {place} ({error.strerror}); make room and rerun the same command"
    if writing and not remote and isinstance(error, OSError):
        return f"cannot {doing} {place}: {error.strerror or reason(error)}; choose a place that you may write to"
    if isinstance(error, FileNotFoundError | NotADirectoryError | IsADirectoryError) or "NotFound" in _kind(error):
        there = "create the bucket first" if remote else "create the folder first, or choose another place"
        cure = there if writing else "check the path, or fetch or regenerate it"
        return f"cannot {doing} {place}: it is not there ({reason(error)}); {cure}"
    if not remote and isinstance(error, PermissionError):
        return f"cannot {doing} {place}: {error.strerror or reason(error)}; change its rights"
    if remote and (isinstance(error, OSError | asyncio.TimeoutError) or _kind(error).split(".")[0] in CLIENTS):
        return f"cannot {doing} {place} ({reason(error)}); check the URL and the network, and rerun the command"
    if isinstance(error, OSError):
        return f"cannot {doing} {place}: {error.strerror or reason(error)}"
    _end_quietly()
    if not _serves_parts(place):
        return without_parts(place)
    why = reason(error).split(". ")[0]
    return f"{place} is damaged ({why}); repair it with `dmcvb-gen regenerate`, or fetch it again"


def without_parts(place: str) -> str:
    """Say that a web server answers with whole files if it is asked for parts, as `python -m http.server` does."""
    return (
        f"the server of {place} does not serve parts of files; fetch the release first: dmcvb-gen fetch URL --out "
        "FOLDER"
    )


def _serves_parts(place: str) -> bool:
    """Return False if a web server gives the whole metadata of an array or group at `place` for its first byte."""
    if not place.startswith(("http://", "https://")):
        return True
    with contextlib.suppress(Exception):  # it is asked only to explain an error, without the options of the first one
        filesystem, base = file_system(place)
        return len(filesystem.cat_file(f"{base}/zarr.json", start=0, end=1)) <= 1
    return True


@functools.cache
def _end_quietly() -> None:
    """Hide what the end of the process says of the reads that Zarr gave up after one that failed."""
    atexit.register(_hide_unfinished)


def _hide_unfinished() -> None:
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    sys.unraisablehook = lambda *_: None


def _kind(error: BaseException) -> str:
    return f"{type(error).__module__}.{type(error).__name__}"


@contextlib.contextmanager
def storage_errors(place: str | Path, doing: str = "read", decoding: bool = False) -> Iterator[None]:
    """Turn what storage raises inside into one line with a cure; other exceptions pass.

    Args:
      place: folder, file or URL that is read or written.
      doing: "read", "write to", ...: the word of the message.
      decoding: nothing but storage is at work inside, so that whatever is raised (codecs raise anything) comes from
        damaged bytes.

    Raises:
      StoreError: for errors of disk, network, credentials, missing packages, or damaged bytes.
    """
    try:
        yield
    except DmcvbError:
        raise
    except Exception as error:
        shown = public(str(place)) if is_url(str(place)) else str(place)
        if not (decoding or isinstance(error, OSError | ImportError) or _kind(error).split(".")[0] in CLIENTS):
            raise
        if is_url(shown) and is_refusal(error):
            raise refused(shown, error) from None
        raise StoreError(_explained(error, shown, doing)) from None
