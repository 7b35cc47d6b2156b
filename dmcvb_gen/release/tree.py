"""A release in, all files that its manifest names out, in the order in which they are written."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from dmcvb_gen.dataset.gate import Release, Shard
from dmcvb_gen.dataset.manifest import (
    ATTACHMENT_FILES,
    CARD_FOLDER,
    MANIFEST,
    MANIFEST_BYTES,
    PROVENANCE,
    RECIPES,
    FileRecord,
    LayerList,
    ListedLayer,
    Manifest,
    canonical_json,
    list_path,
)
from dmcvb_gen.dataset.writer import PROVENANCE_BYTES
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.storage.store import NotThere, Store

CARD = tuple(f"{CARD_FOLDER}{name}" for name in ("returns.png", "contact_sheet.png", "states.json", "episodes.parquet"))
ATTACHMENTS = (*ATTACHMENT_FILES, *CARD)
"""Files that are copied with a release as they are; no digest covers them."""
ATTACHMENT_BYTES, NOTES = 2**30, 100
"""The largest of them, and the number of notes of provenance that go with a release."""


@dataclass(frozen=True)
class Listed:
    """A file that a release names.

    Attributes:
      place: the layer that it belongs to, or its own path.
    """

    place: str
    file: FileRecord


def shard_files(shard: Shard) -> tuple[FileRecord, ...]:
    """Files of a shard, its record last."""
    return (*shard.files, _record_of(shard.record_path, canonical_json(shard.record)))


def layer_files(release: Release, name: str) -> Iterator[Listed]:
    """Files of the shards of a layer that are to be here.

    Raises:
      StoreError: the layer's list is missing or was altered.
    """
    layer, here = release.layers[name], release.here(name)
    if here:
        for number, record in sorted(release.records(name).items()):
            if number in here:
                shard = Shard(layer, number, record, True)
                yield from (Listed(name, file) for file in shard_files(shard))


def described_files(release: Release, names: Collection[str]) -> tuple[FileRecord, ...]:
    """What comes before the shards of subsets: their policies and videos, and all recipes.

    Raises:
      StoreError: a recipe is missing or was altered.
    """
    recipes = [_record_of(f"{RECIPES}{recipe.sha256}.json", canonical_json(recipe)) for recipe in release.recipes]
    return (*release.inputs_of(names), *recipes)


def list_files(release: Release, layers: Collection[str]) -> tuple[FileRecord, ...]:
    """The lists of layers, of a finished release; images that only this copy has are in no list yet."""
    found = {}
    for name in layers:
        if not isinstance(release.layers[name], ListedLayer):
            continue
        records = release.records(name)
        text = canonical_json(LayerList(shards=tuple(records[number] for number in sorted(records))))
        found[list_path(sha256_bytes(text))] = text
    return tuple(_record_of(path, text) for path, text in found.items())


def _record_of(path: str, text: bytes) -> FileRecord:
    return FileRecord(path=path, bytes=len(text), sha256=sha256_bytes(text))


def manifest_text(release: Release) -> bytes:
    """The bytes of the manifest of a finished release.

    Raises:
      StoreError: it was replaced since the release was opened.
    """
    text = release.store.read(MANIFEST, MANIFEST_BYTES)
    if sha256_bytes(text) != release.digest:
        raise StoreError(f"{release.place} was changed meanwhile; run the command again")
    return text


def attachments(store: Store) -> dict[str, bytes]:
    """Path -> bytes of the attachments that are there, and of the notes of who made the release."""
    found = {}
    try:
        notes = [path for path, size in store.list(PROVENANCE).items() if size <= PROVENANCE_BYTES][:NOTES]
    except StoreError:  # a web server gives no lists
        notes = []
    for path in (*ATTACHMENTS, *notes):
        try:
            found[path] = store.read(path, ATTACHMENT_BYTES)
        except NotThere:
            continue
    return found


def grows_from(new: Release, old: Release) -> bool:
    """Return True if every shard that an older release of that name has is one of the newer, too."""
    if old.manifest.name != new.manifest.name:
        return False
    for name, layer in old.layers.items():
        if name not in new.layers or new.layers[name].key != layer.key:
            return False
        records: Mapping = new.records(name)
        if any(records.get(number) != record for number, record in old.records(name).items()):
            return False
    episodes = {record.name: record.episodes for record in new.manifest.subsets}
    return isinstance(old.manifest, Manifest) and all(
        record.episodes <= episodes.get(record.name, 0) for record in old.manifest.subsets
    )
