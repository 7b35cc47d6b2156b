"""Merge the manifest of a release with that of a new request, or say why they cannot be one release.

A release takes in other subsets, and more episodes of those that it has. What is there stays as it is, byte for byte;
the manifest keeps each recipe with the version that it made and what it added.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.manifest import MANIFEST, Manifest, SubsetRecord, VersionEntry, parse_manifest
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.remote import storage_errors

GROWS = ("digest", "episodes", "episodes_per_shard")
"""Fields of a subset's record in which the one that is asked for may differ from the one that is there."""
RECIPE_FIELDS = ("seed", "trajectories")
"""Fields of a recipe that decide the episodes of a subset."""


def taken_up(root: Path, asked: Manifest) -> Manifest:
    """The manifest of a release's folder once it holds what is asked for too; nothing is written.

    Raises:
      StoreError: what is there contradicts what is asked for.
    """
    path = root / MANIFEST
    if not path.is_file():
        return asked
    with storage_errors(path):
        return merged(parse_manifest(path.read_bytes(), str(path)), asked, str(root))


def merged(old: Manifest, asked: Manifest, place: str) -> Manifest:
    """Add to `old` what only `asked` has; return `old` itself if that is nothing.

    Raises:
      StoreError: a subset is there in another form, or cannot grow.
    """
    known = asked.recipe in (old.recipe, *(addition.recipe for addition in old.additions))
    records = {record.name: record for record in old.subsets}
    added: dict[str, tuple[int, int]] = {}
    for record in asked.subsets:
        there = records.get(record.name)
        if there is None:
            _check_same_policies(old, record, place)
            added[record.name] = (0, record.episodes)
            records[record.name] = record
            continue
        _check_same(old, there, asked, record, place)
        if record.episodes > there.episodes:
            _check_can_grow(there, record, place)
            added[record.name] = (there.episodes, record.episodes)
            records[record.name] = there.model_copy(update={"episodes": record.episodes, "digest": None})
        elif record.episodes < there.episodes and not known:
            raise StoreError(
                f"{place} holds {there.episodes} episodes of {there.name}, asked for {record.episodes}, and a release "
                f"never shrinks; ask for {there.episodes} or more, or choose another --out"
            )
    if not added:
        return old
    version = asked.version if _parts(asked.version) > _parts(old.version) else next_version(old.version)
    addition = VersionEntry(version=version, recipe=asked.recipe, generator=asked.generator, subsets=added)
    facts = {"version": version, "subsets": tuple(records.values()), "complete": False, "digest": None}
    return old.model_copy(update=facts | {"additions": (*old.additions, addition)})


def _check_same(old: Manifest, there: SubsetRecord, asked: Manifest, record: SubsetRecord, place: str) -> None:
    def refuse(field: str, one: Any, other: Any):
        raise StoreError(
            f"{place} holds {there.name} with {field} {_short(one)}, asked for {_short(other)}; leave it as it is, or "
            "choose another --out"
        )

    for field in RECIPE_FIELDS:
        one, other = old.recipe_of(there.name).get(field), asked.recipe_of(record.name).get(field)
        if one != other:
            refuse(field, one, other)
    for field in SubsetRecord.model_fields:
        one, other = _value(there, field), _value(record, field)
        painted_since = field == "pixels" and there.pixels  # begun without pictures, and painted: it stays painted
        if field not in GROWS and one != other and not painted_since:
            refuse(field, one, other)


def _value(record: SubsetRecord, field: str) -> Any:
    """The value of a field in comparisons; of policies name, digest and path, as headers may lack local paths."""
    if field == "policies":
        return tuple((policy.name, policy.digest, policy.path) for policy in record.policies)
    return getattr(record, field)


def _check_same_policies(old: Manifest, record: SubsetRecord, place: str) -> None:
    """Refuse a new subset whose task and level are there already, of other policies."""
    for there in old.subsets:
        if (there.task, there.level) == (record.task, record.level):
            one, other = (" ".join(policy.name for policy in each.policies) for each in (there, record))
            if _value(there, "policies") != _value(record, "policies"):
                raise StoreError(
                    f"{place} holds {there.name} of {_short(one)}, asked for {record.name} of {_short(other)}, and a "
                    "release has one behaviour for each task and level; choose another --out"
                )


def _check_can_grow(there: SubsetRecord, record: SubsetRecord, place: str) -> None:
    if there.fixed_goals:
        raise StoreError(
            f"{place} holds {there.name} with {there.episodes} episodes of {there.fixed_goals} fixed goals, and their "
            "number does not grow; choose another --out"
        )
    rest = there.episodes % there.episodes_per_shard
    if rest:
        raise StoreError(
            f"{place} holds {there.episodes} episodes of {there.name} and cannot grow to {record.episodes}: the last "
            f"shard has {rest} of {there.episodes_per_shard} episodes and stays as it is; choose another --out"
        )


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 80 else text[:77] + "..."


def _parts(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)]


def next_version(version: str) -> str:
    """ "1.0.0" -> "1.1.0": data were added, none changed."""
    parts = [*_parts(version), 0, 0][:2]
    return f"{parts[0]}.{parts[1] + 1}.0"


def is_grown_from(new: Manifest, old: Manifest) -> bool:
    """Return True if a release holds all that an older one has, in the same form."""
    if new.name != old.name or _parts(new.version) <= _parts(old.version):
        return False
    records = {record.name: record for record in new.subsets}
    for before in old.subsets:
        now = records.get(before.name)
        if now is None or now.episodes < before.episodes:
            return False
        if any(_value(before, f) != _value(now, f) for f in SubsetRecord.model_fields if f not in GROWS):
            return False
        if before.episodes_per_shard != now.episodes_per_shard:
            return False
    return True
