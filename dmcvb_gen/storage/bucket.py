"""Object stores (S3, Google Cloud, Azure) through fsspec, with conditional writes."""

from __future__ import annotations

import contextlib
import errno
import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fsspec

from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.interface import ANY, Store
from dmcvb_gen.storage.places import BUCKETS

PLAIN_OPTIONS = ("endpoint_url", "region_name", "anon", "project", "account_name", "account_host")
"""Options that messages may show."""


@dataclass(frozen=True)
class ObjectStore(Store):
    """Objects below a prefix of a bucket.

    Attributes:
      protocol: "s3", "gs" or "az". base: bucket and prefix.
      options: of the file system in fsspec; they may hold secrets and nested mappings.
    """

    protocol: str
    base: str
    options: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)

    @property
    def place(self) -> str:
        return f"{self.protocol}://{self.base}"

    @property
    def _system(self) -> fsspec.AbstractFileSystem:
        """The file system; fsspec keeps it for this process alone, so that a fork gets its own."""
        importlib.import_module(BUCKETS[self.protocol])  # fsspec's own error does not name the package
        try:
            return fsspec.filesystem(self.protocol, use_listings_cache=False, **self.options)
        except TypeError as error:
            raise StoreError(f"{self.place} takes no such options ({error}); see the file system's own") from None

    def _full(self, path: str) -> str:
        return f"{self.base}/{path}".rstrip("/")

    def _secrets(self) -> Sequence[str]:
        return [text for name, value in self.options.items() if name not in PLAIN_OPTIONS for text in _texts(value)]

    # -- reading ----------------------------------------------------------------------------------

    def _read(self, path: str, start: int, length: int) -> bytes:
        try:
            return self._system.cat_file(self._full(path), start=start, end=start + length)[:length]
        except FileNotFoundError:
            raise
        except Exception:
            if self._size(path) <= start:  # no store has a range after the end
                return b""
            raise

    def _facts(self, path: str) -> Mapping[str, Any]:
        facts = self._system.info(self._full(path))
        if facts.get("type") == "directory":
            raise FileNotFoundError(path)
        return facts

    def _size(self, path: str) -> int:
        return self._facts(path)["size"]

    def _version(self, path: str) -> str:
        facts = self._facts(path)
        for name in ("generation", "ETag", "etag"):  # Google; S3; Azure
            if facts.get(name):
                return str(facts[name])
        raise StoreError(f"{self.place} does not name versions of objects (no ETag); use another store")

    def _list(self, prefix: str) -> Mapping[str, int]:
        found = self._system.find(self._full(prefix), detail=True)
        start = len(self.base.lstrip("/")) + 1
        # A console's "create folder" puts an empty object whose name ends in "/".
        return {path.lstrip("/")[start:]: facts["size"] for path, facts in found.items() if path[-1] != "/"}

    # -- writing ----------------------------------------------------------------------------------

    def _create(self, path: str, data: bytes | Path) -> None:
        self._put_new(path, data)
        if self.place not in _heeding:
            try:  # once more: a store that heeds If-None-Match refuses it
                self._put_new(path, data)
            except FileExistsError:
                _heeding.add(self.place)
            else:
                raise self._unsafe()

    def _put_new(self, path: str, data: bytes | Path) -> None:
        with self._conditions(path):
            if isinstance(data, Path):
                self._system.put_file(str(data), self._full(path), mode="create")
            else:
                self._system.pipe_file(self._full(path), data, mode="create")

    def _unsafe(self) -> StoreError:
        return StoreError(
            f"{self.place} does not support conditional writes (If-None-Match), so two writers could mix their files; "
            "use a store that does (AWS S3, Google, Azure, MinIO since 2024), or publish to a folder"
        )

    def _replace(self, path: str, data: bytes, expected: str | None) -> bool:
        try:
            with self._conditions(path):
                self._put_over(self._full(path), data, expected)
        except FileExistsError:
            return False
        except FileNotFoundError:
            if expected in (ANY, None):
                raise
            return False
        return True

    def _put_over(self, full: str, data: bytes, expected: str | None) -> None:
        """Put an object in place of a version of it, in the words of each store."""
        system = self._system
        if expected == ANY:
            system.pipe_file(full, data)
        elif expected is None:
            system.pipe_file(full, data, mode="create")
        elif self.protocol == "s3":
            system.pipe_file(full, data, IfMatch=expected)
        elif self.protocol == "az":
            conditions = importlib.import_module("azure.core").MatchConditions  # comes with adlfs
            system.pipe_file(full, data, etag=expected, match_condition=conditions.IfNotModified)
        else:
            bucket, key, _ = system.split_path(full)
            place = f"{system._location}/upload/storage/v1/b/{bucket}/o"
            given = {"uploadType": "media", "name": key, "ifGenerationMatch": expected, "data": data}
            system.call("POST", place, headers={"Content-Type": "application/octet-stream"}, **given)

    @contextlib.contextmanager
    def _conditions(self, path: str) -> Iterator[None]:
        """Turn a store's words for a condition that does not hold into FileExistsError."""
        try:
            yield
        except Exception as error:
            cause = error.__cause__ or error
            words = f"{type(error).__name__} {error} {type(cause).__name__} {cause}"
            if isinstance(error, OSError) and error.errno == errno.ENOSYS:
                raise self._unsafe() from None
            if any(word in words for word in ("PreconditionFailed", "ConditionNotMet", "ConditionalRequestConflict")):
                raise FileExistsError(path) from None
            raise

    def _delete(self, path: str) -> None:
        self._system.rm_file(self._full(path))


_heeding: set[str] = set()
"""Places that have refused to overwrite an object that was put with If-None-Match."""


def _texts(value: Any) -> Iterator[str]:
    """Every string in an option's value."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for part in value:
            yield from _texts(part)
    elif isinstance(value, str) and len(value) > 3:
        yield value
