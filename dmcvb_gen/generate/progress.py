"""Report how much of a release is done, from its records alone: shards, and the time that is left."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.generate.works import works_of

RECENT = 3600.0
"""Seconds before the last record whose records tell the rate; pauses before them do not count."""


@dataclass(frozen=True)
class SubsetProgress:
    """Shards of one subset: done, late (later ones are done), and all."""

    name: str
    done: int
    late: int
    total: int


@dataclass(frozen=True)
class ReleaseProgress:
    """Progress of a release.

    Attributes:
      done, total: shards of subsets; one is done if all its layers are.
      late: shards that are not there although one that was handed out later is: in progress, or lost.
      shards_per_hour: rate of the last hour in which something was finished; None if it is not known.
      silence: seconds since the last record; None if it is not known.
      seconds_left: time left at that rate; None if it is not known.
      complete: True if the manifest names all that was asked for.
    """

    name: str
    subsets: tuple[SubsetProgress, ...]
    shards_per_hour: float | None
    silence: float | None
    seconds_left: float | None
    complete: bool

    done = property(lambda self: sum(subset.done for subset in self.subsets))
    late = property(lambda self: sum(subset.late for subset in self.subsets))
    total = property(lambda self: sum(subset.total for subset in self.subsets))

    def facts(self) -> dict[str, Any]:
        """Return the progress as plain values."""
        return dataclasses.asdict(self) | {"done": self.done, "late": self.late, "total": self.total}


def progress_of(store: Any) -> ReleaseProgress:
    """Return the progress of the release at a store.

    Raises:
      StoreError: there is none.
    """
    asked = Release.in_making(store)
    works = works_of(asked, wanted=lambda layer, shard: True)
    missing = [
        [s.record.name for s in work.settings if not {work.trajectories.name, *s.record.layers} <= work.known.keys()]
        for work in works
    ]
    through = [number for number, names in enumerate(missing) if not names]
    total, done, late = ({record.name: 0 for record in asked.manifest.subsets} for _ in range(3))
    for number, (work, lacking) in enumerate(zip(works, missing, strict=True)):
        for name in (setting.record.name for setting in work.settings):
            total[name] += 1
            done[name] += name not in lacking
            late[name] += name in lacking and number < (through[-1] if through else 0)
    subsets = tuple(SubsetProgress(name, done[name], late[name], total[name]) for name in total)
    times = _times(asked)
    rate = _rate(times)
    open_ = sum(total.values()) - sum(done.values())
    finished = Release.open(store)
    there = {} if finished.in_the_making else {record.name: record.episodes for record in finished.manifest.subsets}
    complete = not open_ and there == {record.name: record.episodes for record in asked.manifest.subsets}
    silence = max(0.0, time.time() - float(times.max())) if len(times) else None
    left = open_ / rate * 3600 if rate else None
    return ReleaseProgress(asked.manifest.name, subsets, rate, silence, left, complete)


def _times(release: Release) -> np.ndarray:
    """When the records of trajectories were written, if the release is in a folder."""
    if release.store.folder is None:
        return np.zeros(0)
    names = [name for name, layer in release.layers.items() if layer.kind == "trajectories"]
    paths = [release.store.folder / record_path(name, n) for name in names for n in release.records(name)]
    return np.array([path.stat().st_mtime for path in paths])


def _rate(times: np.ndarray) -> float | None:
    """Shards an hour, between the first and the last of the recent records (the first one's own time is not known)."""
    if len(times) < 2:
        return None
    recent = times[times >= times.max() - RECENT]
    span = recent.max() - recent.min()
    return float((len(recent) - 1) / span * 3600) if span > 0 else None
