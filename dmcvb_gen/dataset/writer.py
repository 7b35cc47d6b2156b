"""Write a release: recipe, shards with their records, layer lists, manifest, metadata for plain readers; in this order.

Files and records are created and never replaced. If a file is there, equal bytes are adopted and others stop with an
error. Only the manifest and what follows from it (zarr.json, copy.json) are replaced, each in one atomic step::

    begin      inputs, then recipes/<sha>.json
    put_shard  files, then records/<layer>/00003.json
    finish     layers/<sha>.json, then manifest.json, then zarr.json
"""

from __future__ import annotations

import datetime
import itertools
import secrets
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.dataset.environment import environment
from dmcvb_gen.dataset.gate import READERS, Release, Shard, read_recipes, read_record, read_records
from dmcvb_gen.dataset.manifest import (
    COPY,
    MANIFEST,
    MANIFEST_BYTES,
    MANIFESTS,
    MAX_SHARD_BYTES,
    POLICIES,
    PROVENANCE,
    RECIPES,
    RECORDS,
    VIDEOS,
    ZARR_JSON,
    Copy,
    FileRecord,
    Layer,
    ListedLayer,
    Resolved,
    ShardFile,
    ShardRecord,
    SubsetRecord,
    build_manifest,
    canonical_json,
    list_path,
    merged_layers,
    merged_subsets,
    record_path,
    runs,
)
from dmcvb_gen.dataset.schema import array_metadata
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import parse_json, sha256_bytes, sha256_file
from dmcvb_gen.storage.store import NotThere, Store
from dmcvb_gen.text import quoted

PROVENANCE_BYTES = 2**20
ROW_LAYOUT = "row t: observation t, action t, reward of action t; row `length`: the last observation alone"


def put(store: Store, path: str, data: bytes | Path, *, first_wins: bool = False) -> ShardFile:
    """Create a file, or adopt the equal one that is there.

    Args:
      data: its bytes, or the path of a local file.
      first_wins: adopt whatever is there, for images of a renderer that does not promise bits.

    Returns:
      Size and SHA-256 of the file that is there now.

    Raises:
      StoreError: a file with other bytes is there, or it cannot be written.
    """
    mine = file_facts(data)
    if store.create(path, data):
        return mine
    there = ShardFile(bytes=store.size(path) or 1, sha256=store.sha256(path, MAX_SHARD_BYTES))
    if there == mine or first_wins:
        return there
    raise StoreError(
        f"{store.place}/{path} exists with other bytes (SHA-256 {there.sha256[:12]}, made by {makers(store)}) than "
        f"{_versions(environment())} makes ({mine.sha256[:12]}); use those versions, choose another place, or remove "
        "the file if it is damaged"
    )


def file_facts(data: bytes | Path) -> ShardFile:
    """Size and SHA-256 of bytes or of a local file."""
    if isinstance(data, bytes):
        return ShardFile(bytes=len(data), sha256=sha256_bytes(data))
    return ShardFile(bytes=data.stat().st_size, sha256=sha256_file(data))


# -- recipe ---------------------------------------------------------------------------------------


def begin(store: Store, recipe: Resolved, inputs: Mapping[str, Path | bytes]) -> None:
    """Put a resolved recipe, and the policies and videos that it names; quiet if they are there.

    Args:
      inputs: path in the release -> local file, for every file of `recipe.inputs`.

    Raises:
      StoreError: the place holds something else, or a recipe that contradicts this one; or it is a copy.
    """
    there = read_recipes(store)
    if any(each.sha256 == recipe.sha256 for each in there):
        return
    strange = [] if there else [path for path in store.list() if not path.startswith((POLICIES, VIDEOS))]
    if strange:
        raise StoreError(
            f"{store.place} holds no release but other files ({strange[0]}); choose an empty place for --out"
        )
    for parent in store.folder.resolve().parents if store.folder else ():
        if (parent / RECIPES).is_dir() and (parent / RECORDS).is_dir():
            raise StoreError(f"{store.place} lies in the release {parent}; choose another --out")
    if store.size(COPY) is not None and not _adds_images_alone(Release.open(store), recipe):
        raise StoreError(f"{store.place} is a copy of a release and does not grow; choose another --out")
    check_agree([*there, recipe])
    for file in recipe.inputs:
        if file_facts(inputs[file.path]).at(file.path) != file:
            raise StoreError(
                f"the file for {file.path} is not the one that the recipe names; give the videos that it was made with "
                "(--backgrounds FOLDER)"
            )
        put(store, file.path, inputs[file.path])
    created = store.create(path := f"{RECIPES}{recipe.sha256}.json", canonical_json(recipe))
    try:
        check_agree(read_recipes(store))
    except StoreError:  # another process began meanwhile
        if created:
            store.delete(path)
        raise


