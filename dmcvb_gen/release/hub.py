"""The Hugging Face Hub: a release goes up in commits of few files, index and manifest in the last one, and has a tag.

hf:// can be read as any file system, but written that way every file would be a commit of its own; and shards come
through the Hub's own client, which brings many at once and goes on where it was cut.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dmcvb_gen import files
from dmcvb_gen.dataset.append import is_grown_from
from dmcvb_gen.dataset.index import INDEX, Index, is_card, is_replaced, keeps, parse_index
from dmcvb_gen.dataset.manifest import MANIFEST, FileRecord, Manifest, parse_manifest, subset_path
from dmcvb_gen.dataset.shards import ShardKey
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import PARTIAL, sha256_file
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.storage.remote import is_refusal, reason, refused, storage_errors

BATCH = 90
"""Files a commit: the Hub asks for fewer than 100."""
ASKED = 500
"""Paths that are asked about at once."""
_URL = re.compile(r"hf://datasets/([\w.-]+/[\w.-]+)(?:@([\w.-]+))?(?:/([\w./-]*))?")


def on_the_hub(url: str) -> bool:
    """Whether a URL is one of the Hugging Face Hub."""
    return url.startswith("hf://")


def parse_hub_url(url: str) -> tuple[str, str, str | None]:
    """hf://datasets/owner/name@v1.0.0/folder -> ("owner/name", "folder/", "v1.0.0").

    Raises:
      StoreError: it is no such URL.
    """
    match = _URL.fullmatch(url)
    if not match:
        raise StoreError(f"{url} is not hf://datasets/OWNER/NAME (or a folder in it, or @REVISION)")
    folder = (match[3] or "").strip("/")
    return match[1], f"{folder}/" if folder else "", match[2]


def tag_of(manifest: Manifest, folder: str) -> str:
    """The tag of a version: "v1.0.0", or "folder-v1.0.0" where the release lies in a folder of the repository."""
    return "-".join([*folder.split("/")[:-1], f"v{manifest.version}"])


def new_api() -> Any:
    """A `huggingface_hub.HfApi` with the environment's token.

    Raises:
      StoreError: the package is missing.
    """
    try:
        from huggingface_hub import HfApi
    except ImportError:
        raise StoreError("hf:// needs a package that is not installed: pip install huggingface_hub") from None
    return HfApi()


def newest_of(url: str) -> tuple[str, str]:
    """Repository and folder of a URL that is published to.

    Raises:
      StoreError: it names a revision.
    """
    repository, folder, revision = parse_hub_url(url)
    if revision:
        raise StoreError(f"{url} names a revision, and what is published is the newest; leave @{revision} away")
    return repository, folder


def publish_to_hub(
    root: Path, manifest: Manifest, index: Index, url: str, tick: ProgressCallback = ignore, api=None
) -> int:
    """Put a release into a data set repository (made if it is not there), and tag it; gives how many files were moved.

    Args:
      index: the release's.
      api: a `huggingface_hub.HfApi`, for tests; by default one with the environment's token.

    Raises:
      StoreError: the package is missing, another version is there (and not one that this has grown from), access is
        refused, or the Hub cannot be reached.
    """
    repository, folder = newest_of(url)
    api, where = api or new_api(), dict(repo_id=repository, repo_type="dataset")
    from huggingface_hub import CommitOperationAdd

    version = f"{manifest.name} {manifest.version}"
    with client_errors(url):
        api.create_repo(**where, exist_ok=True)
        head = api.repo_info(**where).sha
        there = _blobs(api, where, [folder + file.path for file in index.files] + [folder + MANIFEST])
        found, mine = there.get(folder + MANIFEST, set()), _digests(root / MANIFEST)
        if found and not found & mine:
            _check_grown(api, where, url, folder, manifest, index)
        same = bool(found & mine)  # then a card may be new
        wanted = [file for file in index.files if is_card(file.path)] if same else index.files
        todo = list(_to_send(root, wanted, there, folder))
        expect(tick, len(todo))
        for first in range(0, len(todo), BATCH):
            part = todo[first : first + BATCH]
            operations = [CommitOperationAdd(folder + file.path, str(root / file.path)) for file in part]
            message = f"{version}: files {first + 1} to {first + len(part)}"
            head = api.create_commit(**where, operations=operations, commit_message=message).oid
            tick(len(part))
        if todo or not same:
            last = [CommitOperationAdd(folder + INDEX, files.json_bytes(index))]
            last += [] if same else [CommitOperationAdd(folder + MANIFEST, str(root / MANIFEST))]
            # Refused by the Hub if anyone else committed since: two publishers cannot both finish.
            made = api.create_commit(**where, operations=last, commit_message=version, parent_commit=head)
            head = made.oid
        api.create_tag(**where, tag=tag_of(manifest, folder), tag_message=version, revision=head, exist_ok=True)
    return len(todo)


@contextlib.contextmanager
def client_errors(url: str, doing: str = "publish to") -> Iterator[None]:
    """What the Hub's client raises (many kinds) as one line with a cure."""
    try:
        yield
    except StoreError:
        raise
    except Exception as error:
        if is_refusal(error) or getattr(getattr(error, "response", None), "status_code", 0) in (401, 403):
            raise refused(url, error) from None
        raise StoreError(f"cannot {doing} {url} ({reason(error)}); run the same command again") from None


