"""Data set repositories of the Hugging Face Hub: read over HTTP at one commit, written in commits of many files."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.storage.interface import ANY, Store
from dmcvb_gen.storage.places import Place
from dmcvb_gen.storage.web import HttpStore

BATCH = 90
"""Files a commit: the Hub asks for fewer than 100."""
ASKED = 500
"""Paths that are asked about at once."""
_PATH = re.compile(r"datasets/(?P<name>[\w.-]+/[\w.-]+)(?:@(?P<revision>[\w.-]+))?(?:/(?P<folder>[\w./-]*))?")


@dataclass(frozen=True)
class HubStore(Store):
    """Files below a folder of a data set repository, as they were at the first look.

    Attributes:
      repository: "OWNER/NAME". folder_there: "" or a path that ends in "/". revision: a tag or commit; None for newest.
      token: of the Hub; None for the one that the user has logged in with. endpoint: None for the public Hub.
    """

    repository: str
    folder_there: str = ""
    revision: str | None = None
    token: str | None = field(default=None, repr=False)
    endpoint: str | None = None
    _commits: dict[str, str] = field(default_factory=dict, init=False, repr=False, compare=False)

    writable = False

    @classmethod
    def at(cls, place: Place, options: Mapping[str, Any]) -> HubStore:
        """The store of an hf: place.

        Raises:
          StoreError: it names no data set repository.
        """
        found = _PATH.fullmatch(place.path)
        if not found:
            raise StoreError(f"{place} is not hf://datasets/OWNER/NAME (or a folder in it, or @REVISION)")
        folder = (found["folder"] or "").strip("/")
        return cls(found["name"], folder and f"{folder}/", found["revision"], **options)

    @property
    def place(self) -> str:
        revision = f"@{self.revision}" if self.revision else ""
        return f"hf://datasets/{self.repository}{revision}/{self.folder_there}".rstrip("/")

    @property
    def _api(self) -> Any:
        """A `huggingface_hub.HfApi`; with the environment's endpoint and token by default."""
        from huggingface_hub import HfApi

        return HfApi(endpoint=self.endpoint, token=self.token)

    @property
    def _where(self) -> dict[str, str]:
        return {"repo_id": self.repository, "repo_type": "dataset"}

    def _secrets(self) -> Sequence[str]:
        return [self.token] if self.token else []

    # -- reading ----------------------------------------------------------------------------------

    def _commit_read(self) -> str:
        """The commit that is read; the newest one is asked for once, so that all files belong together."""
        if "read" not in self._commits:
            self._commits["read"] = self._api.repo_info(**self._where, revision=self.revision).sha
        return self._commits["read"]

    @property
    def _files(self) -> HttpStore:
        api = self._api
        url = f"{api.endpoint}/datasets/{self.repository}/resolve/{self._commit_read()}/{self.folder_there}"
        return HttpStore(url.rstrip("/"), headers=api._build_hf_headers())

    def _read(self, path: str, start: int, length: int) -> bytes:
        return self._files._read(path, start, length)

    def _pieces(self, path: str, limit: int) -> Iterator[bytes]:
        return self._files._pieces(path, limit)

    def _size(self, path: str) -> int:
        return self._known([path], self._commit_read())[path].size

    def _version(self, path: str) -> str:
        """The content's name in git."""
        return self._known([path], self._head())[path].blob_id

    def _known(self, paths: Sequence[str], commit: str) -> _Known:
        """What the Hub knows of those files that exist at a commit."""
        found, api = _Known(), self._api
        for first in range(0, len(paths), ASKED):
            asked = [self.folder_there + path for path in paths[first : first + ASKED]]
            for entry in api.get_paths_info(**self._where, paths=asked, revision=commit):
                if hasattr(entry, "blob_id"):  # folders have none
                    found[entry.path.removeprefix(self.folder_there)] = entry
        return found

    def _list(self, prefix: str) -> Mapping[str, int]:
        from huggingface_hub.errors import EntryNotFoundError

        folder = f"{self.folder_there}{prefix}".strip("/") or None
        given = {"path_in_repo": folder, "recursive": True, "revision": self._commit_read()}
        try:
            entries = list(self._api.list_repo_tree(**self._where, **given))
        except EntryNotFoundError:  # of a folder that is not there yet
            return {}
        return {entry.path.removeprefix(self.folder_there): entry.size for entry in entries if hasattr(entry, "size")}

    # -- writing ----------------------------------------------------------------------------------

    def read_only(self) -> StoreError:
        return StoreError(
            f"{self.place} takes files in commits; write the release to a folder, then `dmcvb-gen publish` it here"
        )

    def _head(self) -> str:
        return self._api.repo_info(**self._where).sha

    def begin(self) -> None:
        if self.revision:
            raise StoreError(f"{self.place} names a revision, but the newest one is written; remove @{self.revision}")
        with self._errors(None, "write to"):
            self._api.create_repo(**self._where, exist_ok=True)
            self._commits["read"] = self._head()

    def upload(self, root: Path, paths: Sequence[str], workers: int = 8, tick: ProgressCallback = ignore) -> list[str]:
        """In commits of `BATCH` files, see `Store.upload`."""
        from huggingface_hub import CommitOperationAdd

        with self._errors(None, "write to"):
            there = self._known(paths, self._head())
            todo = [path for path in paths if path not in there]
            tick(len(there))
            for first in range(0, len(todo), BATCH):
                batch = todo[first : first + BATCH]
                adds = [CommitOperationAdd(self.folder_there + path, str(root / path)) for path in batch]
                self._commit(adds, f"files {first + 1} to {first + len(batch)} of {len(todo)}")
                tick(len(batch))
        return [path for path in paths if path in there]

    def _delete(self, path: str) -> None:
        from huggingface_hub import CommitOperationDelete

        if path in self._known([path], self._head()):
            self._commit([CommitOperationDelete(self.folder_there + path)], f"remove {path}")

    def finish(self, contents: Mapping[str, bytes], expected: str | None = ANY) -> bool:
        """In one commit, which the Hub refuses if another one has come since the version was compared."""
        from huggingface_hub import CommitOperationAdd
        from huggingface_hub.utils.sha import git_hash

        *_, last = contents
        with self._errors(last, "write to"):
            head = self._head()
            now = self._known([last], head)
            if expected not in (ANY, now[last].blob_id if last in now else None):
                return last in now and now[last].blob_id == git_hash(contents[last])
            adds = [CommitOperationAdd(self.folder_there + path, data) for path, data in contents.items()]
            self._commit(adds, f"{last} and {len(adds) - 1} files with it", parent_commit=head)
        return True

    def _commit(self, operations: Sequence[Any], message: str, **given: Any) -> None:
        """Make a commit, which is the one that is read from then on."""
        given |= {"operations": operations, "commit_message": message}
        with _without_bars():
            self._commits["read"] = self._api.create_commit(**self._where, **given).oid

    def tag(self, name: str, message: str) -> None:
        """`name`, after the release's folder if it has one in the repository."""
        name = "-".join([*self.folder_there.split("/")[:-1], name])
        with self._errors(None, "write to"):
            given = {"tag": name, "tag_message": message, "revision": self._commit_read(), "exist_ok": True}
            self._api.create_tag(**self._where, **given)


@contextlib.contextmanager
def _without_bars() -> Iterator[None]:
    """The Hub's client draws no bars of its own through ours."""
    from huggingface_hub import utils

    shown = not utils.are_progress_bars_disabled()
    utils.disable_progress_bars()
    try:
        yield
    finally:
        if shown:
            utils.enable_progress_bars()


class _Known(dict[str, Any]):
    """Path -> what the Hub knows of it."""

    def __missing__(self, path: str) -> Any:
        raise FileNotFoundError(path)
