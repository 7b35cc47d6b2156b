"""Releases that this package describes but does not hold: their manifests, found by name.

A manifest promises a digest for each subset; the list beside it promises one for each shard. So any part of such a
release can be made anywhere, and each of its shards is compared with the released one. The archive in the folder of a
release's card has the index in place of that list, with a digest for each file; it is ten times as large.
"""

from __future__ import annotations

import contextlib
import io
import lzma
import re
import tarfile
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import pydantic

from dmcvb_gen.dataset.manifest import MANIFEST, Digest, FileRecord, Manifest, shard_count, subset_path
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import json_bytes, sha256_bytes

if TYPE_CHECKING:
    from dmcvb_gen.dataset.index import Index

_FOLDER = resources.files("dmcvb_gen.generate") / "data" / "manifests"
ENDING = ".tar.xz"
SHARDS = "shards.json"
DIGESTS = "digests"
"""Member of an archive with the 32 bytes of each digest of the others, as they come; in text, digests
take more room even compressed."""
MEMBERS = (MANIFEST, "files.json", SHARDS, DIGESTS)
"""What an archive may hold; files.json is the index, of which only the name is needed here."""
LARGEST_MEMBER = 1 << 28
"""Bytes; dmcvb-v1's index has a tenth of it."""
_DIGEST = re.compile(rb"[0-9a-f]{64}")
_NEW, _KNOWN = b"\0", b"\1"
"""Bytes that JSON never holds: the next digest of `DIGESTS`, or the one whose number follows in three bytes."""
_PLACES = re.compile(rb"\x00|\x01(...)", re.DOTALL)


class ShardDigests(pydantic.BaseModel):
    """shards.json: a digest for each shard of a release, in place of an index with one for each file.

    Attributes:
      manifest_sha256: digest of the manifest's bytes.
      subsets: subset -> digests of its shards in their order, see `shard_digest`.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)
    format: Literal["dmcvb-gen shards"] = "dmcvb-gen shards"
    manifest_sha256: Digest
    subsets: dict[str, tuple[Digest, ...]]


def shard_digest(files: Iterable[FileRecord]) -> str:
    """One SHA-256 over the digests of a shard's files, in the order of their paths."""
    lines = sorted((file.path, file.sha256) for file in files)
    return sha256_bytes("".join(f"{digest}  {path}\n" for path, digest in lines).encode())


def read_shard_digests(root: Path) -> Mapping[str, tuple[str, ...]]:
    """Subset -> digests of its shards, from the shards.json beside a manifest; empty if there is none for it."""
    try:
        found = ShardDigests.model_validate_json((root / SHARDS).read_bytes())
    except (OSError, pydantic.ValidationError):
        return {}
    return found.subsets if found.manifest_sha256 == sha256_bytes((root / MANIFEST).read_bytes()) else {}


def shipped_manifests() -> tuple[str, ...]:
    """Names of the releases whose manifests are in the package."""
    names = [path.name for path in _FOLDER.iterdir()]
    return tuple(sorted(name.removesuffix(ENDING) for name in names if name.endswith(ENDING)))


@contextlib.contextmanager
def manifest_source(source: str | Path) -> Iterator[Path]:
    """A manifest's file or, for the name of a shipped one or an archive, a folder with the manifest and its digests.

    Raises:
      UnknownNameError: a plain name that is neither a file nor a shipped manifest's.
      StoreError: there is no such file.
    """
    path, name = Path(source), str(source)
    if path.is_file() and not name.endswith(ENDING):
        yield path
        return
    if path.is_dir() and name not in shipped_manifests():
        raise StoreError(f"{path} is a folder; give it without --manifest, or the file {path / MANIFEST}")
    if not path.is_file() and (path.suffix or path.name != name):
        raise StoreError(f"{path} is not there; give a manifest's file or a name: {', '.join(shipped_manifests())}")
    if not path.is_file() and name not in shipped_manifests():
        raise UnknownNameError("manifest", name, shipped_manifests())
    with contextlib.ExitStack() as stack:
        if not path.is_file():
            path = stack.enter_context(resources.as_file(_FOLDER / f"{name}{ENDING}"))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for member, content in unpack(path).items():
            (folder / member).write_bytes(content)
        yield folder


