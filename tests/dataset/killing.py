"""A process that is killed before or after its n-th write to any store: every file operation is a place to die."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from dmcvb_gen.storage.store import Store

WRITES = ("create", "replace", "delete", "download")


class Killed(BaseException):
    """The process is dead; nothing may catch it."""


def die(monkeypatch: pytest.MonkeyPatch, at: int | None = None, after: bool = False) -> list[str]:
    """Let this process die at a write of `Store`.

    Args:
      at: number of the write to die at, from 0; None never dies. All later ones die as well.
      after: die after the write instead of before.

    Returns:
      The paths of the writes so far.
    """
    writes: list[str] = []

    def dying(write: Callable) -> Callable:
        def wrapped(store: Store, path: str, *given, **more):
            number = len(writes)
            writes.append(path)
            if at is not None and (number > at or (number == at and not after)):
                raise Killed(path)
            result = write(store, path, *given, **more)
            if number == at:
                raise Killed(path)
            return result

        return wrapped

    for name in WRITES:
        monkeypatch.setattr(Store, name, dying(getattr(Store, name)))
    return writes
