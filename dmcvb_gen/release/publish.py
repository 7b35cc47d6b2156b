"""Publish a release at a URL: every file, the manifest last. `release.fetch` downloads it.

What lies at the URL is the release's folder and two files more: `files.json` (every file with its digest, and the
digest of the manifest that it belongs to) and, while a publisher is at work, `publishing.json` (its claim). A folder
without a manifest is no release, so readers never see half of one.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.dataset.append import is_grown_from
from dmcvb_gen.dataset.index import (
    CARD_FILES,
    CLAIM,
    INDEX,
    Index,
    card_files,
    data_files,
    is_card,
    is_replaced,
    keeps,
    parse_index,
    read_index,
)
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    FileRecord,
    Manifest,
    parse_manifest,
    shard_count,
)
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.dataset.shards import wrong_bytes
from dmcvb_gen.dataset.writer import read_commits
from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.release.export.publishing import export_format, publish_export
from dmcvb_gen.release.fetch import Moved
from dmcvb_gen.storage import Storage, open_storage
from dmcvb_gen.storage.remote import storage_errors
from dmcvb_gen.text import quoted


def index_of(root: Path, manifest: Manifest) -> Index:
    """The index of a complete release: its own, or one made now for a release of version 1.

    Raises:
      StoreError: a file is missing, or manifest and index do not belong together.
    """
    commits = {record.name: read_commits(root, record) for record in manifest.subsets}
    for record in manifest.subsets:
        if len(commits[record.name]) != shard_count(record):
            raise StoreError(
                f"{record.name} has damaged or missing shards; run `dmcvb-gen regenerate {quoted(root)}` first"
            )
    with storage_errors(root / MANIFEST):
        digest = files.sha256_file(root / MANIFEST)
    index = read_index(root)
    if index is None:
        listed = sorted([*data_files(root, manifest, commits), *card_files(root)], key=lambda file: file.path)
        return Index(manifest_sha256=digest, files=tuple(listed)).with_checksum()
    if index.manifest_sha256 != digest:
        raise StoreError(f"{root / MANIFEST} does not have the digest that {INDEX} says; `dmcvb-gen verify` says more")
    return index


def publish_folder(
    path: str | Path,
    url: str,
    *,
    pixels: bool = True,
    take_over: bool = False,
    repair: bool = False,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    tick: ProgressCallback = ignore,
) -> Moved:
    """Put a complete release, or an export, at a URL; run again after an interruption, it resumes.

    Args:
      url: s3://bucket/name, gs://, hf://datasets/owner/name, file: or any fsspec URL.
      pixels: False leaves the images out; `paint` renders them again.
      take_over: publish even if another upload has claimed the URL.
      repair: see `publish`.
      options: options of fsspec; credentials belong in the environment.
      workers: parallel transfers.
      tick: called with 1 for each file.

    Raises:
      StoreError: as `publish.publish` does, or an option of releases was given for an export.
    """
    if not (Path(path) / MANIFEST).exists() and export_format(path) is not None:
        if not pixels or take_over or repair:
            raise StoreError(
                "--no-pixels, --take-over and --repair are for releases, and this is an export: remove them"
            )
        return publish_export(path, url, options=options, workers=workers, tick=tick)
    with contextlib.nullcontext(path) if pixels else light_copy(path) as sent:
        return publish(sent, url, options=options, take_over=take_over, repair=repair, workers=workers, tick=tick)


@contextlib.contextmanager
def light_copy(path: str | Path) -> Iterator[str]:
    """A copy (of links) of a release without its pictures, beside it, with a card of its own if the release has one."""
    from dmcvb_gen.generate.paint import without_pictures  # the simulator, which publishing as it is does not need
    from dmcvb_gen.release.card import README, write_card

    folder = Path(path)
    beside = folder.resolve().parent
    files.remove_partial(beside, below=False)  # what a killed publish left
    with contextlib.ExitStack() as stack:
        with storage_errors(folder, "write beside"):
            light = str(stack.enter_context(files.folder_in_the_making(beside, f"{folder.name}-light")))
        without_pictures(folder, light)
        if (folder / README).is_file():
            with storage_errors(folder):
                for name in CARD_FILES:  # the day and the place, the changes so far
                    if name != README and (folder / name).is_file():
                        shutil.copyfile(folder / name, Path(light) / name)
            write_card(light)
        yield light


def publish(
    root: str | Path,
    url: str,
    *,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    take_over: bool = False,
    repair: bool = False,
    tick: ProgressCallback = ignore,
) -> Moved:
    """Put a complete release at a URL; run again after an interruption, it goes on.

    Args:
      url: s3://bucket/name, gs://, hf://datasets/owner/name, file: or any fsspec URL; it becomes the release's folder.
      options: options of fsspec (endpoint_url, ...); credentials belong in the environment.
      take_over: go on although another publisher's claim is there (it crashed, and its release was another).
      repair: compare published files by their digests, not by their sizes, and replace those that differ. Storages
        that do not know digests are read.
      tick: called with 1 for each file.

    Raises:
      StoreError: the release is not complete or damaged; another version or publisher is there; access is refused;
        a file could not be moved.
    """
    root, manifest = load_manifest(root)
    if not manifest.complete:
        raise StoreError(
            f"{root} is not complete; fetch the rest, or finish it with the same rollout, without --only or --part"
        )
    index = index_of(root, manifest)
    total = sum(file.bytes for file in index.files)
    _check_card(root, manifest, index)
    storage, tag = open_storage(url, options), (f"v{manifest.version}", f"{manifest.name} {manifest.version}")
    storage.begin()
    before, same = _published(storage, index, manifest)
    kept = set() if repair else _kept(storage, before or ())
    if same and set(index.files) <= kept:
        storage.tag(*tag)
        _withdraw(storage, index.manifest_sha256)
        return Moved(len(index.files), total, 0)
    if before is None and not take_over and storage.read(CLAIM) is None:
        _refuse_others(storage, index)
    fresh = storage.needs_claim and _claim(storage, index.manifest_sha256, manifest, take_over)
    fresh = fresh and before is None and storage.read(INDEX) is None
    todo = [file for file in index.files if file not in kept]
    expect(tick, len(todo))
    moved = sum(storage.upload_all(root, part, workers, tick, fresh) for part in _in_order(todo))
    last = {INDEX: files.json_bytes(index)}
    if not same:
        with storage_errors(root / MANIFEST):
            last[MANIFEST] = (root / MANIFEST).read_bytes()
    if not storage.write_last(last, new=before is None):
        _published(storage, index, manifest)  # another one's raises
    storage.tag(*tag)
    _withdraw(storage, index.manifest_sha256)
    return Moved(len(index.files), total, moved)


def _check_card(root: Path, manifest: Manifest, index: Index) -> None:
    """Refuse a card that was changed by hand, or is of another version: a release that has grown since."""
    page = root / "README.md"
    with storage_errors(root):
        for file in index.files:
            if is_card(file.path) and wrong_bytes(root, file):
                raise StoreError(
                    f"{root / file.path} does not have its digest; run `dmcvb-gen card {quoted(root)}` first"
                )
        unlisted = {file.path for file in card_files(root)} - {file.path for file in index.files}
        if unlisted:
            raise StoreError(
                f"{root / min(unlisted)} is not part of the release yet; run `dmcvb-gen card {quoted(root)}` first, or "
                "move it elsewhere"
            )
        known = page.is_file() and manifest.digest  # of version 1 there is none
        old = known and str(manifest.digest) not in page.read_text(errors="replace")
    if old:
        raise StoreError(f"the card of {root} is of another version; run `dmcvb-gen card {quoted(root)}` first")


def _refuse_others(storage: Storage, index: Index) -> None:
    """Refuse a place without a release that has files of something else, which ours would replace or lie among.

    Files of ours may be there, of an interrupted try or of a release whose manifest was deleted. The Hub makes a README
    of its own.
    """
    ours = {file.path: file.bytes for file in index.files}
    others = sorted(
        path
        for path, file in storage.list().items()
        if path not in (INDEX, CLAIM) and (path not in ours or (is_card(path) and file.bytes not in (None, ours[path])))
    )
    if not storage.needs_claim:
        others = [path for path in others if path not in CARD_FILES]
    if others:
        more = f" and {len(others) - 1} more" if others[1:] else ""
        raise StoreError(f"{storage.place} holds {others[0]}{more}, and no release; give an empty or a new place")


def _in_order(todo: Sequence[FileRecord]) -> list[list[FileRecord]]:
    """Files in the order in which they go up: new ones first, then those that take the place of an older version's."""
    parts = [[file for file in todo if is_replaced(file.path) is late] for late in (False, True)]
    return [part for part in parts if part]


