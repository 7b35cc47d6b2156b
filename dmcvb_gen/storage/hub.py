"""Data set repositories of the Hugging Face Hub: written in commits of few files, downloaded by the Hub's client."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fsspec

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import PARTIAL
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.storage.base import Digested, checked
from dmcvb_gen.storage.object_store import ObjectStorage
from dmcvb_gen.storage.remote import file_system, is_refusal, reason, refused

BATCH = 90
"""Files a commit: the Hub asks for fewer than 100."""
ASKED = 500
"""Paths that are asked about at once."""
_URL = re.compile(r"hf://datasets/([\w.-]+/[\w.-]+)(?:@([\w.-]+))?(?:/([\w./-]*))?")


def on_the_hub(url: str) -> bool:
    """Return True if a URL is one of the Hugging Face Hub."""
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


def newest_of(url: str) -> tuple[dict[str, str], str]:
    """Return the repository of a URL, as the Hub's client names it, and the folder in it.

    Raises:
      StoreError: it names a revision.
    """
    repository, folder, revision = parse_hub_url(url)
    if revision:
        raise StoreError(f"{url} names a revision, but publishing always writes the newest one; remove @{revision}")
    return {"repo_id": repository, "repo_type": "dataset"}, folder


def client_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of the Hub's file system that its client has, too."""
    return {name: options[name] for name in ("endpoint", "token") if name in options}


def new_api(endpoint: str | None = None, token: str | bool | None = None) -> Any:
    """A `huggingface_hub.HfApi`; with the environment's endpoint and token by default.

    Raises:
      StoreError: the package is missing.
    """
    try:
        from huggingface_hub import HfApi
    except ImportError:
        raise StoreError("hf:// needs a package that is not installed: pip install huggingface_hub") from None
    return HfApi(endpoint=endpoint, token=token)


@contextlib.contextmanager
def client_errors(url: str) -> Iterator[None]:
    """Turn the many errors of the Hub's client into one line that names the cure."""
    try:
        yield
    except StoreError:
        raise
    except Exception as error:
        if is_refusal(error) or getattr(getattr(error, "response", None), "status_code", 0) in (401, 403):
            raise refused(url, error) from None
        raise StoreError(f"cannot publish to {url} ({reason(error)}); rerun the same command") from None


@dataclass(frozen=True)
class HubStorage(ObjectStorage):
    """Files of a repository, read through fsspec. What is published is refused if another commit came between.

    Attributes:
      _head: the last commit, as `begin` and what was published since left it.
    """

    _head: list[str] = field(default_factory=list, init=False, repr=False, compare=False)

    needs_claim = False

    @property
    def _api(self) -> Any:
        return new_api(**client_options(dict(self.options)))

    def begin(self) -> None:
        with client_errors(self.place):
            self._api.create_repo(**newest_of(self.url)[0], exist_ok=True)
        self._head[:] = [self._last_commit()]

    def _last_commit(self) -> str:
        with client_errors(self.place):
            return self._api.repo_info(**newest_of(self.url)[0]).sha

    def _open(self, path: str) -> tuple[fsspec.AbstractFileSystem, str]:
        parse_hub_url(self.url)
        filesystem, base = file_system(self.url, dict(self.options))
        return filesystem, f"{base}/{path}"

    def _commit(self, files: Mapping[str, bytes | str | None], message: str, parent: str | None = None) -> str:
        """One commit of files: path -> content, path of a local file, or None to delete it.

        Args:
          parent: the commit that must be the last one.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        where, folder = newest_of(self.url)
        operations = [
            CommitOperationDelete(folder + path) if content is None else CommitOperationAdd(folder + path, content)
            for path, content in files.items()
        ]
        given = dict(operations=operations, commit_message=message, parent_commit=parent)
        with client_errors(self.place):
            return self._api.create_commit(**where, **given).oid

    def _write(self, path: str, data: bytes) -> None:
        self._commit({path: data}, path)

    def _create(self, path: str, data: bytes) -> None:
        last = self._last_commit()  # the commit is refused if the file is created from here on
        if self.size(path) is not None:
            raise FileExistsError(path)
        self._commit({path: data}, path, last)

    def _remove(self, path: str) -> None:
        if self.size(path) is not None:
            self._commit({path: None}, f"without {path}")

    def _send(self, local: Path, path: str) -> None:
        self._commit({path: str(local)}, path)

    def upload_all(
        self, root: Path, files: Sequence[Digested], workers: int, tick: ProgressCallback = ignore, fresh: bool = False
    ) -> int:
        """In commits of `BATCH` files, after `begin`."""
        there = self._contents([file.path for file in files])
        todo = [file for file in files if not there.get(file.path, set()) & _names(checked(root, file))]
        tick(len(files) - len(todo))
        for first in range(0, len(todo), BATCH):
            part = todo[first : first + BATCH]
            given = {file.path: str(root / file.path) for file in part}
            self._head[:] = [self._commit(given, f"files {first + 1} to {first + len(part)}", self._head[0])]
            tick(len(part))
        return len(todo)

    def write_last(self, contents: Mapping[str, bytes], new: bool = False) -> bool:
        """In one commit; two publishers cannot both finish."""
        self._head[:] = [self._commit(contents, ", ".join(contents), self._head[0])]
        return True

    def tag(self, name: str, message: str) -> None:
        """`name`, after the release's folder if it has one in the repository."""
        where, folder = newest_of(self.url)
        name = "-".join([*folder.split("/")[:-1], name])
        with client_errors(self.place):
            self._api.create_tag(**where, tag=name, tag_message=message, revision=self._head[0], exist_ok=True)

    def _contents(self, paths: Sequence[str]) -> dict[str, set[str]]:
        """Return the Hub's names of the contents of those files that exist."""
        where, folder = newest_of(self.url)
        found = {}
        with client_errors(self.place):
            for first in range(0, len(paths), ASKED):
                asked = [folder + path for path in paths[first : first + ASKED]]
                for entry in self._api.get_paths_info(**where, paths=asked):
                    large = getattr(entry, "lfs", None)
                    names = {getattr(entry, "blob_id", None), large.sha256 if large else None}
                    found[entry.path.removeprefix(folder)] = {name for name in names if name}
        return found

    def _same(self, file: Digested, local: Path) -> bool:
        return bool(self._contents([file.path]).get(file.path, set()) & _names(local))

    def _fetch(self, file: Digested, partial: Path, root: Path) -> None:
        repository, folder, revision = parse_hub_url(self.url)
        where = dict(repo_id=repository, repo_type="dataset", revision=revision, local_dir=_stage(root))
        os.replace(self._api.hf_hub_download(**where, filename=folder + file.path), partial)

    def tidy(self, root: Path) -> None:
        shutil.rmtree(_stage(root), ignore_errors=True)


def _stage(root: Path) -> Path:
    """Folder in which the Hub's client keeps interrupted downloads, so that it can resume them."""
    return root / f".hub{PARTIAL}"


def _names(path: Path) -> set[str]:
    """Return the names that the Hub may have for a file's content: its SHA-256 (large files), or git's blob id."""
    data = path.read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()
    return {hashlib.sha256(data).hexdigest(), blob}
