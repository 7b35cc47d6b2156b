"""A release to a URL and back: `publish` puts every file there, the manifest last; `fetch` brings a part of it.

What lies at the URL is the release's folder and two files more: `files.json` (every file with its digest, and the
digest of the manifest that it belongs to) and, while a publisher is at work, `publishing.json` (its claim). A folder
without a manifest is no release, so readers never see half of one.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pydantic

from dmcvb_gen.errors import StoreError
from dmcvb_gen.release.regenerate import load_manifest
from dmcvb_gen.release.transfer import (
    OBJECT_STORES,
    download,
    in_parallel,
    protocol,
    retry,
    upload,
)
from dmcvb_gen.rollout.jobs import ShardKey, chosen_shards
from dmcvb_gen.store.manifest import (
    MANIFEST,
    CommitRecord,
    Digest,
    FileRecord,
    Manifest,
    SubsetRecord,
    parse_commit,
    parse_manifest,
    write_json_atomically,
)
from dmcvb_gen.store.remote import file_system, public, reason
from dmcvb_gen.store.writer import commit_path, read_commits, sha256_file, shard_count, subset_path

INDEX, CLAIM = "files.json", "publishing.json"
CARD_FILES = ("README.md", "CHANGELOG.md", "LICENSE", "croissant.json")
CARD_FOLDER = "card"
"""Pictures of the card."""
Tick = Callable[[int], None]


class Index(pydantic.BaseModel):
    """files.json: every file of a published release but its manifest."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)
    format: Literal["dmcvb-gen files"] = "dmcvb-gen files"
    manifest_sha256: Digest
    files: tuple[FileRecord, ...]


@dataclass(frozen=True)
class Moved:
    """What a publish or fetch did: files and bytes of the release's part, and how many of the files were moved now."""

    files: int
    bytes: int
    moved: int


def small_files(root: Path, manifest: Manifest) -> list[str]:
    """Paths of everything but shards and manifest: metadata, commit records, policies, card."""
    found = []
    for record in manifest.subsets:
        folder = root / subset_path(record.name)
        found += [path.relative_to(root).as_posix() for path in sorted(folder.rglob("zarr.json"))]
        found += [commit_path(record.name, shard) for shard in range(shard_count(record))]
        found += [policy.path for policy in record.policies if policy.path]
    found += [name for name in CARD_FILES if (root / name).is_file()]
    found += [f"{CARD_FOLDER}/{path.name}" for path in sorted((root / CARD_FOLDER).glob("*")) if path.is_file()]
    return list(dict.fromkeys(found))


def make_index(root: Path, manifest: Manifest) -> Index:
    """The index of a complete release; digests of shards are those of its commit records.

    Raises:
      StoreError: a file is missing.
    """
    files = {}
    for record in manifest.subsets:
        commits = read_commits(root, record)
        if len(commits) != shard_count(record):
            raise StoreError(f"{record.name} has damaged or missing shards; run `dmcvb-gen regenerate {root}` first")
        files |= {file.path: file for commit in commits.values() for file in commit.files}
    for name in small_files(root, manifest):
        path = root / name
        if not path.is_file():
            raise StoreError(f"{path} is missing; run `dmcvb-gen regenerate {root}` first")
        files[name] = FileRecord(path=name, bytes=path.stat().st_size, sha256=sha256_file(path))
    return Index(
        manifest_sha256=sha256_file(root / MANIFEST), files=tuple(sorted(files.values(), key=lambda file: file.path))
    )


# -- publish --------------------------------------------------------------------------------------


