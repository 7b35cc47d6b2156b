"""Report how much of a release is done, from its commit records alone: shards, rates, and the time that is left."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.dataset.manifest import MANIFEST, commit_path, shard_count
from dmcvb_gen.dataset.shards import chosen_shards
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.jobs import make_jobs
from dmcvb_gen.generate.target import Target

RECENT = 3600.0
"""Seconds before the last commit whose commits tell the rate; pauses before them do not count."""


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
      done, total: shards.
      late: shards that are not there although a job that was handed out later is through: in flight, or lost.
      steps: transitions committed.
      steps_per_second: rate of the last hour in which something was committed; None before the second commit.
      silence: seconds since the last commit; None before the first.
      seconds_left: time left at that rate; None if it is not known.
      complete: True if the release is finished.
    """

    name: str
    subsets: tuple[SubsetProgress, ...]
    steps: int
    steps_per_second: float | None
    silence: float | None
    seconds_left: float | None
    complete: bool

    done = property(lambda self: sum(subset.done for subset in self.subsets))
    late = property(lambda self: sum(subset.late for subset in self.subsets))
    total = property(lambda self: sum(subset.total for subset in self.subsets))

    def facts(self) -> dict[str, Any]:
        """Return the progress as plain values."""
        return dataclasses.asdict(self) | {"done": self.done, "late": self.late, "total": self.total}


def progress_of(target: Target) -> ReleaseProgress:
    """Return the progress of the release at a target.

    Raises:
      StoreError: there is none.
    """
    manifest = target.manifest()
    if manifest is None:
        raise StoreError(f"{target.place} holds no release (no {MANIFEST}); give the place that `rollout --out` made")
    commits = target.commits(manifest.subsets)
    listed = target.storage.list()
    late = dict.fromkeys((record.name for record in manifest.subsets), 0)
    jobs = make_jobs(manifest, chosen_shards(manifest), target)
    missing = [[r.name for r in job.subsets if job.shard not in commits.get(r.name, {})] for job in jobs]
    through = [number for number, names in enumerate(missing) if not names]
    for names in missing[: through[-1] if through else 0]:
        for name in names:
            late[name] += 1
    times, steps = [], []
    for name, shards in commits.items():
        for shard, commit in shards.items():
            at = listed.get(commit_path(name, shard))
            if at is not None and at.time is not None:
                times.append(at.time)
                steps.append(commit.steps)
    rate = _rate(np.array(times), np.array(steps))
    subsets = tuple(
        SubsetProgress(record.name, len(commits.get(record.name, ())), late[record.name], shard_count(record))
        for record in manifest.subsets
    )
    done, total = sum(subset.done for subset in subsets), sum(subset.total for subset in subsets)
    left = (total - done) * (sum(steps) / max(done, 1)) / rate if rate else None
    silence = max(0.0, time.time() - max(times)) if times else None
    return ReleaseProgress(manifest.name, subsets, int(sum(steps)), rate, silence, left, manifest.complete)


def _rate(times: np.ndarray, steps: np.ndarray) -> float | None:
    """Steps a second, between the first and the last of the recent commits (the first one's own time is not known)."""
    if len(times) < 2:
        return None
    recent = times >= times.max() - RECENT
    first = times[recent].min()
    span = times.max() - first
    return float(steps[recent & (times > first)].sum() / span) if span > 0 else None
