"""A release to a URL and back: `publish` puts every file there, the manifest last; `fetch` brings a part of it.

What lies at the URL is the release's folder and two files more: `files.json` (every file with its digest, and the
digest of the manifest that it belongs to) and, while a publisher is at work, `publishing.json` (its claim). A folder
without a manifest is no release, so readers never see half of one.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.errors import StoreError
from dmcvb_gen.store.growth import is_grown_from
from dmcvb_gen.store.index import (
    CARD_FILES,
    CARD_FOLDER,
    INDEX,
    Index,
    card_files,
    data_files,
    is_card,
    parse_index,
    read_index,
    write_release,
)
from dmcvb_gen.store.manifest import (
    MANIFEST,
    CommitRecord,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.store.reader import load_manifest
from dmcvb_gen.store.remote import file_system, local_path, public, reason, storage_errors
from dmcvb_gen.store.shards import ShardKey, chosen_shards
from dmcvb_gen.store.transfer import (
    create_object,
    download,
    in_parallel,
    put_object,
    read_object,
    retry,
    upload,
)
from dmcvb_gen.store.writer import LOCK, mark_created, only_writer, read_commits

CLAIM = "publishing.json"
Tick = Callable[[int], None]


@dataclass(frozen=True)
class Moved:
    """What a publish or fetch did: files and bytes of the release's part, and how many of the files were moved now."""

    files: int
    bytes: int
    moved: int


def index_of(root: Path, manifest: Manifest) -> Index:
    """The index of a complete release: its own, or one made now for a release of version 1.

    Raises:
      StoreError: a file is missing, or manifest and index do not belong together.
    """
    commits = {record.name: read_commits(root, record) for record in manifest.subsets}
    for record in manifest.subsets:
        if len(commits[record.name]) != shard_count(record):
            raise StoreError(f"{record.name} has damaged or missing shards; run `dmcvb-gen regenerate {root}` first")
    digest, index = files.sha256_file(root / MANIFEST), read_index(root)
    if index is None:
        listed = sorted([*data_files(root, manifest, commits), *card_files(root)], key=lambda file: file.path)
        return Index(manifest_sha256=digest, files=tuple(listed)).sealed()
    if index.manifest_sha256 != digest:
        raise StoreError(f"{root / MANIFEST} does not have the digest that {INDEX} says; `dmcvb-gen verify` says more")
    return index


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
    index = index_of(root, manifest)
    total = sum(file.bytes for file in index.files)
    if url.startswith("hf://"):
        from dmcvb_gen.release.hub import publish_to_hub

        return Moved(len(index.files), total, publish_to_hub(root, manifest, index, url, tick))
    filesystem, base = file_system(url, options)
    place = public(url)
    before = _published(filesystem, place, base, index.manifest_sha256, manifest)
    if before == ():
        return Moved(len(index.files), total, 0)
    fresh = _claim(filesystem, place, base, index.manifest_sha256, manifest, take_over)
    fresh = fresh and before is None and read_object(filesystem, place, f"{base}/{INDEX}") is None
    kept = set(before or ())
    results = []
    for part in _in_order([file for file in index.files if file not in kept]):
        results += in_parallel(
            lambda file: upload(filesystem, place, root / file.path, f"{base}/{file.path}", file, fresh),
            part,
            workers,
            lambda result: tick(1),
        )
    retry(place, INDEX, lambda: put_object(filesystem, f"{base}/{INDEX}", files.json_bytes(index)))
    text = (root / MANIFEST).read_bytes()
    if before is not None:
        retry(place, MANIFEST, lambda: put_object(filesystem, f"{base}/{MANIFEST}", text))
    else:
        try:
            create_object(filesystem, f"{base}/{MANIFEST}", text)
        except FileExistsError:
            _published(filesystem, place, base, index.manifest_sha256, manifest)  # another one's raises
    retry(place, CLAIM, lambda: filesystem.rm_file(f"{base}/{CLAIM}"))
    return Moved(len(index.files), total, sum(results))


def _in_order(todo: Sequence[FileRecord]) -> list[list[FileRecord]]:
    """Files in the order in which they go up: new ones first, then those that take the place of an older version's."""
    late = [file for file in todo if file.path.endswith("/zarr.json") or is_card(file.path)]
    return [part for part in ([file for file in todo if file not in set(late)], late) if part]


