"""Compute a digest of every file of a release (`files.json`), and one root digest of them all.

`files.json` lists every file but itself and the manifest, holds the digest of the manifest's bytes, and a digest of its
own content. The root digest is over the lines "<sha256>  <path>" of all data files in the order of their paths, the
manifest among them (but for that digest, which it holds). It is the same wherever the same data were made: what names
the machine, the manifest's environments and the shards' commit records, is listed with a digest, but no part of it.
Nor are the card's files, which speak of the root digest::

    files.json --digests--> shards, commit records, zarr.json, policies, card
               --digest---> manifest.json --root digest--> shards, zarr.json, policies, the manifest's own content
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal

import pydantic

from dmcvb_gen import files
from dmcvb_gen.dataset.manifest import (
    MANIFEST,
    CommitRecord,
    Digest,
    FileRecord,
    Manifest,
    SubsetRecord,
    commit_path,
    subset_path,
)
from dmcvb_gen.dataset.sharing import link_equal_files
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.remote import is_url, storage_errors
from dmcvb_gen.text import quoted

ZARR_JSON = "zarr.json"
INDEX = "files.json"
CLAIM = "publishing.json"
"""At a URL while a publisher is at work: which release it puts there."""
CARD_FILES = ("README.md", "CHANGELOG.md", "LICENSE", "croissant.json")
COMMITS = "commits/"
"""Folder of the shards' records, which name the machine that made them."""
POLICIES = "policies/"
"""Folder of a release's own copies of policies."""
VIDEOS = "backgrounds/"
"""Folder of a release's own copies of videos, one folder a digest."""
CARD_FOLDER = "card"
"""Pictures and tables of the card."""


class Index(pydantic.BaseModel):
    """files.json: every file of a release but its manifest and itself.

    Attributes:
      manifest_sha256: digest of the manifest's bytes.
      files: files in the order of their paths.
      sha256: of this index's content; None in releases of version 1.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)
    format: Literal["dmcvb-gen files"] = "dmcvb-gen files"
    manifest_sha256: Digest
    files: tuple[FileRecord, ...]
    sha256: Digest | None = None

    @property
    def own_digest(self) -> str:
        """The digest that `sha256` must be."""
        return files.sha256_bytes(files.json_bytes(self.model_copy(update={"sha256": None})))

    def with_checksum(self) -> Index:
        """Return a copy that states its own digest."""
        return self.model_copy(update={"sha256": self.own_digest})


def is_card(path: str) -> bool:
    """Return True if a file of a release belongs to its card."""
    return path in CARD_FILES or path.startswith(f"{CARD_FOLDER}/")


def is_video(path: str) -> bool:
    """Return True if a file of a release belongs to its copies of videos."""
    return path.startswith(VIDEOS)


def is_replaced(path: str) -> bool:
    """Return True if the next version of a release may replace a file: metadata of growing arrays, and the card."""
    return path.endswith("/zarr.json") or is_card(path)


def keeps(index: Index, before: Iterable[FileRecord]) -> bool:
    """Return True if a release has all files of an older version, byte for byte, except those that growing replaces."""
    now = set(index.files)
    return all(file in now or is_replaced(file.path) for file in before)


def parse_index(text: bytes, where: str = INDEX) -> Index:
    """An index from JSON.

    Raises:
      StoreError: it is not valid, or its content does not have its digest.
    """
    try:
        index = Index.model_validate_json(text)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the top"
        raise StoreError(f"{where} is not valid at {place}: {first['msg']}") from None
    if index.sha256 is not None and (index.own_digest != index.sha256 or files.json_bytes(index) != text):
        raise StoreError(f"{where} does not have its own digest; fetch it again")
    return index


def read_index(root: Path) -> Index | None:
    """A local release's index; None if there is none (while it is made, and in releases of version 1).

    Raises:
      StoreError: it is damaged.
    """
    path = root / INDEX
    if not path.is_file():
        return None
    with storage_errors(path):
        return parse_index(path.read_bytes(), str(path))


def root_digest(listed: Iterable[FileRecord], manifest: Manifest) -> str:
    """The one digest of a release, see the module; the same wherever the same data were made."""
    bare = files.sha256_bytes(files.json_bytes(manifest.model_copy(update={"digest": None, "environments": ()})))
    lines = {f.path: f.sha256 for f in listed if not (is_card(f.path) or f.path.startswith(COMMITS))} | {MANIFEST: bare}
    digest = hashlib.sha256()
    for path in sorted(lines):
        digest.update(f"{lines[path]}  {path}\n".encode())
    return digest.hexdigest()


def data_files(root: Path, manifest: Manifest, commits: dict[str, dict[int, CommitRecord]]) -> list[FileRecord]:
    """Every file that a release's data are made of, but manifest and index; shards as their records say.

    Args:
      commits: subset -> shard -> record of the shards that are there.

    Raises:
      StoreError: a file is missing or cannot be read.
    """
    found = {file.path: file for shards in commits.values() for commit in shards.values() for file in commit.files}
    names = [commit_path(name, shard) for name, shards in commits.items() for shard in shards]
    for record in manifest.subsets:
        names += metadata_paths(root, record)
        if commits.get(record.name):
            names += [policy.path for policy in record.policies if policy.path]
            names += video_paths(root, record)
    for name in dict.fromkeys(names):
        found[name] = _record(root, name)
    return [found[name] for name in sorted(found)]


def metadata_paths(root: Path, record: SubsetRecord) -> list[str]:
    """Paths of a subset's zarr.json files that are there."""
    folder = root / subset_path(record.name)
    here = [path for pattern in (ZARR_JSON, f"*/{ZARR_JSON}", f"*/*/{ZARR_JSON}") for path in folder.glob(pattern)]
    return [path.relative_to(root).as_posix() for path in sorted(here)]


