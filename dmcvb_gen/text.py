"""Words of messages."""

from __future__ import annotations


def pluralize(count: int, noun: str) -> str:
    """A number with its noun, which is given in the plural: 1, "shards" -> "1 shard"; 1200 -> "1,200 shards"."""
    return f"{count:,} {noun.removesuffix('s') if count == 1 else noun}"