def _published(storage: Storage, index: Index, manifest: Manifest) -> tuple[tuple[FileRecord, ...] | None, bool]:
    """The files that are listed there, and whether the manifest there is this one, not one that it has grown from.

    Returns:
      (files, same); (None, False) if no release is.

    Raises:
      StoreError: another release is there.
    """
    place, found = storage.place, storage.read(MANIFEST)
    if found is None:
        return None, False
    if files.sha256_bytes(found) == index.manifest_sha256:
        try:
            return parse_index(storage.read(INDEX) or b"", f"{place}/{INDEX}").files, True
        except StoreError:  # damaged, and put there again
            return (), True
    what = "something else"
    try:
        other = parse_manifest(found, f"{place}/{MANIFEST}")
        what = f"{other.name} {other.version}"
        if is_grown_from(manifest, other):
            before = parse_index(storage.read(INDEX) or b"", f"{place}/{INDEX}").files
            if keeps(index, before):
                return before, False
    except StoreError:
        pass
    raise StoreError(
        f"{place} already holds {what}, and a published version never changes; publish {manifest.name} "
        f"{manifest.version} to another URL (a changed byte is a new version)"
    )


def _kept(storage: Storage, listed: Sequence[FileRecord]) -> set[FileRecord]:
    """Return those listed files that are there at their size: others were deleted since, and are sent again."""
    if not listed or not storage.lists_sizes:
        return set(listed)
    there = storage.list()
    return {file for file in listed if file.path in there and there[file.path].bytes == file.bytes}