def video_paths(root: Path, record: SubsetRecord) -> list[str]:
    """Paths of a release's own copies of the videos that a subset shows."""
    source = (record.backgrounds or {}).get("source", "")
    if not str(source).startswith(VIDEOS):
        return []
    return sorted(path.relative_to(root).as_posix() for path in (root / source).rglob("*") if path.is_file())


def card_files(root: Path) -> list[FileRecord]:
    """The files of the card that are there."""
    names = [name for name in CARD_FILES if (root / name).is_file()]
    whole = sorted(path for path in (root / CARD_FOLDER).glob("[!.]*") if path.is_file())  # hidden: in the making
    names += [f"{CARD_FOLDER}/{path.name}" for path in whole]
    return [_record(root, name) for name in names]


def _record(root: Path, name: str) -> FileRecord:
    path = root / name
    if not path.is_file():
        raise StoreError(f"{path} is missing; run `dmcvb-gen regenerate {quoted(root)}` first")
    with storage_errors(path):
        return FileRecord(path=name, bytes=path.stat().st_size, sha256=files.sha256_file(path))


def write_release(root: Path, manifest: Manifest, commits: dict[str, dict[int, CommitRecord]]) -> Manifest:
    """Give a release its digests: write `files.json`, then the manifest with the root digest. Equal files become links.

    Raises:
      StoreError: a file is missing, or the folder cannot be written.
    """
    with storage_errors(root, "write to"):
        link_equal_files(root, manifest, commits)
        listed = data_files(root, manifest, commits)
        manifest = manifest.model_copy(update={"digest": root_digest(listed, manifest)})
        everything = sorted([*listed, *card_files(root)], key=lambda file: file.path)
        text = files.json_bytes(manifest)
        index = Index(manifest_sha256=files.sha256_bytes(text), files=tuple(everything)).with_checksum()
        files.write_json(root / INDEX, index)
        files.write_bytes(root / MANIFEST, text)
    return manifest


