"""Releases at web servers, to read: bodies are taken up to what was asked for, whatever their headers claim."""

from __future__ import annotations

import contextlib
import functools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.interface import PIECE, Store

TIMEOUT = (10, 60)
"""Seconds to connect, and between two packets."""
CONNECTIONS = 32
TRIES = 3
"""Further tries of a request that got no answer, or one that says to try again."""


@dataclass(frozen=True)
class HttpStore(Store):
    """Files below a URL.

    Attributes:
      url: without login and query.
      login: (user, password). query: added to each request. headers: sent with each request.
    """

    url: str
    login: tuple[str, str] | None = field(default=None, repr=False)
    query: str = field(default="", repr=False)
    headers: Mapping[str, str] = field(default_factory=dict, repr=False, hash=False)

    writable = False

    @property
    def place(self) -> str:
        return self.url

    def _secrets(self) -> Sequence[str]:
        values = [*self.headers.values(), *(self.login or ()), self.query]
        return [value for value in values if len(value) > 3]

    def _url(self, path: str) -> str:
        return f"{self.url}/{quote(path)}" + (f"?{self.query}" if self.query else "")

    @contextlib.contextmanager
    def _request(self, path: str, method: str = "GET", part: str = "") -> Iterator[Any]:
        """The answer to a request, its body still unread. Raises FileNotFoundError, PermissionError or OSError."""
        headers = {"Accept-Encoding": "identity", **self.headers, **({"Range": f"bytes={part}"} if part else {})}
        # A function as `auth` keeps requests from taking another login out of ~/.netrc.
        auth = self.login or (lambda request: request)
        given: dict[str, Any] = {"headers": headers, "auth": auth, "timeout": TIMEOUT}
        session = _session(os.getpid())
        with session.request(method, self._url(path), stream=True, allow_redirects=True, **given) as answer:
            if answer.status_code in (404, 410):
                raise FileNotFoundError(path)
            if answer.status_code in (401, 403):
                raise PermissionError(f"HTTP {answer.status_code}")
            if answer.status_code not in (200, 206):
                raise OSError(f"HTTP {answer.status_code}")
            yield answer

    def _read(self, path: str, start: int, length: int) -> bytes:
        with self._request(path, part=f"{start}-{start + length - 1}") as answer:
            if answer.status_code == 206:
                claimed = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
                if not claimed or int(claimed[1]) != start:
                    raise OSError("the server sent another part of the file than it was asked for")
            elif start:
                raise StoreError(
                    f"the server of {self.place} does not serve parts of files; fetch the release first: "
                    "dmcvb-gen fetch URL --out FOLDER"
                )
            body = b"".join(_body(answer, length + 1))
        if len(body) > length and answer.status_code == 206:
            raise OSError("the server sent more bytes than it was asked for")
        return body[:length]

    def _pieces(self, path: str, limit: int) -> Iterator[bytes]:
        with self._request(path) as answer:
            if answer.status_code != 200:
                raise OSError("the server sent a part of the file instead of all of it")
            yield from _body(answer, limit)

    def _size(self, path: str) -> int:
        with self._request(path, "HEAD") as answer:
            size = answer.headers.get("Content-Length", "")
        if not size.isdecimal():
            raise StoreError(f"the server of {self.place} does not say how large {path} is; fetch the release first")
        return int(size)


def _body(answer: Any, limit: int) -> Iterator[bytes]:
    """At most `limit` bytes of an answer, piece by piece; none of them is decompressed."""
    while limit > 0 and (piece := answer.raw.read(min(PIECE, limit), decode_content=False)):
        limit -= len(piece)
        yield piece


@functools.lru_cache(maxsize=1)
def _session(process: int) -> Any:
    """Connections of a process; a fork makes its own."""
    import requests
    from requests.adapters import HTTPAdapter, Retry

    again = Retry(TRIES, backoff_factor=0.2, status_forcelist=(429, 500, 502, 503, 504), raise_on_status=False)
    session = requests.Session()
    for scheme in ("http://", "https://"):
        session.mount(scheme, HTTPAdapter(pool_maxsize=CONNECTIONS, max_retries=again))
    return session