def _claim(storage: Storage, digest: str, manifest: Manifest, take_over: bool) -> bool:
    """Say that this release is being published there; True if nobody had begun to.

    Raises:
      StoreError: another release is being published there.
    """
    mine = {"name": manifest.name, "version": manifest.version, "manifest_sha256": digest}
    data = json.dumps(mine).encode()
    found = None if storage.create(CLAIM, data) else storage.read(CLAIM)
    if found is None or found == data:
        return found is None  # else ours, from an interrupted try: the files that are there already are kept
    if take_over or _claimed_by(found) == files.sha256_bytes(storage.read(MANIFEST) or b""):  # it has ended
        storage.write(CLAIM, data)
        return False
    try:
        other = json.loads(found)
        what = f"{str(other['name'])[:80]} {str(other['version'])[:20]}"
    except (ValueError, KeyError, TypeError):
        what = "another release"
    raise StoreError(
        f"{what} is being published to {storage.place} by someone else; choose another URL, or --take-over if that "
        "publisher is gone"
    )


def _claimed_by(claim: bytes | None) -> str | None:
    """The digest of the manifest in a claim; None if it is none."""
    try:
        return str(json.loads(claim or b"")["manifest_sha256"])
    except (ValueError, KeyError, TypeError):
        return None


def _withdraw(storage: Storage, digest: str) -> None:
    """Remove the claim of a publication that has ended, in this run or in one that was killed right before."""
    if storage.needs_claim and _claimed_by(storage.read(CLAIM)) == digest:
        storage.remove(CLAIM)