def take_in_card(root: Path) -> None:
    """List the card's files, as they are now, in a release's index (if it has one)."""
    index = read_index(root)
    if index is None or index.sha256 is None:
        return
    others = [file for file in index.files if not is_card(file.path)]
    everything = sorted([*others, *card_files(root)], key=lambda file: file.path)
    with storage_errors(root, "write to"):
        files.write_json(root / INDEX, index.model_copy(update={"files": tuple(everything)}).with_checksum())


def trusted_index(root: Path, manifest: Manifest) -> Index | None:
    """A local release's index, if it has its own digest and gives the manifest's root digest; else None."""
    try:
        index = read_index(root)
    except StoreError:
        return None
    if index is None or index.sha256 is None or root_digest(index.files, manifest) != manifest.digest:
        return None
    return index


def metadata_files(index: Index) -> list[FileRecord]:
    """Files of a release that no shard's record holds a digest of: arrays' metadata, policies, videos."""
    return [
        file for file in index.files if file.path.endswith(f"/{ZARR_JSON}") or file.path.startswith((POLICIES, VIDEOS))
    ]


def refuse_altered(listed: Iterable[FileRecord], digest: Callable[[str], str | None], place: str) -> None:
    """Refuse a release whose files differ from its old digests: new digests would declare the damage right.

    Args:
      listed: the release's present files, see `metadata_files`.
      digest: digest of a path in the release, None if nothing is.

    Raises:
      StoreError: one of them is missing, or not what it was.
    """
    for file in listed:
        found = digest(file.path)
        if found != file.sha256:
            what = "is damaged" if found else "is missing"
            cure = "put it there from a copy" if is_url(place) else f"dmcvb-gen regenerate {quoted(place)}"
            raise StoreError(f"{file.path} of {place} {what}; mend it first: {cure}")


def refuse_altered_folder(root: Path, manifest: Manifest) -> None:
    """See `refuse_altered`; `manifest` is the one in the folder.

    Raises:
      StoreError: see there, or the index is damaged.
    """
    if manifest.digest is None or not (root / INDEX).is_file():
        return
    index = trusted_index(root, manifest)
    if index is None and not manifest.complete:
        return  # writing it may have been interrupted, and it is written again
    if index is None:
        raise StoreError(f"{root / INDEX} is damaged; mend it first: dmcvb-gen regenerate {quoted(root)}")

    def digest(path: str) -> str | None:
        with storage_errors(root / path):
            return files.sha256_file(root / path) if (root / path).is_file() else None

    refuse_altered(metadata_files(index), digest, str(root))


def restore_index(root: Path, manifest: Manifest, commits: dict[str, dict[int, CommitRecord]]) -> bool:
    """Write a missing or damaged index again, if the files that are here give the root digest of the manifest.

    Returns:
      True if it was written.
    """
    if manifest.digest is None or trusted_index(root, manifest) is not None:
        return False
    listed = data_files(root, manifest, commits)
    if root_digest(listed, manifest) != manifest.digest:
        return False
    everything = sorted([*listed, *card_files(root)], key=lambda file: file.path)
    digest = files.sha256_file(root / MANIFEST)
    files.write_json(root / INDEX, Index(manifest_sha256=digest, files=tuple(everything)).with_checksum())
    return True


def restored_commit(root: Path, manifest: Manifest, commit: CommitRecord) -> CommitRecord:
    """The record of a shard that was made again with the bytes that it had: as it was, if that can be known.

    Only the environment of a lost record is unknown; it is one of the manifest's, and the index has its digest.
    """
    path = commit_path(commit.subset, commit.shard)
    try:
        index = read_index(root)
    except StoreError:
        index = None
    digests = {file.path: file.sha256 for file in index.files} if index else {}
    for environment in manifest.environments if manifest.digest else ():
        found = commit.model_copy(update={"environment": environment})
        if digests.get(path) == files.sha256_bytes(files.json_bytes(found)) or len(manifest.environments) == 1:
            return found
    return commit
