"""Put a release at a URL: what its manifest names is created, and the manifest comes last.

Two publishers of one release create equal files; of two releases, the manifest of the one that is slower is refused.
"""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import (
    ATTACHMENT_FILES,
    COPY,
    MANIFEST,
    MANIFEST_BYTES,
    MANIFESTS,
    FileRecord,
    canonical_json,
)
from dmcvb_gen.dataset.writer import copy_of, plain_metadata, wrong_bytes
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.options import Count, Location, checked, progress_bar
from dmcvb_gen.parallel import ProgressCallback, expect
from dmcvb_gen.release.fetch import Moved
from dmcvb_gen.release.tree import attachments, check_apart, described_files, list_files, manifest_at
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.text import pluralize, quoted

_log = logging.getLogger("dmcvb_gen")
README = ATTACHMENT_FILES[0]


@checked
def publish(
    release: Location,
    url: str,
    *,
    storage_options: dict[str, Any] | None = None,
    repair: bool = False,
    workers: Count = 8,
    pixels: bool = True,
    progress: bool = True,
) -> Moved:
    """Put a complete release at a URL: every file checked, the manifest last.

    Args:
      release (RELEASE): Folder of the release.
      url (URL): Where to put it: s3://, gs://, az://, hf:// or file:.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      repair: Compare published files by their digests, and replace those that differ.
      workers: Parallel transfers.
      pixels: False: Publish without images; `paint` renders them again. Images that are there stay.

    Raises:
      StoreError: the release is not complete or damaged; the URL is its own folder; another version is there; access is
        refused; a file could not be moved.
    """
    with progress_bar(progress, " files", scaled=False) as bar:
        return _publish_release(release, open_store(url, storage_options), pixels, repair, workers, bar)


def _publish_release(
    root: str | Path, store: Store, pixels: bool, repair: bool, workers: int, tick: ProgressCallback
) -> Moved:
    release = Release.open(root, own_images=False)
    _check_complete(release, root, pixels)
    check_apart(release, store, "choose another URL")
    if not release.copy and (lacking := release.unfinished):
        some = pluralize(len(lacking), "subsets")
        _log.warning("%s is not finished: episodes or images of %s stay unpublished, e.g. %s", root, some, min(lacking))
    card = release.store.find(README, MANIFEST_BYTES)
    if card and (str(release.digest).encode() not in card or (b"This is a part of" in card and not release.unfinished)):
        _log.warning("%s/%s is no card of this version; `dmcvb-gen card %s` writes one", root, README, root)
    text, texts = release.text, dict(attachments(release.store))
    store.begin()
    tag = store.version(MANIFEST)
    there = manifest_at(store, release)
    if there is not None and there != text:
        texts[f"{MANIFESTS}{sha256_bytes(there)}.json"] = there  # what it replaces can still be cited
    upload = _Upload(release, store, repair, workers, tick)
    chosen = {shard.record_path for shard in release.shards(images=pixels)} | upload.sizes.keys()
    shards = [shard for shard in release.shards() if shard.record_path in chosen]
    light = copy_of(release, shards)
    names = [record.name for record in release.manifest.subsets]
    parts: list[Sequence[FileRecord]] = [
        [*described_files(release, names), *(file for shard in shards for file in shard.files)],
        [shard.record_file for shard in shards],
        list_files(release, release.layers),
    ]
    files = [file for part in parts for file in part]
    expect(tick, len(files))
    for part in parts:
        upload.put(part)
    if light.copy:
        texts[COPY] = canonical_json(light.copy)
    elif store.size(COPY) is not None:
        store.delete(COPY)  # of images that were left out before
    plain = plain_metadata(light)
    if there != text or upload.moved or _differ(store, texts):
        if not store.writable:  # one commit
            texts |= plain
        if not store.finish(texts | {MANIFEST: text}, expected=tag):
            raise StoreError(f"{store.place} was published to by another process meanwhile; run the command again")
    if store.writable:
        with ThreadPoolExecutor(max(1, workers)) as pool:
            list(pool.map(store.replace, plain.keys(), plain.values()))
    store.tag(f"v{release.manifest.version}", f"{release.manifest.name} {release.manifest.version}")
    return Moved(len(files), sum(file.bytes for file in files), upload.moved)


def _check_complete(release: Release, root: str | Path, pixels: bool) -> None:
    """Raises StoreError if something that is to be published is not here, or cannot be left out."""
    if release.in_the_making or (release.copy and not all(s.here for s in release.shards(images=pixels))):
        cure = "fetch or render the rest" if release.copy else "finish it with the same rollout, without --only"
        raise StoreError(f"{root} is not complete; {cure}")
    if not pixels and release.manifest.imported:
        raise StoreError(
            f"{root} was imported, and its images cannot be rendered; publish it with them, without --no-pixels"
        )


def _differ(store: Store, texts: Mapping[str, bytes]) -> bool:
    """Return True if an attachment at a place is another one than here."""
    return any(store.size(path) != len(data) or store.read(path, len(data)) != data for path, data in texts.items())


class _Upload:
    """Files of a release on their way to a place.

    Attributes:
      sizes: path -> bytes of what is there already.
      moved: how many files were sent.
    """

    def __init__(self, release: Release, store: Store, repair: bool, workers: int, tick: ProgressCallback):
        self._release, self._store, self._repair, self._workers, self._tick = release, store, repair, workers, tick
        self.sizes = store.list()
        self.moved = 0

    def put(self, files: Sequence[FileRecord]) -> None:
        """Send the files that are not there yet; those of the right size are assumed to be.

        Raises:
          StoreError: a file here is damaged, or one there has other bytes.
        """
        known = self._each(self._store, files) if self._repair else {}
        todo = [file for file in files if known.get(file.path) or self.sizes.get(file.path) != file.bytes]
        self._tick(len(files) - len(todo))
        for path, wrong in self._each(self._release.store, todo).items():
            if wrong:
                cure = f"`dmcvb-gen regenerate {quoted(self._release.place)}` repairs it"
                raise StoreError(f"{self._release.place}/{path} {wrong}; {cure}")
        there = [file for file in todo if file.path in self.sizes]
        if there and not self._repair:
            raise StoreError(
                f"{self._store.place}/{there[0].path} has {self.sizes[there[0].path]} bytes instead of "
                f"{there[0].bytes}; replace what is damaged with --repair"
            )
        for file in there:
            self._store.delete(file.path)
        late = {*self._store.upload(self._release.path, [file.path for file in todo], self._workers, self._tick)}
        for path, wrong in self._each(self._store, [file for file in todo if file.path in late]).items():
            if wrong:  # another process put it there meanwhile
                raise StoreError(f"{self._store.place}/{path} {wrong}; replace what is damaged with --repair")
        self.moved += len(todo)

    def _each(self, store: Store, files: Sequence[FileRecord]) -> dict[str, str | None]:
        """Path -> what is wrong with a file at a place."""
        with ThreadPoolExecutor(max(1, self._workers)) as pool:
            found = pool.map(lambda file: wrong_bytes(store, file), files)
            return {file.path: wrong for file, wrong in zip(files, found, strict=True)}
