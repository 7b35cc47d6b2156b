"""A release in, all files that its manifest names out, in the order in which they are written."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from dmcvb_gen.dataset.gate import Release, read_recipes
from dmcvb_gen.dataset.manifest import (
    ATTACHMENT_FILES,
    CARD_FOLDER,
    COPY,
    LAYERS,
    MANIFEST,
    MANIFEST_BYTES,
    MANIFESTS,
    PROVENANCE,
    RECIPES,
    RECORDS,
    FileRecord,
    LayerList,
    ListedLayer,
    Manifest,
    Resolved,
    canonical_json,
    file_of,
    is_attachment,
    list_path,
)
from dmcvb_gen.dataset.writer import PROVENANCE_BYTES, check_agree
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.store import Store

ATTACHMENTS = (*ATTACHMENT_FILES, f"{CARD_FOLDER}contact_sheet.png", f"{CARD_FOLDER}episodes.parquet")
"""Files that are copied with a release as they are; no digest covers them."""
BOOKS = (RECORDS, LAYERS, MANIFESTS, PROVENANCE)
"""Folders of what a release says of its shards and its history; nothing else lies there."""
TABLE_BYTES, ATTACHMENT_BYTES, NOTES = 2**30, 2**26, 100
"""The largest table of episodes, the largest of the others, and the number of notes of provenance that go along."""


def described_files(release: Release, names: Collection[str]) -> tuple[FileRecord, ...]:
    """What comes before the shards of subsets: their policies and videos, and all recipes.

    Raises:
      StoreError: a recipe is missing or was altered.
    """
    recipes = [file_of(f"{RECIPES}{recipe.sha256}.json", canonical_json(recipe)) for recipe in release.recipes]
    return (*release.inputs_of(names), *recipes)


def list_files(release: Release, layers: Collection[str]) -> tuple[FileRecord, ...]:
    """The lists of layers, of a finished release; images that only this copy has are in no list yet."""
    found = {}
    for name in layers:
        if isinstance(layer := release.layers[name], ListedLayer):
            records = release.records(name)
            text = canonical_json(LayerList(shards=tuple(records[number] for number in sorted(records))))
            found[layer.list] = file_of(list_path(layer.list), text)
    return tuple(found.values())


def attachments(store: Store) -> Iterator[tuple[str, bytes]]:
    """Paths and bytes of the attachments that are there, and of the notes of who made the release."""
    try:
        notes = [path for path, size in store.list(PROVENANCE).items() if size <= PROVENANCE_BYTES][:NOTES]
    except StoreError:  # a web server gives no lists
        notes = []
    for path in (*ATTACHMENTS, *notes):
        data = store.find(path, TABLE_BYTES if path.endswith(".parquet") else ATTACHMENT_BYTES)
        if data is not None:
            yield path, data


def grows_from(new: Release, old: Release) -> bool:
    """Return True if every shard that an older release of the same name or recipes has is one of the newer, too."""
    if not isinstance(old.manifest, Manifest) or not isinstance(new.manifest, Manifest):
        return False
    if old.manifest.name != new.manifest.name and not {*old.manifest.recipes} <= {*new.manifest.recipes}:
        return False  # the name is that of the newest recipe
    for name, layer in old.layers.items():
        if name not in new.layers or new.layers[name].key != layer.key:
            return False
        records = new.records(name)
        if any(records.get(shard.number) != shard.record for shard in old.layer_shards(name)):
            return False
    episodes = {record.name: record.episodes for record in new.manifest.subsets}
    return all(record.episodes <= episodes.get(record.name, 0) for record in old.manifest.subsets)


def manifest_at(store: Store, release: Release) -> bytes | None:
    """Return the manifest at a destination: of this release, or of an older one that it has grown from.

    Returns:
      None if nothing is there, or what an interrupted try has left.

    Raises:
      StoreError: something else is there.
    """
    text, copy = store.find(MANIFEST, MANIFEST_BYTES), Release.read_copy(store)
    if copy is not None and copy.manifest == release.digest:
        return text  # an interrupted try may have left the older one
    if text is not None:
        there = Release.open(store, own_images=False)
        if there.digest == release.digest or grows_from(release, there):
            return text
        raise StoreError(
            f"{store.place} already holds {_named(there)} and not {_named(release)}, and a release never changes; "
            "choose another place (a changed byte is a new version)"
        )
    ours = {COPY, *(f"{RECIPES}{recipe.sha256}.json" for recipe in (*release.recipes, *_older_recipes(store, release)))}
    ours |= {file.path for file in release.manifest.inputs}
    folders = (*BOOKS, *(f"{layer.group}/" for layer in release.layers.values()))
    found = list(store.list())
    others = [path for path in found if path not in ours and not path.startswith(folders)]
    if len(others) < len(found) or not store.writable:  # a try began, or a new repository on the Hub has a README
        others = [path for path in others if not is_attachment(path)]
    if others:
        more = f" and {len(others) - 1} more" if others[1:] else ""
        raise StoreError(f"{store.place} holds {others[0]}{more}, and not this release; choose an empty destination")
    return None


def _older_recipes(store: Store, release: Release) -> list[Resolved]:
    """Recipes at a place that an older version of a release may have left there, in an interrupted try."""
    older = [recipe for recipe in read_recipes(store) if recipe.name == release.manifest.name]
    try:
        check_agree([*older, *release.recipes])
    except StoreError:
        return []
    return older


def check_apart(release: Release, target: Store, cure: str) -> None:
    """Raises StoreError if a destination is the folder of a release, or lies in it."""
    source, folder = release.store.folder, target.folder
    if source and folder and folder.resolve().is_relative_to(source.resolve()):
        raise StoreError(f"{folder} is the release itself, or in its folder; {cure}")


def _named(release: Release) -> str:
    return f"{release.manifest.name} {release.manifest.version} ({str(release.digest)[:12]})"
