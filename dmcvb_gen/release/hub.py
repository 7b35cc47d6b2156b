"""Publishing to the Hugging Face Hub: files go up in a few commits, index and manifest in the last one.

hf:// can be read as any file system, but written that way every file would be a commit of its own.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

from dmcvb_gen import files
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.store.manifest import MANIFEST, FileRecord, Manifest
from dmcvb_gen.store.remote import is_refusal, reason, refused

BATCH = 200
"""Files a commit."""
_URL = re.compile(r"hf://datasets/([\w.-]+/[\w.-]+)(?:/([\w./-]*))?")


def parse_hub_url(url: str) -> tuple[str, str]:
    """hf://datasets/owner/name/folder -> ("owner/name", "folder/").

    Raises:
      StoreError: it is no such URL.
    """
    match = _URL.fullmatch(url)
    if not match:
        raise StoreError(f"{url} is not hf://datasets/OWNER/NAME (or a folder in it)")
    folder = (match[2] or "").strip("/")
    return match[1], f"{folder}/" if folder else ""


def publish_to_hub(
    root: Path, manifest: Manifest, index, url: str, tick: Callable[[int], None] = lambda count: None, api=None
) -> int:
    """Put a release into a data set repository (made if it is not there); gives how many files were moved.

    Args:
      index: the release's `store.index.Index`.
      api: a `huggingface_hub.HfApi`, for tests; by default one with the environment's token.

    Raises:
      StoreError: the package is missing, another version is there, access is refused, or the Hub cannot be reached.
    """
    try:
        from huggingface_hub import CommitOperationAdd, HfApi
    except ImportError:
        raise StoreError("hf:// needs a package that is not installed: pip install huggingface_hub") from None
    repository, folder = parse_hub_url(url)
    api = api or HfApi()
    where = dict(repo_id=repository, repo_type="dataset")
    try:
        api.create_repo(**where, exist_ok=True)
        head = api.repo_info(**where).sha
        there = _blobs(api, where, [folder + file.path for file in index.files] + [folder + MANIFEST])
        if folder + MANIFEST in there:
            if there[folder + MANIFEST] & _digests(root / MANIFEST):
                return 0
            raise StoreError(
                f"{url} already holds a release, and a published version never changes; publish {manifest.name} "
                f"{manifest.version} to another repository or folder (a changed byte is a new version)"
            )
        todo = []
        for file in index.files:
            _check_local(root, file)
            if not there.get(folder + file.path, set()) & _digests(root / file.path):
                todo.append(file)
        for first in range(0, len(todo), BATCH):
            part = todo[first : first + BATCH]
            operations = [CommitOperationAdd(folder + file.path, str(root / file.path)) for file in part]
            message = f"{manifest.name} {manifest.version}: files {first + 1} to {first + len(part)}"
            head = api.create_commit(**where, operations=operations, commit_message=message).oid
            tick(len(part))
        last = [
            CommitOperationAdd(folder + "files.json", files.json_bytes(index)),
            CommitOperationAdd(folder + MANIFEST, str(root / MANIFEST)),
        ]
        # Refused by the Hub if anyone else committed since: two publishers cannot both finish.
        api.create_commit(
            **where, operations=last, commit_message=f"{manifest.name} {manifest.version}", parent_commit=head
        )
    except StoreError:
        raise
    except Exception as error:  # the client raises many kinds
        if is_refusal(error) or getattr(getattr(error, "response", None), "status_code", 0) in (401, 403):
            raise refused(url, error) from None
        raise StoreError(f"cannot publish to {url} ({reason(error)}); run the same command again") from None
    return len(todo)


def _check_local(root: Path, file: FileRecord) -> None:
    if sha256_file(root / file.path) != file.sha256:
        raise StoreError(
            f"{root / file.path} does not have its digest; run `dmcvb-gen regenerate` on the release first"
        )


def _digests(path: Path) -> set[str]:
    """What the Hub may call a file's content: its SHA-256 (large files), or git's blob id."""
    data = path.read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()
    return {hashlib.sha256(data).hexdigest(), blob}


def _blobs(api, where, paths: list[str]) -> dict[str, set[str]]:
    """The names of the contents of those paths that are in the repository."""
    found = {}
    for first in range(0, len(paths), BATCH):
        for entry in api.get_paths_info(paths=paths[first : first + BATCH], **where):
            large = getattr(entry, "lfs", None)
            names = {getattr(entry, "blob_id", None), large.sha256 if large else None}
            found[entry.path] = {name for name in names if name}
    return found
