"""Places of releases: a folder or URL comes in, its parts come out, with secrets in fields of their own."""

from __future__ import annotations

import errno
import re
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

from dmcvb_gen.errors import StoreError

BUCKETS = {"s3": "s3fs", "gs": "gcsfs", "az": "adlfs"}
"""Protocol of object stores -> the package on PyPI that reaches them."""
WEB = ("http", "https")
PINNED = re.compile(r"(?P<place>.+)@(?P<digest>sha256:.*|[0-9a-fA-F]{64})")
"""A place with the digest of the release that is meant."""
_SCHEME = re.compile(r"([A-Za-z][\w+.-]+):(/*)")
KNOWN = "a folder, file:, s3://, gs://, az://, http(s):// or hf://"


@dataclass(frozen=True)
class Place:
    """A folder or URL in its parts.

    Attributes:
      protocol: "file", "s3", "gs", "az", "http", "https" or "hf".
      path: the folder; of URLs bucket or host, and what follows, without a "/" at the end.
      login: (user, password) of a web server. query: of its URLs, with tokens.
    """

    protocol: str
    path: str
    login: tuple[str, str] | None = field(default=None, repr=False)
    query: str = field(default="", repr=False)

    @classmethod
    def parse(cls, place: str | Path) -> Place:
        """What a folder or URL names.

        Raises:
          StoreError: it is no folder and none of the URLs that can be read.
        """
        text = str(place)
        if not text or not text.isprintable():
            raise StoreError(f"{text[:80]!r} is no place; give {KNOWN}")
        if (found := _SCHEME.match(text)) is None:
            return cls("file", _folder(text))
        protocol, rest = found[1].lower(), text[found.end() :]
        if protocol in ("file", "local"):
            path = re.sub("^//(localhost(?=/))?", "", text[len(protocol) + 1 :])
            return cls("file", _folder(unquote(path) if found[2][:2] == "//" else path))
        if len(found[2]) != 2 and protocol in (*BUCKETS, *WEB, "hf", "s3a", "gcs", "abfs"):
            meant = f"{protocol}://{_without_login(rest)[0]}"
            raise StoreError(f"a URL of {protocol} needs two slashes; did you mean {shown(meant)}?")
        if not found[2] and "://" not in rest:
            return cls("file", _folder(text))  # a folder with a colon in its name
        if not found[2] or protocol not in (*BUCKETS, *WEB, "hf"):
            raise StoreError(f"{found[1]}:// is no place that releases can be at; give {KNOWN}")
        return cls._web(protocol, rest) if protocol in WEB else cls._bucket(protocol, rest)

    @classmethod
    def _web(cls, protocol: str, rest: str) -> Place:
        rest, login = _without_login(rest)
        path, _, query = rest.partition("?")
        if "#" in rest:
            raise StoreError(f"{protocol}://{path.partition('#')[0]}#... has a #; write it as %23, or remove it")
        if not path.split("/")[0]:
            raise StoreError(f"{protocol}:// names no server; give {protocol}://SERVER/PATH")
        user, _, password = login.partition(":")
        return cls(protocol, path.rstrip("/"), (unquote(user), unquote(password)) if login else None, query)

    @classmethod
    def _bucket(cls, protocol: str, rest: str) -> Place:
        bucket = rest.split("/")[0]
        if "@" in bucket or ":" in bucket:
            raise StoreError(
                f"{protocol}://{_without_login(rest)[0]} was given with credentials; set them in the environment or "
                "the provider's own configuration, and remove them from the URL"
            )
        if not bucket:
            raise StoreError(f"{protocol}:// names no bucket; give {protocol}://BUCKET/NAME")
        return cls(protocol, rest.rstrip("/"))

    def __str__(self) -> str:
        return self.path if self.protocol == "file" else f"{self.protocol}://{self.path}"


def is_url(place: str | Path) -> bool:
    """Return True for a URL, False for a folder of this machine ("file:..." counts as a URL)."""
    return "://" in str(place) or str(place).startswith("file:")


def shown(place: str | Path) -> str:
    """A folder or URL for messages: without user, password and a web server's query."""
    text = str(place)
    found = _SCHEME.match(text)
    if found is None or not found[2] or found[1].lower() in ("file", "local"):
        return text
    rest = _without_login(text[found.end() :])[0]
    return found[0] + (re.sub(r"[?#].*", "", rest) if found[1].lower() in WEB else rest)


def unpinned(place: str | Path) -> str:
    """A place without the digest that may stand behind it."""
    pinned = PINNED.fullmatch(str(place))
    return pinned["place"] if pinned else str(place)


def local_path(path: str | Path) -> Path:
    """A folder or file of this machine, to be written to.

    Raises:
      StoreError: it is a URL; a `Path` would silently make a folder "s3:".
    """
    text = str(path)
    if is_url(text) or re.match(rf"({'|'.join((*BUCKETS, *WEB, 'hf'))}):/", text):  # `Path` makes s3:/x of s3://x
        raise StoreError(
            f"{shown(text)} is a URL; give a local one, a folder or file of this machine (`dmcvb-gen publish "
            "FOLDER URL` puts a release at a URL)"
        )
    return Path(_folder(text))


def _without_login(rest: str) -> tuple[str, str]:
    """What follows "://" without "user:password@", and that; passwords may hold "@" and "/"."""
    first = rest.split("/")[0]
    end = -1
    if "@" in first:
        end = rest.rindex("@", 0, len(first))
    elif not re.fullmatch(r"[^:]*(:\d*)?|\[.*\](:\d*)?", first):  # no port follows the colon, but a password
        end = rest.rfind("@")
    return rest[end + 1 :], rest[: max(end, 0)]


def _folder(text: str) -> str:
    try:
        folder = Path(text).expanduser()
        if folder.is_symlink() and not folder.exists():
            raise StoreError(f"{text} is a link to nothing; remove it, or choose another place")
    except RuntimeError:
        raise StoreError(f"{text}: there is no home folder here; write the folder out") from None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise StoreError(f"{text[:80]}... is too long for a folder's name; choose another place") from None
    return str(folder)