def publish(
    root: str | Path,
    url: str,
    *,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    take_over: bool = False,
    tick: Tick = lambda count: None,
) -> Moved:
    """Put a complete release at a URL; run again after an interruption, it goes on.

    Args:
      url: s3://bucket/name, gs://, hf://datasets/owner/name, file: or any fsspec URL; it becomes the release's folder.
      options: of fsspec (endpoint_url, ...); credentials belong into the environment.
      take_over: go on although another publisher's claim is there (it crashed, and its release was another).
      tick: told 1 for each file.

    Raises:
      StoreError: the release is not complete or damaged; another version or publisher is there; access is refused;
        a file could not be moved.
    """
    root, manifest = load_manifest(root)
    if not manifest.complete:
        raise StoreError(f"{root} is not complete; finish it with the same rollout, or `dmcvb-gen regenerate {root}`")
    index = make_index(root, manifest)
    total = sum(file.bytes for file in index.files)
    if url.startswith("hf://"):
        from dmcvb_gen.release.hub import publish_to_hub

        return Moved(len(index.files), total, publish_to_hub(root, manifest, index, url, tick))
    filesystem, base = file_system(url, options)
    place = public(url)
    if _there(filesystem, place, base, index.manifest_sha256, manifest):
        return Moved(len(index.files), total, 0)
    fresh = _claim(filesystem, place, base, index.manifest_sha256, manifest, take_over)
    fresh = fresh and _read(filesystem, place, f"{base}/{INDEX}") is None
    results = in_parallel(
        lambda file: upload(filesystem, place, root / file.path, f"{base}/{file.path}", file, fresh),
        index.files,
        workers,
        lambda result: tick(1),
    )
    retry(place, INDEX, lambda: _put(filesystem, f"{base}/{INDEX}", index.model_dump_json(indent=1).encode()))
    try:
        _create(filesystem, f"{base}/{MANIFEST}", (root / MANIFEST).read_bytes())
    except FileExistsError:
        if not _there(filesystem, place, base, index.manifest_sha256, manifest):
            raise
    retry(place, CLAIM, lambda: filesystem.rm_file(f"{base}/{CLAIM}"))
    return Moved(len(index.files), total, sum(results))


def _read(filesystem, place, path) -> bytes | None:
    def attempt():
        try:
            filesystem.invalidate_cache()
            return filesystem.cat_file(path)
        except FileNotFoundError:
            return None

    return retry(place, path.rsplit("/", 1)[-1], attempt)


def _there(filesystem, place, base, digest: str, manifest: Manifest) -> bool:
    """Whether this very release is published there.

    Raises:
      StoreError: another one is.
    """
    found = _read(filesystem, place, f"{base}/{MANIFEST}")
    if found is None:
        return False
    if hashlib.sha256(found).hexdigest() == digest:
        return True
    try:
        other = parse_manifest(found, f"{place}/{MANIFEST}")
        what = f"{other.name} {other.version}"
    except StoreError:
        what = "something else"
    raise StoreError(
        f"{place} already holds {what}, and a published version never changes; publish {manifest.name} "
        f"{manifest.version} to another URL (a changed byte is a new version)"
    )


def _put(filesystem, path: str, data: bytes) -> None:
    if protocol(filesystem) not in OBJECT_STORES:
        filesystem.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
    filesystem.pipe_file(path, data)


def _create(filesystem, path: str, data: bytes) -> None:
    """Write a file that must not be there yet; atomic on local disks and S3, as good as can be elsewhere.

    Raises:
      FileExistsError: it is there.
    """
    if protocol(filesystem) not in OBJECT_STORES:
        filesystem.makedirs(path.rsplit("/", 1)[0], exist_ok=True)
    if protocol(filesystem) in ("file", "local"):
        with open(path, "xb") as file:
            file.write(data)
        return
    try:
        filesystem.pipe_file(path, data, mode="create")
    except Exception as error:
        filesystem.invalidate_cache()
        if "PreconditionFailed" in f"{type(error).__name__} {error}" or "condition" in str(error):
            raise FileExistsError(path) from None
        raise


