"""What disks, networks, clients and codecs raise becomes one line that names the cure, in this one place."""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.extras import PACKAGES
from dmcvb_gen.storage.places import is_url, shown

CLIENTS = frozenset(
    "adlfs aiobotocore aiohttp asyncio azure botocore fsspec gcsfs google httpcore httpx httpx2 huggingface_hub "
    "requests s3fs ssl urllib3".split()
)
"""Packages whose exceptions come from a network or a disk."""
DECODERS = frozenset(("numcodecs", "zarr"))
"""Packages whose exceptions come from damaged bytes."""
REFUSALS = (
    "Credential",
    "AccessDenied",
    "Forbidden",
    "InvalidAccessKeyId",
    "SignatureDoesNotMatch",
    "Unauthorized",
    "RepositoryNotFound",
)
"""Words of errors that are about who is asking; the last is what the Hub says of private repositories."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LONGEST_REASON = 300
_SECRETS = (
    # Bounded, or a message that quotes 100,000 letters of a file would take a minute.
    (
        re.compile(r"(?i)((?:secret|password|token|key|sig|signature|credential)[\w-]{0,40}[\"']?\s*[=:]\s*)\S+"),
        r"\1...",
    ),
    (re.compile(r"([A-Za-z][\w+.-]{0,20}://)[^/\s@]*@"), r"\1"),
)
"""What of a message is struck out, and what stands for it."""


class Refused(StoreError):
    """Who asks may not read or write there."""


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
    except (DmcvbError, MemoryError):
        raise
    except Exception as error:
        package = type(error).__module__.split(".")[0]
        if not (decoding or package in CLIENTS | DECODERS or isinstance(error, OSError | ImportError)):
            raise
        kind = Refused if isinstance(error, PermissionError) else StoreError
        client = package in CLIENTS or isinstance(error.__cause__, OSError)
        if isinstance(error, TypeError) and "unexpected keyword argument" in str(error) and is_url(str(place)):
            raise StoreError(f"{reason(error)}: the file system of {shown(str(place))} has no such --option") from None
        raise kind(_explained(error, str(place), doing, client)) from None


def reason(error: BaseException) -> str:
    """One line of an error for a person, with anything that looks like a secret struck out."""
    text = "".join(char if char.isprintable() else " " for char in str(error))
    text = " ".join(text.split()) or type(error).__name__
    for pattern, instead in _SECRETS:
        text = pattern.sub(instead, text)
    return text[:LONGEST_REASON]


def _explained(error: Exception, place: str, doing: str, client: bool) -> str:
    """Explain what went wrong at a place, and name the cure."""
    url, why, where = is_url(place), reason(error), shown(place)
    if isinstance(error, ImportError):
        package = (error.name or why).split(".")[0]
        lacks = "not installed" if isinstance(error, ModuleNotFoundError) else f"too old ({why})"
        return f"{package} is needed for {where} and {lacks}: pip install -U {PACKAGES.get(package, package)}"
    if not isinstance(error, OSError):
        if client:
            return _not_reached(error, where, doing)
        return f"{where} is damaged ({why.split('. ')[0]}); repair it with `dmcvb-gen regenerate`, or fetch it again"
    failed = error.filename2 or error.filename  # of a renaming the new name, else e.g. a file of a scratch folder
    if not url and isinstance(failed, str) and os.path.isabs(failed):
        where = failed
    if error.errno in NO_ROOM:
        return f"no room to {doing} {where} ({error.strerror}); make room and rerun the same command"
    if not url and (file := next((str(path) for path in Path(where).parents if path.is_file()), None)):
        return f"cannot {doing} {where}: {file} is a file; choose another place"
    if isinstance(error, IsADirectoryError):
        return f"cannot {doing} {where}: it is a folder; name a file"
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        there = "create the bucket first" if url else "create the folder first, or choose another place"
        cure = "check the path, or fetch or regenerate it" if doing == "read" else there
        return f"cannot {doing} {where}: it is not there ({why}); {cure}"
    if url:
        return _not_reached(error, where, doing)
    cure = "change its rights" if doing == "read" else "choose a place that you may write to"
    return f"cannot {doing} {where}: {error.strerror or why}; {cure}"


def _not_reached(error: Exception, where: str, doing: str) -> str:
    why = reason(error)
    if isinstance(error, PermissionError) or any(word in f"{type(error).__name__} {error}" for word in REFUSALS):
        return (
            f"{where} refuses access ({why}); set valid credentials in the environment or the provider's own "
            "configuration (e.g. AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, gcloud, HF_TOKEN)"
        )
    return f"cannot {doing} {where} ({why}); check the URL and the network, and rerun the command"