def _check_grown(api, where, url: str, folder: str, manifest: Manifest, index: Index) -> None:
    """Raises StoreError where the release that is there is not one that this has grown from."""

    def there(name: str) -> bytes:
        return Path(api.hf_hub_download(**where, filename=folder + name)).read_bytes()

    try:
        grown = is_grown_from(manifest, parse_manifest(there(MANIFEST), f"{url}/{MANIFEST}"))
        grown = grown and keeps(index, parse_index(there(INDEX), f"{url}/{INDEX}").files)
    except StoreError:
        grown = False
    if not grown:
        raise StoreError(
            f"{url} already holds a release, and a published version never changes; publish {manifest.name} "
            f"{manifest.version} to another repository or folder (a changed byte is a new version)"
        )


def _to_send(root: Path, listed: Sequence[FileRecord], there: dict[str, set[str]], folder: str) -> Iterator[FileRecord]:
    """Files that are not there yet: new ones first, then those that take the place of an older version's."""
    for file in sorted(listed, key=lambda file: is_replaced(file.path)):
        _check_local(root, file)
        if not there.get(folder + file.path, set()) & _digests(root / file.path):
            yield file


def snapshot(url: str, out: Path, wanted: Sequence[FileRecord], shards: Sequence[ShardKey]) -> set[str]:
    """Bring files of shards through the Hub's client; whoever asked checks their digests.

    Args:
      out: the release's folder; what was cut lies in a folder of it, and is gone on with.
      wanted: the files that are missing.
      shards: that they belong to.

    Returns:
      The paths of those that came.

    Raises:
      StoreError: the package is missing, access is refused, or the Hub cannot be reached.
    """
    if not wanted:
        return set()
    import huggingface_hub

    repository, folder, revision = parse_hub_url(url)
    stage = out / f".hub{PARTIAL}"
    places = {f"{folder}{subset_path(name)}/*/c/{shard}" for name, shard in shards}
    patterns = sorted(places | {f"{place}/*" for place in places})
    with client_errors(url, "fetch from"):
        huggingface_hub.snapshot_download(
            repository, repo_type="dataset", revision=revision, allow_patterns=patterns, local_dir=stage
        )
    came = set()
    for file in wanted:
        found = stage / folder / file.path
        if found.is_file():
            (out / file.path).parent.mkdir(parents=True, exist_ok=True)
            os.replace(found, out / file.path)
            came.add(file.path)
    shutil.rmtree(stage, ignore_errors=True)
    return came


def _check_local(root: Path, file: FileRecord) -> None:
    with storage_errors(root / file.path):
        digest = sha256_file(root / file.path)
    if digest != file.sha256:
        cure = "card" if is_card(file.path) else "regenerate"
        raise StoreError(f"{root / file.path} does not have its digest; run `dmcvb-gen {cure}` on the release first")


def _digests(path: Path) -> set[str]:
    """What the Hub may call a file's content: its SHA-256 (large files), or git's blob id."""
    data = path.read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()
    return {hashlib.sha256(data).hexdigest(), blob}


def _blobs(api, where, paths: list[str]) -> dict[str, set[str]]:
    """The names of the contents of those paths that are in the repository."""
    found = {}
    for first in range(0, len(paths), ASKED):
        for entry in api.get_paths_info(paths=paths[first : first + ASKED], **where):
            large = getattr(entry, "lfs", None)
            names = {getattr(entry, "blob_id", None), large.sha256 if large else None}
            found[entry.path] = {name for name in names if name}
    return found