def _claim(filesystem, place, base, digest, manifest, take_over) -> bool:
    """Say that this release is being published there; True if nobody had begun to.

    Raises:
      StoreError: another release is.
    """
    mine = {"name": manifest.name, "version": manifest.version, "manifest_sha256": digest}
    data, path = json.dumps(mine).encode(), f"{base}/{CLAIM}"

    def attempt():
        try:
            _create(filesystem, path, data)
            return None
        except FileExistsError:
            return filesystem.cat_file(path)
        except FileNotFoundError as error:
            raise StoreError(f"{place}: {reason(error)}; create the bucket first") from None

    found = retry(place, CLAIM, attempt)
    if found is None or found == data:
        return found is None  # else ours, from an interrupted try: the files that are there already are kept
    if take_over:
        retry(place, CLAIM, lambda: _put(filesystem, path, data))
        return False
    try:
        other = json.loads(found)
        what = f"{str(other['name'])[:80]} {str(other['version'])[:20]}"
    except (ValueError, KeyError, TypeError):
        what = "another release"
    raise StoreError(
        f"{what} is being published to {place} by someone else; choose another URL, or --take-over if that publisher "
        "is gone"
    )


# -- fetch ----------------------------------------------------------------------------------------


def fetch(
    url: str,
    out: str | Path,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    *,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    tick: Tick = lambda count: None,
) -> Moved:
    """Bring a published release, or the shards of it that hold some episodes; run again, it goes on or adds.

    Args:
      out: its folder here.
      only, episodes: subset patterns and (first, last + 1); all by default.
      options: of fsspec.
      tick: told the bytes of each file.

    Raises:
      StoreError: no release is there; a file has other bytes than its digest says; `out` holds something else;
        there is no room; access is refused.
    """
    out, place = Path(out), public(url)
    filesystem, base = file_system(url, options)
    text = _read(filesystem, place, f"{base}/{MANIFEST}")
    if text is None:
        raise StoreError(f"{place} holds no release (no {MANIFEST}); check the URL, or it is still being published")
    manifest = parse_manifest(text, f"{place}/{MANIFEST}")
    index = _read_index(filesystem, place, base, text)
    shards = chosen_shards(manifest, only, episodes)
    records = {record.name: record for record in shards.values()}
    listed = {file.path: file for file in index.files}
    # Zarr finds the arrays in one consolidated file and beside them: all metadata of a subset comes.
    metadata = [
        path
        for path in listed
        for name in records
        if path.startswith(f"{subset_path(name)}/") and path.endswith("/zarr.json")
    ]
    policies = [policy.path for record in records.values() for policy in record.policies if policy.path in listed]
    cards = [path for path in listed if path in CARD_FILES or path.startswith(f"{CARD_FOLDER}/")]
    commit_files = [_listed(listed, commit_path(*key), place) for key in shards]
    _take_up(out, manifest, text)
    try:
        out.mkdir(parents=True, exist_ok=True)
        commits = _fetch_commits(filesystem, place, base, commit_files, shards, workers, out)
        wanted = [listed[path] for path in dict.fromkeys(metadata + policies + cards)]
        wanted += [file for commit in commits.values() for file in commit.files]
        total = sum(file.bytes for file in wanted)
        _check_room(out, [file for file in wanted if not (out / file.path).exists()])
        moved = in_parallel(
            lambda file: (download(filesystem, place, f"{base}/{file.path}", out / file.path, file), file.bytes),
            wanted,
            workers,
            lambda result: tick(result[1]),
        )
        _write_manifest(out, manifest, text, only, episodes, place)
        for name in records:
            (out / subset_path(name) / ".created").touch()
        for commit in commits.values():  # a shard is there once its record is, and that comes after its files
            write_json_atomically(out / commit_path(commit.subset, commit.shard), commit)
        _write_manifest(out, manifest, text, only, episodes, place)
    except OSError as error:
        raise StoreError(f"cannot write to {out}: {error.strerror or error}; choose a writable --out") from None
    return Moved(len(wanted), total, sum(count > 0 for count, _ in moved))


def _read_index(filesystem, place, base, manifest_text: bytes) -> Index:
    text = _read(filesystem, place, f"{base}/{INDEX}")
    if text is None:
        raise StoreError(f"{place} has no {INDEX}; it was not put there by `dmcvb-gen publish`, copy the folder whole")
    try:
        index = Index.model_validate_json(text)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the top"
        raise StoreError(f"{place}/{INDEX} is not valid at {where}: {first['msg']}") from None
    if index.manifest_sha256 != hashlib.sha256(manifest_text).hexdigest():
        raise StoreError(f"{place}: {MANIFEST} does not have the digest that {INDEX} says; publish it again")
    return index


