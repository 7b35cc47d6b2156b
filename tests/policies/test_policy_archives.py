"""The package's policies are packed: every file comes out with its digest, wherever a folder can be written."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies import archives
from dmcvb_gen.policies.archives import bundled_digests, bundled_file, pack
from dmcvb_gen.policies.bundled import bundled_levels, bundled_names
from dmcvb_gen.policies.policy_file import read_header
from dmcvb_gen.spec import MAZE_TRAINED_LEVELS, TRAINED_LEVELS, is_maze

NAME = "walker-walk/expert.safetensors"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "dmcvb-gen" / "policies"


@pytest.fixture
def brings(monkeypatch):
    """A function that lets the package have the archives of another folder."""

    def change(folder):
        monkeypatch.setattr(archives, "data_folder", lambda: folder)
        bundled_digests.cache_clear()

    yield change
    bundled_digests.cache_clear()


@pytest.mark.slow
def test_every_policy_of_the_list_comes_out_with_its_digest(cache):
    for name, digest in bundled_digests().items():
        path = cache / digest[:16] / name
        assert bundled_file(name) == path and sha256_file(path) == digest


def test_every_task_has_its_levels_and_its_rows_in_the_docs():
    page = (Path(__file__).parents[2] / "docs/policies.md").read_text()
    for task in {name.split("/")[0] for name in bundled_digests()}:
        assert bundled_levels(task) == list(MAZE_TRAINED_LEVELS if is_maze(task) else TRAINED_LEVELS)
        for level in bundled_levels(task):
            returns = [read_header(bundled_file(name)).evaluation.mean for name in bundled_names(task, level)]
            assert len(returns) == (8 if level == "mixed" else 1)
            assert f"| {task} | {level} | {np.mean(returns):.0f} ±" in page, "run scripts/pack_policies.py"


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


def policy(seed, scale=1.0):
    """A safetensors file whose weights resemble those of other seeds, and hold what floats can hold."""
    weights = np.random.default_rng(0).normal(0, 0.1, (30, 20)).astype(np.float32)
    weights[10:] += np.random.default_rng(seed).normal(0, 0.01, (20, 20)).astype(np.float32)
    weights[0, :6] = [0.0, -0.0, 1e-12, -1e-12, np.finfo(np.float32).smallest_subnormal, 3.0]
    zeros, few = np.zeros(5, np.float32), np.float32([[1e-30], [-1e30]])
    return save({"weight": scale * weights, "zeros": zeros, "few": few, "bias": weights[1]}, {"header": "{}"})


def test_packed_files_come_out_as_they_were_and_other_tasks_keep_theirs(tmp_path, brings, cache):
    tasks = ("a-task", "ant-maze-x", "ant-maze-y")
    contents = {f"{task}/expert.safetensors": policy(seed, 1.0 + seed) for seed, task in enumerate(tasks)}
    contents["ant-maze-x/medium.safetensors"] = policy(7)
    pack(contents, tmp_path)
    assert sorted(path.name for path in tmp_path.glob("*.*")) == ["a-task.xz", "ant-maze.xz", "policies.json"]
    swapped = {"ant-maze-x/expert.safetensors": policy(9)}
    before = (tmp_path / "a-task.xz").read_bytes()
    pack(swapped, tmp_path)
    assert (tmp_path / "a-task.xz").read_bytes() == before
    del contents["ant-maze-x/medium.safetensors"]  # all that the task had went
    brings(tmp_path)
    assert {name: bundled_file(name).read_bytes() for name in bundled_digests()} == contents | swapped


def test_another_version_of_the_package_leaves_the_unpacked_file_as_it_is(tmp_path, brings, cache):
    old, new = ({NAME: policy(seed)} for seed in (1, 2))
    for folder in ("old", "new"):
        (tmp_path / folder).mkdir()
    pack(old, tmp_path / "old")
    brings(tmp_path / "old")
    in_use = bundled_file(NAME)
    pack(new, tmp_path / "new")
    brings(tmp_path / "new")
    assert bundled_file(NAME).read_bytes() == new[NAME] and in_use.read_bytes() == old[NAME]