def _published(filesystem, place, base, digest: str, manifest: Manifest) -> tuple[FileRecord, ...] | None:
    """The files of an older version that this one has grown from; () for this very one, None where none is.

    Raises:
      StoreError: another release is there.
    """
    found = read_object(filesystem, place, f"{base}/{MANIFEST}")
    if found is None:
        return None
    if files.sha256_bytes(found) == digest:
        return ()
    what = "something else"
    try:
        other = parse_manifest(found, f"{place}/{MANIFEST}")
        what = f"{other.name} {other.version}"
        if is_grown_from(manifest, other):
            return parse_index(read_object(filesystem, place, f"{base}/{INDEX}") or b"", f"{place}/{INDEX}").files
    except StoreError:
        pass
    raise StoreError(
        f"{place} already holds {what}, and a published version never changes; publish {manifest.name} "
        f"{manifest.version} to another URL (a changed byte is a new version)"
    )


def _claim(filesystem, place, base, digest, manifest, take_over) -> bool:
    """Say that this release is being published there; True if nobody had begun to.

    Raises:
      StoreError: another release is.
    """
    mine = {"name": manifest.name, "version": manifest.version, "manifest_sha256": digest}
    data, path = json.dumps(mine).encode(), f"{base}/{CLAIM}"

    def attempt():
        try:
            create_object(filesystem, path, data)
            return None
        except FileExistsError:
            return filesystem.cat_file(path)
        except FileNotFoundError as error:
            raise StoreError(f"{place}: {reason(error)}; create the bucket first") from None

    found = retry(place, CLAIM, attempt)
    if found is None or found == data:
        return found is None  # else ours, from an interrupted try: the files that are there already are kept
    if take_over:
        retry(place, CLAIM, lambda: put_object(filesystem, path, data))
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
    out, source = local_path(out), Source.find(url, options)
    shards = chosen_shards(source.manifest, only, episodes)
    wanted = source.metadata(shards.values())
    commit_files = [source.listed(commit_path(*key)) for key in shards]
    _take_up(out, source.manifest)
    with storage_errors(out, "write to"):
        out.mkdir(parents=True, exist_ok=True)
        with only_writer(out):
            commits = _fetch_commits(source, commit_files, shards, workers)
            wanted += [file for _, commit in commits.values() for file in commit.files]
            _check_room(out, [file for file in wanted if not (out / file.path).exists()])

            def bring(file: FileRecord) -> tuple[int, int]:
                remote = f"{source.base}/{file.path}"
                return download(source.filesystem, source.place, remote, out / file.path, file), file.bytes

            moved = in_parallel(bring, wanted, workers, lambda result: tick(result[1]))
            _write_part(out, source, only, episodes)
            for text, commit in commits.values():  # a shard is there once its record is, and that is after its files
                files.write_bytes(out / commit_path(commit.subset, commit.shard), text)
            _finish(out, source)
    return Moved(len(wanted), sum(file.bytes for file in wanted), sum(count > 0 for count, _ in moved))


@dataclass(frozen=True)
class Source:
    """A published release: where it lies, and what it says of itself."""

    filesystem: Any
    base: str
    place: str
    manifest_text: bytes
    index_text: bytes
    manifest: Manifest
    index: Index

    @classmethod
    def find(cls, url: str, options: dict[str, Any] | None) -> Source:
        """Read manifest and index at a URL.

        Raises:
          StoreError: no release is there, or its manifest and index do not belong together.
        """
        place = public(url)
        filesystem, base = file_system(url, options)
        text = read_object(filesystem, place, f"{base}/{MANIFEST}")
        if text is None:
            raise StoreError(f"{place} holds no release (no {MANIFEST}); check the URL, or it is still being published")
        manifest = parse_manifest(text, f"{place}/{MANIFEST}")
        listing = read_object(filesystem, place, f"{base}/{INDEX}")
        if listing is None:
            raise StoreError(
                f"{place} has no {INDEX}; it was not put there by `dmcvb-gen publish`, copy the folder whole"
            )
        index = parse_index(listing, f"{place}/{INDEX}")
        if index.manifest_sha256 != files.sha256_bytes(text):
            raise StoreError(f"{place}: {MANIFEST} does not have the digest that {INDEX} says; publish it again")
        return cls(filesystem, base, place, text, listing, manifest, index)

    def listed(self, path: str) -> FileRecord:
        """What the index says of a file."""
        for file in self.index.files:
            if file.path == path:
                return file
        raise StoreError(f"{self.place}/{INDEX} does not list {path}; publish the release again")

    def metadata(self, records: Iterable[SubsetRecord]) -> list[FileRecord]:
        """Zarr metadata and policies of subsets, and the card: what comes whole with any part of the release.

        Zarr finds the arrays in one consolidated file and beside them, so all metadata of a subset comes.
        """
        records = list({record.name: record for record in records}.values())
        folders = tuple(f"{subset_path(record.name)}/" for record in records)
        policies = {policy.path for record in records for policy in record.policies}
        videos = tuple(f"{(record.backgrounds or {}).get('source')}/" for record in records)
        return [
            file
            for file in self.index.files
            if (file.path.startswith(folders) and file.path.endswith("/zarr.json"))
            or file.path in policies
            or file.path.startswith(videos)
            or is_card(file.path)
        ]


