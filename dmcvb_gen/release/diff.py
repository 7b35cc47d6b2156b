"""Compare two releases: subsets, episodes, and what made their layers; no data are read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import Layer, SubsetRecord, shortened
from dmcvb_gen.storage.places import is_url


@dataclass(frozen=True)
class Difference:
    """One difference: the subset or layer it is in ("" for the release), and what it is, in words."""

    subset: str
    message: str

    def __str__(self) -> str:
        return f"{self.subset}: {self.message}" if self.subset else self.message


def diff(one: str | Path, other: str | Path, options: dict | None = None) -> list[Difference]:
    """List what differs between two releases, by manifests, lists and records alone.

    Args:
      one, other: folders or URLs.
      options: options of the storage client, for URLs.

    Raises:
      StoreError: one of them is no release, or cannot be read; options without a URL.
    """
    given = [options if is_url(place) or not (is_url(one) or is_url(other)) else None for place in (one, other)]
    a, b = Release.open(one, given[0]), Release.open(other, given[1])
    return [*_releases(a, b), *_subsets(a, b), *_layers(a, b)]


def _releases(a: Release, b: Release) -> Iterator[Difference]:
    for field in ("name", "version", "license", "authors"):
        one, other = getattr(a.manifest, field), getattr(b.manifest, field)
        if one != other:
            yield Difference("", f"{field}: {shortened(one)} and {shortened(other)}")
    if a.digest != b.digest:
        yield Difference("", f"digest: {a.digest} and {b.digest}")


def _subsets(a: Release, b: Release) -> Iterator[Difference]:
    mine, theirs = ({record.name: record for record in release.manifest.subsets} for release in (a, b))
    for name in dict.fromkeys((*mine, *theirs)):
        if name not in mine or name not in theirs:
            yield Difference(name, f"only in the {'first' if name in mine else 'second'}")
            continue
        for field in SubsetRecord.model_fields:
            one, other = getattr(mine[name], field), getattr(theirs[name], field)
            if field != "layers" and one != other:
                yield Difference(name, f"{field}: {shortened(one)} and {shortened(other)}")
        here = [len(release.subsets[name]) if name in release.subsets else 0 for release in (a, b)]
        if here[0] != here[1]:
            yield Difference(name, f"local episodes: {here[0]} and {here[1]}")


def _layers(a: Release, b: Release) -> Iterator[Difference]:
    """Layers of common subsets that only one has, and shards of common layers that have other bytes."""
    names = {record.name for record in a.manifest.subsets} & {record.name for record in b.manifest.subsets}
    records = [record for release in (a, b) for record in release.manifest.subsets if record.name in names]
    for name in dict.fromkeys(layer for record in records for layer in record.layers):
        if name not in a.layers or name not in b.layers:
            yield Difference(name, f"only in the {'first' if name in a.layers else 'second'}")
        else:
            yield from _shards(a, b, a.layers[name], b.layers[name])


def _shards(a: Release, b: Release, one: Layer, other: Layer) -> Iterator[Difference]:
    if one.key != other.key:
        fields = [n for n in ("rows", "episodes_per_shard", "arrays") if getattr(one, n) != getattr(other, n)]
        fields += sorted(key for key in {*one.makes, *other.makes} if one.makes.get(key) != other.makes.get(key))
        yield Difference(one.name, f"made in another way: {', '.join(fields) or 'what lies below it'}")
    if one.episodes_per_shard != other.episodes_per_shard or not (a.here(one.name) and b.here(one.name)):
        return
    mine, theirs = a.records(one.name), b.records(one.name)
    arrays: dict[str, list[str]] = {}
    for number in sorted(mine.keys() & theirs.keys()):
        files, span = (mine[number].files, theirs[number].files), one.episodes_of(number)
        for array in sorted({*files[0], *files[1]}):
            if files[0].get(array) != files[1].get(array):
                arrays.setdefault(array, []).append(f"{span.start}:{span.stop}")
    for array, spans in arrays.items():
        yield Difference(one.name, f"{array} has other bytes in the episodes {shortened(', '.join(spans))}")
