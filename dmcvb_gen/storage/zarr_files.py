"""Files of a store as Zarr reads them: recorded keys come whole or raise, other keys are absent without a request."""

from __future__ import annotations

import asyncio
import hashlib
import logging
from collections.abc import Iterable, Mapping
from typing import Any

from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store, SuffixByteRequest
from zarr.core.buffer import Buffer, BufferPrototype

from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.interface import Store as Files


class ZarrFiles(Store):
    """The files below a folder of a store for Zarr, to read.

    Args:
      files: key below `prefix` -> its record (`bytes`, `sha256`). Other keys are absent without a request; one of these
        that is not there, or has other bytes, is an error, never zeros.
    """

    supports_writes = supports_deletes = supports_listing = False

    def __init__(self, store: Files, prefix: str, files: Mapping[str, Any]):
        super().__init__(read_only=True)
        self.store, self.prefix, self.files = store, prefix.strip("/"), files

    def __eq__(self, other: object) -> bool:
        mine = (self.store, self.prefix, self.files)
        return isinstance(other, ZarrFiles) and mine == (other.store, other.prefix, other.files)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        file = self.files.get(key)
        if file is None:
            return None
        start, end = _range(byte_range, file.bytes)
        path = f"{self.prefix}/{key}" if self.prefix else key
        data = await asyncio.to_thread(self.store.read_range, path, start, end - start)
        if len(data) == file.bytes and hashlib.sha256(data).hexdigest() != file.sha256:
            # After an error, asyncio would print each of Zarr's other reads as a task that was destroyed.
            logging.getLogger("asyncio").setLevel(logging.CRITICAL)
            raise StoreError(
                f"{self.store.place}/{path} is damaged: it does not have its SHA-256; regenerate it, or fetch it with "
                "--repair"
            )
        return prototype.buffer.from_bytes(data)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        return list(await asyncio.gather(*(self.get(key, prototype, part) for key, part in key_ranges)))

    async def exists(self, key: str) -> bool:
        return key in self.files

    def _not_offered(self, *_: object) -> Any:
        raise NotImplementedError("arrays are read by their records alone")

    set = delete = list = list_prefix = list_dir = _not_offered  # type: ignore[assignment]


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
