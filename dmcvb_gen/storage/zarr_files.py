"""Files of a store as Zarr reads them: recorded keys come whole or raise, other keys are absent without a request."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Iterable, Mapping
from typing import Protocol

from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store, SuffixByteRequest
from zarr.core.buffer import Buffer, BufferPrototype

from dmcvb_gen.errors import StoreError


class Recorded(Protocol):
    """Size and SHA-256 (hex) of a file, as a record has them."""

    @property
    def bytes(self) -> int: ...
    @property
    def sha256(self) -> str: ...


class Files(Protocol):
    """What a store has of it."""

    @property
    def place(self) -> str: ...

    def read_range(self, path: str, start: int, length: int) -> bytes: ...


class ZarrFiles(Store):
    """A read-only Zarr store, see `dmcvb_gen.storage.interface.Store.zarr_store`."""

    supports_writes = supports_deletes = False
    supports_listing = True

    def __init__(self, store: Files, prefix: str, files: Mapping[str, Recorded]):
        super().__init__(read_only=True)
        self.store, self.prefix, self.files = store, prefix.strip("/"), files

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ZarrFiles)
            and (self.store, self.prefix) == (other.store, other.prefix)
            and self.files == other.files
        )

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        file = self.files.get(key)
        if file is None:
            return None
        start, end = _range(byte_range, file.bytes)
        path = f"{self.prefix}/{key}" if self.prefix else key
        data = await asyncio.to_thread(self.store.read_range, path, start, end - start)
        if len(data) == file.bytes and hashlib.sha256(data).hexdigest() != file.sha256:
            raise StoreError(
                f"{self.store.place}/{path} is damaged: it does not have its SHA-256; regenerate or fetch it"
            )
        return prototype.buffer.from_bytes(data)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        return list(await asyncio.gather(*(self.get(key, prototype, part) for key, part in key_ranges)))

    async def exists(self, key: str) -> bool:
        return key in self.files

    async def set(self, key: str, value: Buffer) -> None:
        raise ValueError("a release is never changed")

    async def delete(self, key: str) -> None:
        raise ValueError("a release is never changed")

    async def list(self) -> AsyncIterator[str]:
        for key in self.files:
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        for key in self.files:
            if key.startswith(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        folder = f"{prefix.strip('/')}/".lstrip("/")
        for name in {key[len(folder) :].split("/")[0] for key in self.files if key.startswith(folder)}:
            yield name


def _range(part: ByteRequest | None, size: int) -> tuple[int, int]:
    """First byte and the one after the last, within a file of `size` bytes."""
    match part:
        case RangeByteRequest(start, end):
            return min(start, size), min(end, size)
        case OffsetByteRequest(offset):
            return min(offset, size), size
        case SuffixByteRequest(suffix):
            return max(size - suffix, 0), size
    return 0, size
