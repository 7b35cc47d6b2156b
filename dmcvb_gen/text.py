"""Format numbers and names for messages."""

from __future__ import annotations

import shlex
import unicodedata
from collections.abc import Iterable
from pathlib import Path


def pluralize(count: int, noun: str) -> str:
    """A number with its noun, which is given in the plural: 1, "shards" -> "1 shard"; 1200 -> "1,200 shards"."""
    return f"{count:,} {noun.removesuffix('s') if count == 1 else noun}"


def quoted(place: str | Path) -> str:
    """A path or URL as a shell takes it: in quotes if it needs them."""
    return shlex.quote(str(place))


def as_names(value: str | Path | Iterable | None) -> tuple[str, ...]:
    """No name, one or several, as several."""
    if value is None:
        return ()
    return (str(value),) if isinstance(value, str | Path) else tuple(map(str, value))


def format_bytes(count: float) -> str:
    """1536 -> "1.5 kB" (powers of 1000)."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if abs(count) < 1000 or unit == "TB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    raise AssertionError("unreachable")


def printable(text: str, line: str = "\n") -> str:
    """A text from another person as a terminal may print it: control characters, which it would obey, become "?".

    Args:
      line: what a line break becomes.
    """
    kept = {"\n": line, "\t": " "}
    return "".join(kept.get(c, "?") if unicodedata.category(c)[0] == "C" else c for c in text)
