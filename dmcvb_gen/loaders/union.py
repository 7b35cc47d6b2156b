"""A union of subsets that differ in level, read as one: "walker-walk/medium-expert/none" as D4RL and V-D4RL name it.

Episodes are numbered through: those of the second part come after all episodes that the first one will have.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NoReturn, Self

import numpy as np

from dmcvb_gen.dataset.gate import Release, Shard
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.loaders.arrays import ComputedArray, JoinedArray
from dmcvb_gen.loaders.release import SubsetReader

ALIKE = "task setting size views hidden_goal fixed_goals max_steps action_repeat renderer backgrounds".split()
"""Fields of their records in which the parts of a union are equal."""


class UnionReader(SubsetReader):
    """Subsets of one task and setting, read as one.

    Attributes:
      parts: the subsets, in the order in which they were named.
    """

    def __init__(self, release: Release, parts: Sequence[SubsetReader]):
        if len(parts) < 2:
            raise DmcvbError(f"{len(parts)} subsets are given; name two or more")
        records = [part.record for part in parts]
        for field in ALIKE:
            for record in records[1:]:
                if getattr(record, field) != getattr(records[0], field):
                    names = f"{records[0].name} and {record.name}"
                    raise DmcvbError(f"{names} differ in {field}; unite subsets that are alike in it")
        if len({part.goal_seed for part in parts}) > 1:
            raise DmcvbError(f"{', '.join(record.name for record in records)} differ in the seed of their goals")
        level = "-".join(record.level for record in records)
        facts = {
            "name": f"{records[0].name.split('/')[0]}/{level}/{records[0].setting}",
            "level": level,
            "episodes": sum(record.episodes for record in records),
            "layers": tuple(dict.fromkeys(name for record in records for name in record.layers)),
            "policies": tuple(policy for record in records for policy in record.policies),
        }
        super().__init__(release, records[0].model_copy(update=facts))
        self.parts, self.fresh = tuple(parts), any(part.fresh for part in parts)
        self._starts = np.cumsum([0, *(record.episodes for record in records[:-1])])

    def set_epoch(self, epoch: int) -> None:
        super().set_epoch(epoch)
        for part in self.parts:
            part.set_epoch(epoch)

    @property
    def arrays(self) -> tuple[str, ...]:
        return tuple(sorted(set.intersection(*(set(part.arrays) for part in self.parts))))

    def part(self, episodes: Iterable[int]) -> Self:
        chosen = super().part(episodes)
        places = np.searchsorted(self._starts, chosen.episodes, "right") - 1
        own = chosen.episodes - self._starts[places]
        chosen.parts = tuple(part.part(own[places == place]) for place, part in enumerate(self.parts))
        return chosen

    def array(self, name: str) -> Any:
        if name == "behaviour":  # counts the policies of all parts; -1 for random actions
            return ComputedArray(name, (self.record.episodes,), np.dtype(np.int16), ("episode",), self._behaviour)
        return JoinedArray([part.array(name) for part in self.parts], self._starts)

    def _behaviour(self, episode: int, _: tuple) -> np.ndarray:
        place = int(np.searchsorted(self._starts, episode, "right")) - 1
        before = sum(len(part.record.policies) for part in self.parts[:place])
        own = self.parts[place].array("behaviour")[episode - int(self._starts[place])] + before
        return own if self.parts[place].record.policies else np.full_like(own, -1)

    @property
    def unpainted(self) -> np.ndarray:
        """(episode of the union,) bool: episodes without images."""
        return np.concatenate([part.unpainted for part in self.parts])

    @functools.cached_property
    def _episodes(self) -> np.ndarray:
        return np.concatenate([part.episodes + start for part, start in zip(self.parts, self._starts, strict=True)])

    def shards(self, episodes: tuple[int, int] | None = None) -> Iterator[Shard]:
        for part, start in zip(self.parts, self._starts, strict=True):
            first, last = episodes or (0, self.record.episodes)
            yield from part.shards((first - int(start), last - int(start)))

    def paired(self, *settings: str) -> NoReturn:
        raise DmcvbError(f"{self.name} is a union; pair its parts: [part.paired(...) for part in subset.parts]")