def _fetch_commits(
    source: Source, listed: list[FileRecord], shards: dict[ShardKey, SubsetRecord], workers: int
) -> dict[ShardKey, tuple[bytes, CommitRecord]]:
    """The commit records of shards, as bytes and checked: digests, and that their files lie in the subset's folder."""

    def one(item):
        key, file = item

        def attempt():
            data = source.filesystem.cat_file(f"{source.base}/{file.path}")
            if files.sha256_bytes(data) != file.sha256:
                raise OSError(f"{file.path} does not have its digest")
            return data

        text = retry(source.place, file.path, attempt)
        return text, checked_commit(text, f"{source.place}/{file.path}", shards[key], key[1])

    found = in_parallel(one, list(zip(shards, listed, strict=True)), workers, lambda _: 0)
    return dict(zip(shards, found, strict=True))


def _same_release(one: Manifest, other: Manifest) -> bool:
    def identity(manifest: Manifest) -> tuple[str, str, Any, list[SubsetRecord]]:
        bare = [record.model_copy(update={"digest": None}) for record in manifest.subsets]
        return manifest.name, manifest.version, manifest.recipe, bare

    return identity(one) == identity(other)


def _take_up(out: Path, manifest: Manifest) -> None:
    """Raises StoreError where `out` holds anything but a part of this release."""
    if (out / MANIFEST).is_file():
        old = parse_manifest((out / MANIFEST).read_bytes(), str(out / MANIFEST))
        if not _same_release(old, manifest):
            raise StoreError(
                f"{out} holds {old.name} {old.version} and not the {manifest.name} {manifest.version} of the URL; "
                "choose another --out"
            )
    elif out.exists() and (not out.is_dir() or any(path.suffix != files.PARTIAL for path in _strangers(out, manifest))):
        raise StoreError(f"{out} is not empty and holds no release; choose an empty or new folder for --out")


def _strangers(out: Path, manifest: Manifest) -> Iterable[Path]:
    """What lies in a folder and is no part of an interrupted fetch."""
    ours = {record.name.split("/")[0] for record in manifest.subsets} | {
        "policies",
        "commits",
        "backgrounds",
        CARD_FOLDER,
        LOCK,
    }
    return (path for path in out.iterdir() if path.name not in ours | set(CARD_FILES))


def _check_room(out: Path, files: list[FileRecord]) -> None:
    needed, free = sum(file.bytes for file in files), shutil.disk_usage(out).free
    if needed > free:
        raise StoreError(
            f"{needed / 1e9:.1f} GB are to be fetched and {free / 1e9:.1f} GB are free at "
            f"{out}; make room, choose another --out, or fetch less with --only and --episodes"
        )


def _write_part(out: Path, source: Source, only, episodes) -> None:
    """A manifest that says that this is a part, and which: what is here while files come, and until all are."""
    parts = []
    if (out / MANIFEST).is_file():
        parts = [entry for entry in parse_manifest((out / MANIFEST).read_bytes()).lineage if entry["kind"] == "fetch"]
    entry = {
        "kind": "fetch",
        "from": source.place,
        "manifest_sha256": source.index.manifest_sha256,
        "digest": source.manifest.digest,
        "only": list(only),
        "episodes": list(episodes) if episodes else None,
    }
    if entry not in parts:
        parts.append(entry)
    facts = {"lineage": (*source.manifest.lineage, *parts), "complete": False, "digest": None}
    (out / INDEX).unlink(missing_ok=True)
    files.write_json(out / MANIFEST, source.manifest.model_copy(update=facts))
    for record in source.manifest.subsets:
        if (out / subset_path(record.name)).is_dir():
            mark_created(out, record)


def _finish(out: Path, source: Source) -> None:
    """The release's own manifest and index where everything is here; else digests of the part."""
    commits = {record.name: read_commits(out, record) for record in source.manifest.subsets}
    if all(len(commits[record.name]) == shard_count(record) for record in source.manifest.subsets):
        files.write_bytes(out / INDEX, source.index_text)
        files.write_bytes(out / MANIFEST, source.manifest_text)
        return
    write_release(out, parse_manifest((out / MANIFEST).read_bytes()), commits)