def with_shard_digests(manifest: Manifest, index: Index) -> dict[str, bytes]:
    """Members of the archive that the package ships for a release: its manifest and `SHARDS`."""
    listed: dict[str, list[FileRecord]] = {}
    for file in index.files:
        listed.setdefault(_shard_of(file.path), []).append(file)
    subsets = {}
    for record in manifest.subsets:
        shards = range(shard_count(record))
        subsets[record.name] = tuple(shard_digest(listed[f"{subset_path(record.name)}/{shard}"]) for shard in shards)
    content = json_bytes(manifest)
    shards_json = json_bytes(ShardDigests(manifest_sha256=sha256_bytes(content), subsets=subsets))
    return {MANIFEST: content, SHARDS: shards_json}


def _shard_of(path: str) -> str:
    """ "<subset's folder>/<shard>" for a chunk of a shard; another file's own path."""
    folder, _, rest = path.partition(".zarr/")
    _, found, chunk = rest.partition("/c/")
    return f"{folder}.zarr/{chunk.split('/')[0]}" if found else path


def read_complete(release: str | Path) -> tuple[Manifest, Index]:
    """The manifest and index of a complete release on this machine, of which the data need not be there.

    Raises:
      StoreError: the release is not complete, or what is there has no index.
    """
    from dmcvb_gen.dataset.index import trusted_index  # loads zarr, which names need not
    from dmcvb_gen.dataset.reader import load_manifest

    root, manifest = load_manifest(release)
    if (root / SHARDS).is_file():
        raise StoreError(
            f"the package has no digests of the files of {manifest.name}; give the release's folder, or the archive "
            f"dataset_cards/{manifest.name}/files{ENDING} of the repository"
        )
    index = trusted_index(root, manifest)
    if not manifest.complete or index is None:
        raise StoreError(f"{root} is not complete; finish it with the command that began it")
    return manifest, index


def pack(members: Mapping[str, bytes], out: str | Path) -> int:
    """Write an archive; return its size in bytes.

    Args:
      members: the bytes of a manifest and of its index or `SHARDS`, by their names.
    """
    known: dict[bytes, int] = {}
    shortened = {name: _without_digests(content, known) for name, content in members.items()}
    shortened[DIGESTS] = b"".join(bytes.fromhex(digest.decode()) for digest in known)
    # One stream, because both have much in common; without times, so that equal releases give equal archives.
    with lzma.open(out, "wb", preset=9 | lzma.PRESET_EXTREME) as packed:
        with tarfile.open(fileobj=packed, mode="w") as archive:
            for name, content in shortened.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
    return Path(out).stat().st_size


def unpack(archive: str | Path) -> dict[str, bytes]:
    """The bytes of an archive's members, by their names, see `pack`.

    Raises:
      StoreError: it is no such archive, or damaged.
    """
    try:
        with tarfile.open(archive, "r:xz") as file:
            members = {member.name: _content(file, member) for member in file}
        data = members.pop(DIGESTS).hex().encode()
        digests = [data[place : place + 64] for place in range(0, len(data), 64)]
        fresh = iter(digests)

        def digest(found: re.Match[bytes]) -> bytes:
            return digests[int.from_bytes(found[1], "big")] if found[1] else next(fresh)

        return {name: _PLACES.sub(digest, content) for name, content in members.items()}
    except (OSError, tarfile.TarError, lzma.LZMAError, EOFError, LookupError, ValueError, StopIteration) as error:
        raise StoreError(
            f"{archive} is no archive of a manifest, or damaged ({error or type(error).__name__}); take it again from "
            "the repository's dataset_cards"
        ) from None


def _content(archive: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    if member.name not in MEMBERS or not member.isfile() or member.size > LARGEST_MEMBER:
        raise ValueError(f"{member.name[:40]!r}, {member.size:,} bytes")
    return archive.extractfile(member).read()  # type: ignore[union-attr]


def _without_digests(content: bytes, known: dict[bytes, int]) -> bytes:
    """JSON with a byte in place of each new digest, and a number in place of one that is known; see `DIGESTS`."""

    def place(found: re.Match[bytes]) -> bytes:
        if found[0] in known:
            return _KNOWN + known[found[0]].to_bytes(3, "big")
        known[found[0]] = len(known)
        return _NEW

    return _DIGEST.sub(place, content)