def _adds_images_alone(release: Release, recipe: Resolved) -> bool:
    """Return True if a recipe has nothing but subsets of a release, with more images."""
    known = {subset.name for subset in release.manifest.subsets}
    strange = [layer for layer in recipe.layers if layer.name not in release.layers and layer.kind != "images"]
    return not strange and known >= {subset.name for subset in recipe.subsets}


def check_agree(recipes: Sequence[Resolved]) -> None:
    """Raises StoreError if recipes describe a layer or a subset differently."""
    merged_layers(recipes)
    merged_subsets(subset for recipe in recipes for subset in recipe.subsets)


# -- shards ---------------------------------------------------------------------------------------


def put_shard(store: Store, layer: Layer, shard: int, arrays: Iterable[tuple[str, np.ndarray]]) -> ShardRecord:
    """Write the arrays of a layer's shard, then its record.

    Args:
      arrays: (name, (episode of the shard, ...)) pairs of all arrays of the layer, taken one after the other.

    Raises:
      StoreError: see `put`; arrays are missing; another job's record is there.
    """
    from dmcvb_gen.dataset.chunks import encode  # Zarr, which whoever copies files does without

    specs, files, given = {spec.name: spec for spec in layer.arrays}, {}, set()
    for name, values in arrays:
        given.add(name)
        data = encode(layer, specs[name], values)
        if data is not None:
            files[name] = put(store, layer.file_path(specs[name], shard), data)
    if lacking := set(specs) - given:
        raise StoreError(f"shard {shard} of {layer.name} was made without {min(lacking)}")
    return put_record(store, layer, shard, ShardRecord(key=layer.job_key(shard), files=files))


def put_record(store: Store, layer: Layer, shard: int, record: ShardRecord) -> ShardRecord:
    """Put the record of a shard whose files are there: from now on the shard exists.

    Raises:
      StoreError: another record is there.
    """
    path = record_path(layer.name, shard)
    if store.create(path, canonical_json(record)):
        return record
    there = read_record(store, layer, shard)
    if there != record:
        raise StoreError(
            f"{store.place}/{path} names other files (made by {makers(store)}) than {_versions(environment())} makes; "
            "use those versions, or choose another place"
        )
    return there


def wrong_bytes(store: Store, file: FileRecord) -> str | None:
    """Say what is wrong with a file of a release, in words that follow its name; None if every byte is as recorded."""
    try:
        size = store.size(file.path)
        if size not in (None, file.bytes):
            return f"has {size} bytes instead of {file.bytes}"
        return None if store.sha256(file.path, file.bytes) == file.sha256 else "does not have its digest"
    except NotThere:
        return "is missing"
    except StoreError as error:
        return f"cannot be read: {error}"


def read_checked(store: Store, file: FileRecord) -> bytes:
    """The bytes of a file of a release.

    Raises:
      StoreError: it is missing, or its bytes are not as recorded.
    """
    data = store.read(file.path, file.bytes)
    if sha256_bytes(data) != file.sha256:
        cure = f"run `dmcvb-gen regenerate {quoted(store.place)}`"
        raise StoreError(f"{store.place}/{file.path} does not have its digest; {cure}")
    return data


def put_back(store: Store, file: FileRecord, data: bytes | Path) -> None:
    """Put a file in the place of a missing or damaged one, if it has the recorded SHA-256; else change nothing.

    Raises:
      StoreError: it has other bytes.
    """
    mine = file_facts(data)
    if mine.at(file.path) != file:
        raise StoreError(
            f"{file.path} was made by {makers(store)} and cannot be made with {_versions(environment())}: SHA-256 "
            f"{mine.sha256[:12]} instead of {file.sha256[:12]}; nothing was changed"
        )
    store.delete(file.path)
    put(store, file.path, data)


# -- manifest -------------------------------------------------------------------------------------