def _listed(listed: dict[str, FileRecord], path: str, place: str) -> FileRecord:
    if path not in listed:
        raise StoreError(f"{place}/{INDEX} does not list {path}; publish the release again")
    return listed[path]


def _fetch_commits(filesystem, place, base, files, shards, workers, out) -> dict[ShardKey, CommitRecord]:
    """The commit records of shards, checked: digests, and that their files lie in the subset's own folder."""

    def one(item):
        key, file = item

        def attempt():
            data = filesystem.cat_file(f"{base}/{file.path}")
            if hashlib.sha256(data).hexdigest() != file.sha256:
                raise OSError(f"{file.path} does not have its digest")
            return data

        commit = parse_commit(retry(place, file.path, attempt), f"{place}/{file.path}")
        folder = f"{subset_path(key[0])}/"
        strange = [f.path for f in commit.files if not f.path.startswith(folder)]
        if (commit.subset, commit.shard) != key or strange:
            raise StoreError(f"{place}/{file.path} names files outside of {folder}; do not trust this release")
        return commit

    return dict(zip(shards, in_parallel(one, list(zip(shards, files, strict=True)), workers, lambda _: 0), strict=True))


def _same_release(one: Manifest, other: Manifest) -> bool:
    def identity(manifest: Manifest) -> tuple[str, str, Any, list[SubsetRecord]]:
        return manifest.name, manifest.version, manifest.recipe, list(manifest.subsets)

    return identity(one) == identity(other)


def _take_up(out: Path, manifest: Manifest, text: bytes) -> None:
    """Raises StoreError where `out` holds anything but a part of this release."""
    if (out / MANIFEST).is_file():
        old = parse_manifest((out / MANIFEST).read_bytes(), str(out / MANIFEST))
        if not _same_release(old, manifest):
            raise StoreError(
                f"{out} holds {old.name} {old.version} and not the {manifest.name} {manifest.version} of the URL; "
                "choose another --out"
            )
    elif out.exists() and (not out.is_dir() or any(path.suffix != ".partial" for path in _strangers(out, manifest))):
        raise StoreError(f"{out} is not empty and holds no release; choose an empty or new folder for --out")


def _strangers(out: Path, manifest: Manifest) -> Iterable[Path]:
    """What lies in a folder and is no part of an interrupted fetch."""
    ours = {record.name.split("/")[0] for record in manifest.subsets} | {"policies", "commits", CARD_FOLDER}
    return (path for path in out.iterdir() if path.name not in ours | set(CARD_FILES))


def _check_room(out: Path, files: list[FileRecord]) -> None:
    needed, free = sum(file.bytes for file in files), os.statvfs(out)
    if needed > free.f_bavail * free.f_frsize:
        raise StoreError(
            f"{needed / 1e9:.1f} GB are to be fetched and {free.f_bavail * free.f_frsize / 1e9:.1f} GB are free at "
            f"{out}; make room, choose another --out, or fetch less with --only and --episodes"
        )


def _write_manifest(out: Path, manifest: Manifest, text: bytes, only, episodes, place: str) -> None:
    """The release's own manifest where everything is here; else one that says which part, and that it is one."""
    whole = all(len(read_commits(out, record)) == shard_count(record) for record in manifest.subsets)
    if whole:
        temporary = out / f"{MANIFEST}.partial"
        temporary.write_bytes(text)
        temporary.replace(out / MANIFEST)
        return
    parts = []
    if (out / MANIFEST).is_file():
        parts = [entry for entry in parse_manifest((out / MANIFEST).read_bytes()).lineage if entry["kind"] == "fetch"]
    entry = {
        "kind": "fetch",
        "from": place,
        "manifest_sha256": hashlib.sha256(text).hexdigest(),
        "only": list(only),
        "episodes": list(episodes) if episodes else None,
    }
    if entry not in parts:
        parts.append(entry)
    lineage = (*manifest.lineage, *parts)
    write_json_atomically(out / MANIFEST, manifest.model_copy(update={"lineage": lineage, "complete": False}))
