"""Which shards of a release are meant: a manifest and what was asked for in, shards out."""

from __future__ import annotations

from collections.abc import Sequence

from dmcvb_gen.dataset.manifest import Manifest, SubsetRecord, shard_count, shard_episodes
from dmcvb_gen.errors import StoreError
from dmcvb_gen.names import select

ShardKey = tuple[str, int]
"""(subset, shard)."""


def chosen_shards(
    manifest: Manifest, only: Sequence[str] = (), episodes: tuple[int, int] | None = None
) -> dict[ShardKey, SubsetRecord]:
    """The shards that hold any of the chosen episodes.

    Args:
      only: subset patterns such as "walker-walk/*/static", all subsets by default.
      episodes: (first, last + 1), all by default.

    Raises:
      UnknownNameError: a pattern that fits nothing.
      StoreError: no subset has such episodes.
    """
    names = set(select([record.name for record in manifest.subsets], list(only)))
    chosen = {}
    for record in manifest.subsets:
        for shard in range(shard_count(record)) if record.name in names else ():
            first, last = shard_episodes(record, shard)
            if episodes is None or (first < episodes[1] and episodes[0] < last):
                chosen[record.name, shard] = record
    if not chosen:
        most = max((record.episodes for record in manifest.subsets), default=0)
        first, last = episodes or (0, most)
        raise StoreError(f"no subset has episodes {first}:{last}; the longest has 0:{most}")
    return chosen
