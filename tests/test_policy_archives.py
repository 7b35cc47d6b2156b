"""The package's policies are packed: every file comes out with its digest, wherever a folder can be written."""

from __future__ import annotations

import os
import shutil

import pytest

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies import archives
from dmcvb_gen.policies.archives import bundled_digests, bundled_file, pack

NAME = "walker-walk/expert.safetensors"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "dmcvb-gen" / "policies"


def test_every_policy_of_the_list_comes_out_with_its_digest(cache):
    for name, digest in bundled_digests().items():
        assert bundled_file(name) == cache / name and sha256_file(cache / name) == digest
    assert len(bundled_digests()) == 44  # 10 of each locomotion task, 2 of each maze


def test_a_file_that_was_changed_or_lost_is_unpacked_again(cache):
    path = bundled_file(NAME)
    before = path.stat().st_mtime_ns
    assert bundled_file(NAME).stat().st_mtime_ns == before  # unpacked once
    path.write_bytes(b"other weights")
    assert sha256_file(bundled_file(NAME)) == bundled_digests()[NAME]
    shutil.rmtree(cache)
    assert bundled_file(NAME).exists()


def test_without_a_cache_that_can_be_written_the_temporary_folder_serves(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(archives.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    assert bundled_file(NAME).is_relative_to(tmp_path / "temporary")
    monkeypatch.setattr(archives.tempfile, "gettempdir", lambda: str(tmp_path / "file"))
    with pytest.raises(DmcvbError, match="set XDG_CACHE_HOME to a folder that can be written"):
        bundled_file(NAME)


def test_packed_files_come_out_as_they_were(tmp_path, monkeypatch, cache):
    folder, out = tmp_path / "plain", tmp_path / "data"
    contents = {f"{task}/expert.safetensors": os.urandom(100) for task in ("a-task", "ant-maze-x", "ant-maze-y")}
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(content)
    out.mkdir()
    pack(folder, out)
    assert sorted(path.name for path in out.iterdir()) == ["a-task.tar.xz", "ant-maze.tar.xz", "policies.json"]
    monkeypatch.setattr(archives, "data_folder", lambda: out)
    bundled_digests.cache_clear()
    try:
        assert {name: bundled_file(name).read_bytes() for name in contents} == contents
    finally:
        bundled_digests.cache_clear()
