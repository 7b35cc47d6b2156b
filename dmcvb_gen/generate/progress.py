"""Report how much of a release is done, from its records alone."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass
from typing import Any

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.works import works_of


@dataclass(frozen=True)
class SubsetProgress:
    """Shards of one subset: those of which all layers are there, and all."""

    name: str
    done: int
    total: int


@dataclass(frozen=True)
class ReleaseProgress:
    """Progress of a release; it is complete if its manifest names all that was asked for."""

    name: str
    subsets: tuple[SubsetProgress, ...]
    complete: bool

    done = property(lambda self: sum(subset.done for subset in self.subsets))
    total = property(lambda self: sum(subset.total for subset in self.subsets))

    def facts(self) -> dict[str, Any]:
        """Return the progress as plain values."""
        return dataclasses.asdict(self) | {"done": self.done, "total": self.total}


def progress_of(store: Any) -> ReleaseProgress:
    """Return the progress of the release at a store.

    Raises:
      StoreError: there is none.
    """
    asked = Release.in_making(store)
    done: Counter[str] = Counter()
    total: Counter[str] = Counter()
    for work in works_of(asked, wanted=lambda layer, shard: True):
        for setting in work.settings:
            total[setting.record.name] += 1
            done[setting.record.name] += {work.trajectories.name, *setting.record.layers} <= work.known.keys()
    subsets = tuple(SubsetProgress(name, done[name], count) for name, count in total.items())
    return ReleaseProgress(asked.manifest.name, subsets, not missing_subsets(Release.open(store)))


def missing_subsets(release: Release) -> list[str]:
    """Subsets that recipes ask for, and that a release does not have, or not whole."""
    asked = {record.name: record.episodes for record in Release.in_making(release.store).manifest.subsets}
    there = {} if release.in_the_making else {record.name: record.episodes for record in release.manifest.subsets}
    return [name for name, episodes in asked.items() if there.get(name, 0) < episodes]
