"""Format numbers and names for messages."""

from __future__ import annotations

from collections.abc import Iterable


def pluralize(count: int, noun: str) -> str:
    """A number with its noun, which is given in the plural: 1, "shards" -> "1 shard"; 1200 -> "1,200 shards"."""
    return f"{count:,} {noun.removesuffix('s') if count == 1 else noun}"


def as_names(value: str | Iterable) -> tuple[str, ...]:
    """One name or several, as several."""
    return (value,) if isinstance(value, str) else tuple(map(str, value))
