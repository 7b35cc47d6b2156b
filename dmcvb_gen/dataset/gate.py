"""Open a release: the one gate through which everything that is read of it comes.

`Release.open` reads the manifest once, bounded, and compares its digest with one from outside if there is one. From
there on, lists are compared with the manifest and whole files with the lists as they are read (parts of files have
checksums alone), and nothing is read twice. A release in the making has no manifest yet, or an older one; it opens by
its recipes and records.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from dmcvb_gen.dataset.manifest import (
    COPY,
    COPY_BYTES,
    LAYERS,
    MANIFEST,
    MANIFEST_BYTES,
    MANIFESTS,
    MAX_SHARDS,
    RECIPE_BYTES,
    RECIPES,
    RECORDS,
    Copy,
    FileRecord,
    Layer,
    LayerList,
    ListedLayer,
    Manifest,
    Parsed,
    Resolved,
    ShardRecord,
    SubsetRecord,
    canonical_json,
    check_record,
    file_of,
    layer_order,
    list_bytes_limit,
    list_path,
    merged_layers,
    merged_subsets,
    parse,
    record_bytes_limit,
    record_path,
)
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.spec import select
from dmcvb_gen.storage.places import PINNED
from dmcvb_gen.storage.store import NotThere, Store, open_store
from dmcvb_gen.text import pluralize

READERS = 16
"""Small files of a bucket that are read at a time."""


@dataclass(frozen=True)
class Shard:
    """A shard of a layer that is listed: its record and its files.

    Attributes:
      here: False in a copy that lacks it.
    """

    layer: Layer
    number: int
    record: ShardRecord
    here: bool

    @property
    def episodes(self) -> range:
        return self.layer.episodes_of(self.number)

    @property
    def record_path(self) -> str:
        return record_path(self.layer.name, self.number)

    @property
    def files(self) -> tuple[FileRecord, ...]:
        """Its data files, with their paths in the release."""
        paths = {spec.name: self.layer.file_path(spec, self.number) for spec in self.layer.arrays}
        return tuple(file.at(paths[name]) for name, file in sorted(self.record.files.items()))

    @property
    def record_file(self) -> FileRecord:
        """The file that its record is in."""
        return file_of(self.record_path, canonical_json(self.record))


class Release:
    """A release, read-only.

    Attributes:
      store: where it lies.
      manifest: what it holds; of a release in the making, what its recipes ask for.
      digest: SHA-256 of the manifest's bytes; None while it is made.
      compared: whether the digest was compared with one from outside.
      copy: what it was copied from, None if it is no copy.
      manifest_path, text: where its manifest lies, in manifests/ if another one has replaced it; and its bytes.
    """

    manifest_path, text = MANIFEST, b""

    def __init__(
        self, store: Store, manifest: Manifest | Resolved, digest: str | None, compared: bool, copy: Copy | None
    ):
        self.store, self.manifest, self.digest, self.compared, self.copy = store, manifest, digest, compared, copy
        self._records: dict[str, dict[int, ShardRecord]] = {}
        self._here: dict[str, Collection[int]] = {}

    @classmethod
    def open(
        cls,
        place: str | Path | Store,
        options: Mapping[str, Any] | None = None,
        digest: str | None = None,
        own_images: bool = True,
    ) -> Self:
        """Open a release.

        Args:
          place: its folder or URL, or "<folder or URL>@sha256:<digest>".
          options: options of the storage client, for URLs.
          digest: SHA-256 of the manifest, from a source that you trust; one that was replaced can still be opened.
          own_images: False leaves images out that no manifest names, see `_with_own_images`.

        Raises:
          StoreError: there is no release, its manifest is damaged or has another digest.
        """
        if not isinstance(place, Store):
            if pinned := PINNED.fullmatch(str(place)):
                if digest is not None and _plain_digest(digest) != _plain_digest(pinned["digest"]):
                    raise StoreError(f"{place}: another digest is given, {digest}; give one of them")
                place, digest = pinned["place"], pinned["digest"]
            place = open_store(place, options)
        digest = None if digest is None else _plain_digest(digest)
        store, path = place, MANIFEST
        try:
            text = store.read(path, MANIFEST_BYTES)
        except NotThere:
            if digest is not None:
                raise StoreError(f"{store.place} has no manifest, so it is not release {digest[:12]}") from None
            return cls.in_making(store)
        found = sha256_bytes(text)
        if digest not in (None, found):
            path = f"{MANIFESTS}{digest}.json"
            text = store.find(path, MANIFEST_BYTES) or b""
            if text and sha256_bytes(text) != digest:
                raise StoreError(f"{store.place}/{path} was altered; fetch release {digest[:12]} again")
            if not text:
                raise StoreError(
                    f"{store.place} is release {found}, not {digest}: do not use it for the one that you meant"
                )
            found = digest
        manifest = parse(Manifest, text, f"{store.place}/{path}")
        copy = cls.read_copy(store)
        # A copy's manifest is replaced after copy.json; until then the older one, which is kept first, is the release.
        if copy is not None and copy.manifest != found and store.size(f"{MANIFESTS}{found}.json") is None:
            raise StoreError(
                f"{store.place} is a copy of release {copy.manifest[:12]}, its manifest is {found[:12]}; fetch again"
            )
        if own_images and path == MANIFEST and store.folder is not None:
            manifest = _with_own_images(store, manifest)
        # A part of a release says of what, but for a part that lies where it was published.
        compared = digest is not None or (copy is not None and copy.manifest == found and store.folder is not None)
        release = cls(store, manifest, found, compared, copy)
        release.manifest_path, release.text = path, text
        return release

    @classmethod
    def in_making(cls, store: Store) -> Self:
        """Open what recipes ask for, as far as it is made; for the process that goes on with it.

        Raises:
          StoreError: there is no recipe, or recipes contradict one another.
        """
        recipes = read_recipes(store)
        if not recipes:
            raise StoreError(
                f"{store.place} holds no release (no {MANIFEST}); give the folder that `rollout --out` made"
            )
        layers = merged_layers(recipes)
        subsets = merged_subsets(subset for recipe in recipes for subset in recipe.subsets)
        newest = recipes[-1]
        wanted = newest.model_copy(update={"layers": tuple(layers.values()), "subsets": tuple(subsets.values())})
        return cls(store, wanted, None, False, None)

    @staticmethod
    def read_copy(store: Store) -> Copy | None:
        """What a place is a copy of; None if it is none."""
        text = store.find(COPY, COPY_BYTES)
        return None if text is None else parse(Copy, text, f"{store.place}/{COPY}")

    def __repr__(self) -> str:
        return f"<Release {self.manifest.name} {self.manifest.version}: {pluralize(len(self.subsets), 'subsets')}>"

    def __getstate__(self) -> dict[str, Any]:  # subsets are made again where the release lands
        return {key: value for key, value in self.__dict__.items() if key not in ("subsets", "text")}

    @property
    def place(self) -> str:
        """Where it lies, for messages."""
        return self.store.place

    @property
    def in_the_making(self) -> bool:
        """True if it has no manifest yet."""
        return self.digest is None

    @functools.cached_property
    def layers(self) -> dict[str, Layer]:
        """All layers, by name."""
        return {layer.name: layer for layer in self.manifest.layers}

    @functools.cached_property
    def recipes(self) -> tuple[Resolved, ...]:
        """The resolved recipes that it comes from.

        Raises:
          StoreError: one is missing or was altered.
        """
        if isinstance(self.manifest, Resolved):
            return tuple(read_recipes(self.store))
        return tuple(read_recipe(self.store, digest) for digest in self.manifest.recipes)

    # -- records --------------------------------------------------------------------------------------

    def records(self, layer: str) -> dict[int, ShardRecord]:
        """Shard -> record of all shards of a layer that exist, here or not; read once.

        Raises:
          StoreError: the list is missing or altered, or a record is another job's.
        """
        if layer not in self._records:
            known = self.layers[layer]
            if isinstance(known, ListedLayer):
                self._records[layer] = self._read_list(known)
            else:
                self._records[layer] = read_records(self.store, known)
        return self._records[layer]

    def _read_list(self, layer: ListedLayer) -> dict[int, ShardRecord]:
        where = f"{self.place}/{list_path(layer.list)}"
        shards = _read_named(self.store, list_path(layer.list), layer.list, list_bytes_limit(layer), LayerList).shards
        if len(shards) != layer.shards:
            raise StoreError(f"{where} lists {len(shards)} shards, and the manifest says {layer.shards}")
        return {number: check_record(record, layer, number, where) for number, record in enumerate(shards)}

    def here(self, layer: str) -> Collection[int]:
        """Numbers of the shards of a layer that are here: all, but in a copy those whose record is."""
        if layer not in self._here:
            try:
                self._here[layer] = recorded_shards(self.store, layer) if self.copy else frozenset(self.records(layer))
            except StoreError:  # a web server gives no lists
                if self.copy is None:
                    raise
                self._here[layer] = self.copy.shards(layer)
        return self._here[layer]

    def layer_shards(self, name: str) -> tuple[Shard, ...]:
        """The shards of a layer that exist, in order; none of a layer of which a part of a release has nothing.

        Raises:
          StoreError: the list is missing or altered, or a record is another job's.
        """
        layer, here = self.layers[name], self.here(name)
        try:
            records = self.records(name)
        except NotThere:
            if self.copy is None or here:
                raise
            return ()  # a part has the lists of its own layers
        return tuple(Shard(layer, number, record, number in here) for number, record in sorted(records.items()))

    def shards(
        self, names: Collection[str] = (), episodes: tuple[int, int] | None = None, images: bool = True
    ) -> Iterator[Shard]:
        """Shards of subsets, each once, in the order in which they are written.

        Args:
          names: subsets, all by default.
          episodes: (first, last + 1), all by default.
          images: False leaves image layers out that can be rendered again.
        """
        done: set[tuple[str, int]] = set()
        for subset in self.manifest.subsets:
            if names and subset.name not in names:
                continue
            for name in subset.layers:
                layer = self.layers[name]
                if layer.kind == "images" and not (images or layer.source):
                    continue
                for shard in self.layer_shards(name):
                    span, place = shard.episodes, (name, shard.number)
                    first, last = episodes or (0, subset.episodes)
                    if span.start < min(last, subset.episodes) and first < span.stop and place not in done:
                        done.add(place)
                        yield shard

    def inputs_of(self, names: Collection[str]) -> tuple[FileRecord, ...]:
        """Policies and videos of some subsets, of which the release keeps copies."""
        wanted = [record for record in self.manifest.subsets if record.name in names]
        policies = {policy.path for record in wanted for policy in record.policies if policy.path}
        videos = tuple(f"{record.backgrounds['source']}/" for record in wanted if record.backgrounds)
        return tuple(file for file in self.manifest.inputs if file.path in policies or file.path.startswith(videos))

    # -- subsets --------------------------------------------------------------------------------------

    @functools.cached_property
    def subsets(self) -> dict[str, Any]:
        """The subsets that have episodes here, by name."""
        made = {record.name: self._subset(record) for record in self.manifest.subsets}
        return {name: subset for name, subset in made.items() if len(subset.episodes)}

    def _subset(self, record: SubsetRecord) -> Any:
        """A subset in the form that this class of releases gives."""
        from dmcvb_gen.dataset.reader import Subset  # Zarr, which whoever copies files does without

        return Subset(self, record)

    def select(self, patterns: Sequence[str] = ()) -> list[str]:
        """Names of the manifest's subsets that fit any pattern such as "walker-walk/*/static", all by default.

        The name of a union stands for its parts.
        """
        each = [part for pattern in patterns for part in self.parts_of(pattern) or [pattern]]
        return list(select([record.name for record in self.manifest.subsets], each))

    def parts_of(self, name: str) -> list[str]:
        """Names of the subsets whose union a name such as "walker-walk/medium-expert/none" is; [] if it is none."""
        known = [record.name for record in self.manifest.subsets]
        task, _, rest = name.partition("/")
        levels, _, setting = rest.partition("/")
        parts = [f"{task}/{level}/{setting}" for level in levels.split("-")]
        return parts if name not in known and len(parts) > 1 and set(parts) <= set(known) else []

    def __iter__(self) -> Iterator[str]:
        """Names of the subsets that have episodes here."""
        return iter(self.subsets)

    def __len__(self) -> int:
        return len(self.subsets)

    def __getitem__(self, name: str) -> Any:
        if name not in self.subsets and any(record.name == name for record in self.manifest.subsets):
            raise StoreError(
                f"{name} belongs to {self.manifest.name}, but {self.place} has no episode of it; "
                f"{'fetch' if self.copy else 'make'} it first, or choose others"
            )
        if name not in self.subsets:
            raise UnknownNameError("subset", name, self.subsets)
        return self.subsets[name]

    @property
    def shortfalls(self) -> dict[str, tuple[int, int]]:
        """Subsets that are not whole here -> (episodes here, episodes that belong to them)."""
        here = {name: len(subset.episodes) for name, subset in self.subsets.items()}
        pairs = {record.name: (here.get(record.name, 0), record.episodes) for record in self.manifest.subsets}
        return {name: (count, planned) for name, (count, planned) in pairs.items() if count < planned}

    @property
    def unfinished(self) -> dict[str, tuple[int, int]]:
        """The same of what recipes ask for, with their images, where the release is made."""
        if self.copy or self.manifest_path != MANIFEST:
            return self.shortfalls
        try:
            digests = _recipes_at(self.store)
        except StoreError:  # a server that lists nothing
            return self.shortfalls
        recipes = [read_recipe(self.store, digest) for digest in digests]
        asked = merged_subsets(record for recipe in recipes for record in recipe.subsets)
        named = {record.name: record.episodes for record in self.manifest.subsets}
        here = {
            name: min(named.get(name, 0), *map(self._listed_episodes, record.layers)) for name, record in asked.items()
        }
        return {name: (here[name], asked[name].episodes) for name in asked if here[name] < asked[name].episodes}

    def _listed_episodes(self, name: str) -> int:
        """Episodes of a layer that the manifest names; of a release in the making, those that are here."""
        layer = self.layers.get(name)
        if layer is None:
            return 0
        shards = layer.shards if isinstance(layer, ListedLayer) else len(self.here(name)) * self.in_the_making
        return shards * layer.episodes_per_shard

    @property
    def path(self) -> Path:
        """The folder of a local release.

        Raises:
          StoreError: it lies elsewhere.
        """
        if self.store.folder is None:
            raise StoreError(f"{self.place} is not a local folder; fetch it first")
        return self.store.folder


def _with_own_images(store: Store, manifest: Manifest) -> Manifest:
    """The manifest, with image layers that recipes beside it add to its subsets: rendered in part, or in a copy."""
    layers: dict[str, Layer] = {layer.name: layer for layer in manifest.layers}
    subsets = {subset.name: subset for subset in manifest.subsets}
    others = [digest for digest in _recipes_at(store) if digest not in manifest.recipes]
    for recipe in (read_recipe(store, digest) for digest in others):
        for subset in recipe.subsets:
            added = {layer.name: layer for layer in recipe.layers if layer.name in subset.layers}
            below = [layer for name, layer in added.items() if layer.kind != "images"]
            if subset.name in subsets and all(
                layers[each.name].key == each.key for each in below if each.name in layers
            ):
                old = subsets[subset.name]
                images = {name: layer for name, layer in added.items() if layer.kind == "images"}
                layers = images | layers
                names = tuple(sorted({*old.layers, *images}, key=layer_order))
                subsets[subset.name] = old.model_copy(update={"layers": names})
    return manifest.model_copy(update={"layers": tuple(layers.values()), "subsets": tuple(subsets.values())})


# -- small files ----------------------------------------------------------------------------------


def _plain_digest(given: str) -> str:
    """The 64 digits of a digest as people write it: with or without "sha256:", in either case."""
    digest = given.lower().removeprefix("sha256:")
    if not re.fullmatch("[0-9a-f]{64}", digest):
        raise StoreError(f"{given!r} is no digest; give 64 hexadecimal digits: RELEASE@sha256:DIGEST")
    return digest


def read_recipe(store: Store, digest: str) -> Resolved:
    """The recipe of a digest.

    Raises:
      StoreError: it is missing or was altered.
    """
    return _read_named(store, f"{RECIPES}{digest}.json", digest, RECIPE_BYTES, Resolved)


def _read_named(store: Store, path: str, digest: str, limit: int, model: type[Parsed]) -> Parsed:
    """A file whose name is its own SHA-256. Raises StoreError if it is missing or was altered."""
    text = store.read(path, limit)
    if sha256_bytes(text) != digest:
        cure = "fetch it again, or remove it if the manifest does not name it"
        cure = "`dmcvb-gen regenerate` writes it again" if path.startswith(LAYERS) else cure
        raise StoreError(f"{store.place}/{path} was altered: it does not have its own SHA-256; {cure}")
    return parse(model, text, f"{store.place}/{path}")


def read_recipes(store: Store) -> list[Resolved]:
    """All recipes at a place, in the order of their digests."""
    return [read_recipe(store, digest) for digest in _recipes_at(store)]


def _recipes_at(store: Store) -> list[str]:
    """Digests of all recipes at a place, sorted."""
    found = [re.fullmatch(rf"{RECIPES}([0-9a-f]{{64}})\.json", path) for path in store.list(RECIPES)]
    return sorted(match[1] for match in found if match)


def check_videos_shown(records: Iterable[SubsetRecord], given: str | None) -> None:
    """Raises StoreError if a folder of videos is given and no subset shows any."""
    if given is not None and all(record.backgrounds is None for record in records):
        raise StoreError("--backgrounds has no effect: no subset that is asked for shows videos; remove it")


def recorded_shards(store: Store, layer: str) -> frozenset[int]:
    """Numbers of the shards of a layer whose record is there; one listing."""
    record = re.compile(rf"{re.escape(RECORDS + layer)}/(\d{{5,6}})\.json")
    numbers = frozenset(int(found[1]) for found in map(record.fullmatch, store.list(f"{RECORDS}{layer}/")) if found)
    if len(numbers) > MAX_SHARDS:
        raise StoreError(f"{store.place} has {len(numbers):,} records of {layer}, more than any release")
    return numbers


def read_records(store: Store, layer: Layer, known: Mapping[int, ShardRecord] | None = None) -> dict[int, ShardRecord]:
    """Shard -> record of a layer that is being made, checked.

    Args:
      known: records that were read already, which never change.

    Raises:
      StoreError: a record is damaged, or of another job.
    """
    found = dict(known or {})
    new = sorted(recorded_shards(store, layer.name) - found.keys())
    with ThreadPoolExecutor(READERS) as pool:
        found |= dict(zip(new, pool.map(functools.partial(read_record, store, layer), new), strict=True))
    return dict(sorted(found.items()))


def read_record(store: Store, layer: Layer, shard: int) -> ShardRecord:
    """The record of a layer's shard.

    Raises:
      StoreError: it is missing, damaged, or of another job.
    """
    path = record_path(layer.name, shard)
    record = parse(ShardRecord, store.read(path, record_bytes_limit(layer)), f"{store.place}/{path}")
    return check_record(record, layer, shard, f"{store.place}/{path}")
