"""A store that is killed before or after its n-th write: every file operation of a process is a place to die."""

from __future__ import annotations

from pathlib import Path

from dmcvb_gen.storage.store import ANY, Store


class Killed(BaseException):
    """The process is dead; nothing may catch it."""


class KillingStore(Store):
    """Another store, whose writes are counted.

    Args:
      store: takes the writes.
      at: number of the write to die at, from 0; None never dies.
      after: die after the write instead of before.
    """

    def __init__(self, store: Store, at: int | None = None, after: bool = False):
        self.store, self.at, self.after, self.writes = store, at, after, []
        self.folder = store.folder

    @property
    def place(self) -> str:
        return self.store.place

    def _write(self, path: str, act):
        number = len(self.writes)
        self.writes.append(path)
        if number == self.at and not self.after:
            raise Killed(path)
        result = act()
        if number == self.at:
            raise Killed(path)
        return result

    def create(self, path: str, data: bytes | Path, move: bool = False) -> bool:
        return self._write(path, lambda: self.store.create(path, data, move))

    def replace(self, path: str, data: bytes, expected: str | None = ANY) -> bool:
        return self._write(path, lambda: self.store.replace(path, data, expected))

    def delete(self, path: str) -> None:
        self._write(path, lambda: self.store.delete(path))

    def _read(self, path: str, start: int, length: int) -> bytes:
        return self.store._read(path, start, length)

    def _size(self, path: str) -> int:
        return self.store._size(path)

    def _list(self, prefix: str):
        return self.store._list(prefix)

    def _version(self, path: str) -> str:
        return self.store._version(path)