def finish(store: Store) -> Release:
    """Write the manifest of what is there: of each subset the largest count asked for whose shards all exist.

    Whoever finishes writes the same bytes. Until the manifest is replaced, the older one is the release, whole. The
    manifest of a copy stays.

    Returns:
      The release as it is now; in the making if no subset is whole.
    """
    while store.size(COPY) is None:
        tag = store.version(MANIFEST)
        old = store.read(MANIFEST, MANIFEST_BYTES) if tag is not None else None
        recipes = read_recipes(store)
        known = _listed_records(store) if old is not None else {}
        lists = {
            name: _leading(read_records(store, layer, known.get(name)))
            for name, layer in merged_layers(recipes).items()
        }
        built = build_manifest(recipes, lists)
        if built is None:
            return Release.in_making(store)
        manifest, made = built
        text = canonical_json(manifest)
        if text == old:
            break
        for each in made.values():
            listed = canonical_json(each)
            put(store, list_path(sha256_bytes(listed)), listed)
        if old is not None:
            put(store, f"{MANIFESTS}{sha256_bytes(old)}.json", old)
        if store.replace(MANIFEST, text, expected=tag):
            break
    while True:
        release = Release.open(store)
        write_plain_metadata(release)
        if store.version(MANIFEST) is None or Release.open(store).digest == release.digest:
            return _ended(release) if release.copy else release  # else another process has finished more meanwhile


def _listed_records(store: Store) -> dict[str, dict[int, ShardRecord]]:
    release = Release.open(store)
    return {name: release.records(name) for name in release.layers}


def _leading(records: Mapping[int, ShardRecord]) -> tuple[ShardRecord, ...]:
    """The records from the first shard up to the first gap."""
    return tuple(record for place, (number, record) in enumerate(sorted(records.items())) if number == place)


# -- for plain readers ----------------------------------------------------------------------------


def write_plain_metadata(release: Release) -> None:
    """Write the zarr.json files of the layers that are here, for zarr and xarray; our readers never read them."""
    store, texts = release.store, plain_metadata(release)

    def write(path: str) -> None:
        if store.find(path, MANIFEST_BYTES) != texts[path]:  # so that nothing is written where nothing is new
            store.replace(path, texts[path])

    with ThreadPoolExecutor(READERS) as pool:
        list(pool.map(write, texts))


def plain_metadata(release: Release) -> dict[str, bytes]:
    """Path -> text of every zarr.json: a function of manifest and copy."""
    nodes: dict[str, dict[str, Any]] = {}
    for subset in release.manifest.subsets:
        for name in subset.layers:
            if release.here(name):
                _add_layer(nodes, release, subset, release.layers[name])
    for path in [path for path in nodes if path.endswith(".zarr")]:
        members = {each.removeprefix(f"{path}/"): nodes[each] for each in nodes if each.startswith(f"{path}/")}
        inline = {"kind": "inline", "must_understand": False, "metadata": members}
        nodes[path] = nodes[path] | {"consolidated_metadata": inline}
    return {f"{path}/{ZARR_JSON}": canonical_json(node) for path, node in nodes.items()}


def _add_layer(nodes: dict[str, dict[str, Any]], release: Release, subset: SubsetRecord, layer: Layer) -> None:
    root, _, setting = layer.group.partition(".zarr/")
    shared: dict[str, Any] = {"task": subset.task, "level": subset.level, "layout": ROW_LAYOUT}
    shared |= {"release": f"{release.manifest.name} {release.manifest.version}"}
    shared |= {"seconds_per_step": subset.seconds_per_step}
    nodes.setdefault(f"{root}.zarr", _group(shared))
    facts = {} if layer.kind == "trajectories" else {"setting": subset.setting, "views": list(subset.views)}
    nodes.setdefault(f"{root}.zarr/{setting}", _group(facts))
    for spec in layer.arrays:
        path = f"{layer.group}/{spec.stored_name}"
        folder = path.rpartition("/")[0]
        if folder != layer.group:
            nodes.setdefault(folder, _group({}))
        episodes = min(subset.episodes, (max(release.records(layer.name)) + 1) * layer.episodes_per_shard)
        episodes = max(episodes, nodes.get(path, {}).get("shape", (0,))[0])
        nodes[path] = parse_json(canonical_json(array_metadata(layer, spec, episodes)))


def _group(attributes: dict[str, Any]) -> dict[str, Any]:
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


# -- copies ---------------------------------------------------------------------------------------


