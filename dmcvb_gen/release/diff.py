"""Compare two releases: subsets, episodes, digests, and what they were made with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dmcvb_gen.dataset import Release, Subset, open_release
from dmcvb_gen.dataset.manifest import CommitRecord, SubsetRecord, subset_path
from dmcvb_gen.dataset.pictures import picture_of
from dmcvb_gen.storage.remote import check_no_options, is_url
from dmcvb_gen.text import pluralize

SHOWN = 5
"""Shards named of a subset before the rest is counted."""


@dataclass(frozen=True)
class Difference:
    """One difference: the subset it is in ("" for the release), and what it is, in words."""

    subset: str
    message: str

    def __str__(self) -> str:
        return f"{self.subset}: {self.message}" if self.subset else self.message


def diff(one: str | Path, other: str | Path, options: dict | None = None) -> list[Difference]:
    """List what differs between two releases, by manifests and commit records alone.

    Args:
      one, other: folders or URLs.
      options: options of fsspec, for URLs.

    Raises:
      StoreError: one of them is no release, or cannot be read; options without a URL.
    """
    if not (is_url(one) or is_url(other)):
        check_no_options(one, options)
    a, b = (open_release(place, options if is_url(place) else None) for place in (one, other))
    return [*_releases(a, b), *(found for name in _names(a, b) for found in _subsets(a, b, name))]


def _names(a: Release, b: Release) -> list[str]:
    return list(dict.fromkeys(record.name for release in (a, b) for record in release.manifest.subsets))


def _releases(a: Release, b: Release) -> list[Difference]:
    found = []
    for field in ("name", "version", "license", "generator", "digest"):
        one, other = getattr(a.manifest, field), getattr(b.manifest, field)
        if one != other:
            found.append(Difference("", f"{field}: {one} and {other}"))
    return found


def _subsets(a: Release, b: Release, name: str) -> list[Difference]:
    records = [{r.name: r for r in release.manifest.subsets}.get(name) for release in (a, b)]
    for mine, side in zip(records, ("second", "first"), strict=True):
        if mine is None:
            return [Difference(name, f"only in the {side}")]
    found = []
    images = [record.pixels for record in records if record]
    if len(set(images)) == 2:
        found.append(Difference(name, f"only the {'first' if images[0] else 'second'} has images"))
    found += [
        Difference(name, f"{field}: {_short(getattr(records[0], field))} and {_short(getattr(records[1], field))}")
        for field in SubsetRecord.model_fields
        if field not in ("digest", "pixels") and getattr(records[0], field) != getattr(records[1], field)
    ]
    one, other = a.subsets.get(name), b.subsets.get(name)
    here = [len(subset.episodes) if subset else 0 for subset in (one, other)]
    if here[0] != here[1]:
        found.append(Difference(name, f"episodes that are there: {here[0]} and {here[1]}"))
    if one and other:
        found += _shards(one, other)
    return found


def _shards(one: Subset, other: Subset) -> list[Difference]:
    """Shards of the same episodes that have other bytes, and arrays that only one has."""
    mine = {commit.episodes: commit for commit in one.commits.values()}
    theirs = {commit.episodes: commit for commit in other.commits.values()}
    found = []
    alone = sorted(mine.keys() ^ theirs.keys())
    if alone and len(one.episodes) == len(other.episodes):  # else their number has been said
        found.append(Difference(one.name, f"only one has shards of the episodes {_spans(alone)}"))
    arrays: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for episodes in sorted(mine.keys() & theirs.keys()):
        files = [_digests(mine[episodes]), _digests(theirs[episodes])]
        for array in sorted(files[0].keys() | files[1].keys()):
            digests = [side.get(array) for side in files]
            if digests[0] != digests[1]:
                kind = "has other bytes" if all(digests) else f"is only in the {'first' if digests[0] else 'second'},"
                arrays.setdefault((array, kind), []).append(episodes)
    for (array, kind), spans in arrays.items():
        if one.record.pixels != other.record.pixels and picture_of(array):
            continue  # which has images has been said
        found.append(Difference(one.name, f"{array} {kind} in the episodes {_spans(spans)}"))
    return found


def _spans(spans: Sequence[tuple[int, int]]) -> str:
    named = ", ".join(f"{first}:{last}" for first, last in spans[:SHOWN])
    return named + (f" and {pluralize(len(spans) - SHOWN, 'shards')} more" if len(spans) > SHOWN else "")


def _digests(commit: CommitRecord) -> dict[str, str]:
    """Path of an array in its group -> digest of its file."""
    start = len(subset_path(commit.subset)) + 1
    return {file.path[start:].split("/c/")[0]: file.sha256 for file in commit.files}


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 60 else text[:57] + "..."
