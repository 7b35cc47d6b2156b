"""Object stores and whatever else fsspec reaches: S3, Google, Azure, HTTP, SFTP, memory."""

from __future__ import annotations

import base64
import contextlib
import datetime
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fsspec

from dmcvb_gen.storage.base import Digested, Storage, StoredFile
from dmcvb_gen.storage.remote import BUCKET_PROTOCOLS, file_system, public

PART = 50 * 2**20
"""Bytes of a part of an S3 multipart upload (decides its ETag)."""


@dataclass(frozen=True)
class ObjectStorage(Storage):
    """Files at a URL of fsspec.

    Attributes:
      options: options of fsspec, as sorted pairs; they may hold secrets.
    """

    url: str = field(repr=False)
    options: tuple[tuple[str, Any], ...] = field(default=(), repr=False)

    @property
    def place(self) -> str:
        return public(self.url).rstrip("/")

    @property
    def protocol(self) -> str:
        return self.url.split(":", 1)[0]

    @property
    def lists_sizes(self) -> bool:  # lists of web servers are pages without sizes, or none
        return self.protocol not in ("http", "https")

    def _open(self, path: str) -> tuple[fsspec.AbstractFileSystem, str]:
        filesystem, base = file_system(self.url, dict(self.options))
        return filesystem, f"{base}/{path}"

    def _at_new(self, path: str) -> tuple[fsspec.AbstractFileSystem, str]:
        """The file system and a path of it whose folder is there."""
        filesystem, full = self._open(path)
        if self.protocol not in (*BUCKET_PROTOCOLS, "s3a"):  # which have no folders
            filesystem.makedirs(full.rsplit("/", 1)[0], exist_ok=True)
        return filesystem, full

    def _read(self, path: str, start: int | None = None, end: int | None = None) -> bytes:
        filesystem, full = self._open(path)
        if start is None:
            filesystem.invalidate_cache()
        return filesystem.cat_file(full, start=start, end=end)

    def _write(self, path: str, data: bytes) -> None:
        filesystem, full = self._at_new(path)
        filesystem.pipe_file(full, data)

    def _create(self, path: str, data: bytes) -> None:
        filesystem, full = self._at_new(path)
        try:
            filesystem.pipe_file(full, data, mode="create")
        except Exception as error:
            filesystem.invalidate_cache()
            if "PreconditionFailed" in f"{type(error).__name__} {error}" or "condition" in str(error):
                raise FileExistsError(path) from None
            raise

    def _remove(self, path: str) -> None:
        filesystem, full = self._open(path)
        filesystem.rm_file(full)

    def _list(self) -> dict[str, StoredFile]:
        filesystem, base = self._open("")
        filesystem.invalidate_cache()
        found = filesystem.find(base.rstrip("/"), detail=True)
        return {path[len(base) :]: StoredFile(facts.get("size"), _time_of(facts)) for path, facts in found.items()}

    def _size(self, path: str) -> int | None:
        return self._facts(path).get("size")

    def _facts(self, path: str) -> dict[str, Any]:
        filesystem, full = self._open(path)
        filesystem.invalidate_cache(full.rsplit("/", 1)[0])
        return filesystem.info(full)

    def _send(self, local: Path, path: str) -> None:
        filesystem, full = self._at_new(path)
        filesystem.put_file(str(local), full, **({"chunksize": PART} if self.protocol in ("s3", "s3a") else {}))

    def _same(self, file: Digested, local: Path) -> bool:
        """By the store's own MD5, else by reading it back."""
        facts = self._facts(file.path)
        etag = str(facts.get("ETag", "")).strip('"')
        if etag and etag in _etags(local):
            return True
        if "md5Hash" in facts:
            return base64.b64decode(facts["md5Hash"]).hex() in _etags(local)
        return super()._same(file, local)


def _etags(path: Path) -> set[str]:
    """ETags that S3 may give a file: its MD5, or the MD5 of its parts' MD5s."""
    whole, parts = hashlib.md5(usedforsecurity=False), []
    with path.open("rb") as file:
        while piece := file.read(PART):
            whole.update(piece)
            parts.append(hashlib.md5(piece, usedforsecurity=False).digest())
    joined = hashlib.md5(b"".join(parts), usedforsecurity=False).hexdigest()
    return {whole.hexdigest(), f"{joined}-{len(parts)}"}


def _time_of(facts: Mapping[str, Any]) -> float | None:
    """When a file was written, by whatever name a file system of fsspec says it."""
    for name in ("LastModified", "mtime", "updated", "last_modified", "created"):
        value = facts.get(name)
        if isinstance(value, str):
            with contextlib.suppress(ValueError):
                value = datetime.datetime.fromisoformat(value)
        if isinstance(value, datetime.datetime):
            return value.timestamp()
        if isinstance(value, int | float):
            return float(value)
    return None
