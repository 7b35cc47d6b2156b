"""The Hugging Face Hub in a folder: what we call of `huggingface_hub.HfApi`, and its web server."""

import hashlib
import re
import shutil
import types
from pathlib import Path

import pytest
from huggingface_hub.errors import EntryNotFoundError
from huggingface_hub.utils import are_progress_bars_disabled

from tests.web_server import give_files, serving


def content(folder: Path) -> dict[str, bytes]:
    """The files of a folder, by their paths in it."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class FakeHub:
    """One repository of data sets, the newest version of its files in `folder`.

    Attributes:
      commits: the paths of each commit. tags: name -> commit.
    """

    def __init__(self, root: Path, repository: str):
        self.root, self.folder = root, root / "datasets" / repository
        self.commits, self.tags, self.endpoint = [], {}, ""

    @property
    def files(self) -> dict[str, bytes]:
        return content(self.folder)

    def create_repo(self, repo_id, repo_type, exist_ok):
        assert repo_type == "dataset" and exist_ok
        self.folder.mkdir(parents=True, exist_ok=True)

    def repo_info(self, repo_id, repo_type, revision=None):
        return types.SimpleNamespace(sha=revision or str(len(self.commits)))

    def at(self, commit: str | None) -> Path:
        """The folder with the files of a commit."""
        return self.folder if commit in (None, str(len(self.commits))) else self.root / "commits" / commit

    def find(self, path: str) -> Path | None:
        """The file that a URL leads to: datasets/OWNER/NAME/resolve/COMMIT/PATH."""
        found = re.fullmatch(r"datasets/[^/]+/[^/]+/resolve/([^/]+)/(.+)", path)
        return found and self.at(found[1]) / found[2]

    def _build_hf_headers(self):
        return {"Authorization": "Bearer hf_secret"}

    def get_paths_info(self, repo_id, paths, repo_type, revision=None):
        for path in paths:
            if (self.at(revision) / path).is_file():
                yield self._facts(path, (self.at(revision) / path).read_bytes())

    def list_repo_tree(self, repo_id, path_in_repo, revision, repo_type, recursive=False):
        root = self.at(revision)
        if not (root / (path_in_repo or "")).exists():
            raise EntryNotFoundError("404: the folder does not exist")
        for path in sorted((root / (path_in_repo or "")).glob("**/*" if recursive else "*")):
            name = path.relative_to(root).as_posix()
            yield self._facts(name, path.read_bytes()) if path.is_file() else types.SimpleNamespace(path=name)

    def _facts(self, path, data):
        blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        return types.SimpleNamespace(path=path, blob_id=blob, lfs=None, size=len(data))

    def create_tag(self, repo_id, tag, tag_message, revision, repo_type, exist_ok):
        assert exist_ok and revision == str(len(self.commits))
        self.tags.setdefault(tag, revision)

    def create_commit(self, repo_id, operations, commit_message, repo_type, parent_commit=None):
        if parent_commit not in (None, str(len(self.commits))):
            raise RuntimeError("412 Precondition Failed: a commit has happened since")
        assert are_progress_bars_disabled() and len(commit_message) < 80  # one bar, ours; a title in a list
        shutil.copytree(self.folder, self.root / "commits" / str(len(self.commits)))
        for operation in operations:
            path = self.folder / operation.path_in_repo
            if not hasattr(operation, "as_file"):
                path.unlink()
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            with operation.as_file() as file:
                path.write_bytes(file.read())
        self.commits.append([operation.path_in_repo for operation in operations])
        return types.SimpleNamespace(oid=str(len(self.commits)))


def fake_hub(root: Path, monkeypatch, repository: str = "me/tiny") -> FakeHub:
    """A Hub that hf:// URLs lead to while a test runs."""
    pytest.importorskip("huggingface_hub")
    hub = FakeHub(root, repository)

    hub.served = serving(give_files(hub.find))  # until the hub is forgotten
    hub.endpoint = hub.served.__enter__().url
    monkeypatch.setattr("huggingface_hub.HfApi", lambda **_: hub)
    return hub
