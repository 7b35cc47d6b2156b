"""Compiled code that cannot be kept on disk is compiled again; it stops nothing."""

import errno

import numba
import pytest
from numba.core import caching

from dmcvb_gen.kept import kept_njit


def double(number):
    return number * 2


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


FAULTS = {
    "no folder": (caching.CompileResultCacheImpl, "_locator_classes", []),
    "a full disk": (caching.IndexDataCacheFile, "save", full),
    "a folder that cannot be read": (caching.IndexDataCacheFile, "load", full),
}
DAMAGE = {"nbi": b"", "nbc": b"\x80\x05cut"}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_cache_that_fails_stops_nothing(monkeypatch, tmp_path, fault):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))  # which has nothing of an earlier run
    monkeypatch.setattr(*FAULTS[fault])
    assert kept_njit(nogil=True)(double)(21) == 42
    if fault != "a folder that cannot be read":
        with pytest.raises((RuntimeError, OSError)):  # what numba itself does
            numba.njit(cache=True)(double)(2)


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_file_is_made_again(monkeypatch, tmp_path, kind):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert kept_njit(nogil=True)(double)(21) == 42
    [kept] = tmp_path.rglob(f"*.{kind}")
    whole = kept.read_bytes()
    kept.write_bytes(DAMAGE[kind])
    assert kept_njit(nogil=True)(double)(21) == 42
    again = kept_njit(nogil=True)(double)
    assert again(21) == 42 and again.stats.cache_hits and kept.stat().st_size == len(whole)