def finish_copy(store: Store, manifest_text: bytes, source: str, shards: Iterable[Shard]) -> Release:
    """Make a folder with copied shards and lists a copy: copy.json, then the manifest, then zarr.json.

    Args:
      manifest_text: the manifest that was copied from, to the byte.
      source: where it was copied from, without passwords.
      shards: that were to be copied; those promised before stay so. If all are here, it is a copy no more.
    """
    old, before = Release.read_copy(store), store.find(MANIFEST, MANIFEST_BYTES)
    if old or before != manifest_text:  # else it is whole, and stays so
        if before is not None and before != manifest_text:
            put(store, f"{MANIFESTS}{sha256_bytes(before)}.json", before)
        promised = {name: set(old.shards(name)) for name in old.promised} if old else {}
        store.replace(COPY, canonical_json(_copy(sha256_bytes(manifest_text), source, _by_layer(shards, promised))))
        store.replace(MANIFEST, manifest_text)
    release = Release.open(store)
    write_plain_metadata(release)
    return _ended(release)


def _ended(release: Release) -> Release:
    """A release, which is a copy no more if all is here."""
    listed = [layer for layer in release.manifest.layers if isinstance(layer, ListedLayer)]
    if all(len(release.here(layer.name)) == layer.shards for layer in listed):
        release.store.delete(COPY)
    return release


def copy_of(release: Release, shards: Iterable[Shard]) -> Release:
    """The release as a copy that promises these shards alone; the release itself if they are all."""
    promised = _by_layer(shards, {})
    if release.digest is None or all({*release.records(name)} <= promised.get(name, set()) for name in release.layers):
        return release
    copy = _copy(release.digest, f"{release.manifest.name} {release.manifest.version}", promised)
    part = Release(release.store, release.manifest, release.digest, release.compared, copy)
    part._here |= {name: frozenset(promised.get(name, ())) for name in release.layers}
    return part


def _by_layer(shards: Iterable[Shard], numbers: dict[str, set[int]]) -> dict[str, set[int]]:
    """Layer -> numbers of its shards, added to those that are known."""
    for shard in shards:
        numbers.setdefault(shard.layer.name, set()).add(shard.number)
    return numbers


def _copy(digest: str, source: str, promised: Mapping[str, Collection[int]]) -> Copy:
    return Copy(manifest=digest, source=source, promised={name: runs(promised[name]) for name in sorted(promised)})


# -- provenance -----------------------------------------------------------------------------------


def write_provenance(store: Store, command: str, **facts: Any) -> None:
    """Note who made what, when and with which versions; one file a process, outside of the digest."""
    now = datetime.datetime.now(datetime.UTC)
    content = {"time": now.isoformat(timespec="seconds"), "command": command, "environment": environment(), **facts}
    store.create(f"{PROVENANCE}{now:%Y%m%dT%H%M%SZ}-{secrets.token_hex(4)}.json", canonical_json(content))


def read_provenance(store: Store) -> Iterator[dict[str, Any]]:
    """Notes of all processes that wrote to a release, oldest first, each read when it is asked for.

    No digest covers them: what is no note is left out, and so is what is no text in its environment.
    """
    for path, size in sorted(store.list(PROVENANCE).items()):
        try:
            note = parse_json(store.read(path, PROVENANCE_BYTES)) if size <= PROVENANCE_BYTES else None
        except ValueError:
            continue
        if isinstance(note, dict) and isinstance(made := note.get("environment"), dict):
            yield note | {"environment": {name: value for name, value in made.items() if isinstance(value, str)}}


def makers(store: Store) -> str:
    """The versions that made a release, for messages."""
    found = dict.fromkeys(_versions(note["environment"]) for note in read_provenance(store))
    return " and ".join(found) or "unknown versions"


def check_versions(store: Store) -> None:
    """Raises StoreError if a package has another version here than where a release was begun."""
    here = environment()
    for note in itertools.islice(read_provenance(store), 1):
        for name, version in here.items():
            begun = note["environment"].get(name, version)
            if name not in ("system", "cpu") and begun != version:
                raise StoreError(
                    f"the release was begun with {name} {begun} and this is {name} {version}, which may change bits; "
                    f"install {name} {begun}, or give --other-versions"
                )


def _versions(made_by: Mapping[str, str]) -> str:
    versions = (f"{name} {made_by.get(name, '?')}" for name in ("dmcvb-gen", "mujoco"))
    return f"{' with '.join(versions)} on {made_by.get('cpu', 'an unknown processor')}"
