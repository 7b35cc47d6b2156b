"""Equal files of sibling subsets are one file on the disk, and every command works as it does without links."""

from __future__ import annotations

import os
import shutil

import pytest
import xarray
import zarr
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import subset_path
from dmcvb_gen.dataset.sharing import disk_bytes
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from dmcvb_gen.storage.base import unfinished
from tests.conftest import maze_recipe, roll_out, small_recipe

pytestmark = pytest.mark.slow  # whole releases of three families
SHARED = {"state", "action", "reward", "physics", "seed"}


def nodes(folder, name):
    """Array -> inodes of its files."""
    subset, found = open_release(folder)[name], {}
    for commit in subset.commits.values():
        for file in commit.files:
            array = file.path.removeprefix(f"{subset_path(name)}/").split("/c/")[0].rpartition("/")[2]
            found.setdefault(array, set()).add(os.stat(folder / file.path).st_ino)
    return found


def assert_shared(folder, names):
    first, *others = [nodes(folder, name) for name in names]
    for other in others:
        assert {array for array in first if first[array] == other.get(array)} >= SHARED
        assert all(first[array].isdisjoint(other[array]) for array in first if array.startswith("pixels"))


@pytest.fixture(scope="module", params=["walker", "suite", "maze"])
def made(request, tmp_path_factory):
    """(folder, names of subsets that share their episodes, recipe); a maze's settings share none."""
    folder = tmp_path_factory.mktemp(request.param) / "release"
    subsets = {"tasks": "cartpole-swingup", "levels": "random", "settings": ["none", "dynamic"], "episodes": 2}
    recipe = {
        "walker": small_recipe,
        "suite": lambda: small_recipe(subsets=[subsets | {"episodes_per_shard": 1, "max_steps": 20}]),
        "maze": lambda: maze_recipe(("visible", "hidden")),
    }[request.param]()
    roll_out(recipe, folder)
    names = list(open_release(folder))
    return folder, names, request.param


def same_bytes(one, other):
    return open_release(one).manifest.digest == open_release(other).manifest.digest


def test_a_rollout_stores_equal_arrays_once_and_any_reader_finds_them(made):
    folder, names, family = made
    release = open_release(folder)
    if family != "maze":
        assert_shared(folder, names)
        facts = CliRunner().invoke(main, ["info", str(folder)]).output
        assert " on disk)" in facts
    for name in names:
        path = folder / subset_path(name)
        assert zarr.open_group(path)["action"].shape == xarray.open_zarr(path)["action"].shape
        paths = [file.path for commit in release[name].commits.values() for file in commit.files]
        assert disk_bytes(folder, paths) == release[name].bytes  # alone it has all of its bytes
    assert verify(folder).sound


def test_links_survive_publishing_and_fetching_and_a_part_is_whole_by_itself(made, tmp_path):
    folder, names, family = made
    publish(folder, f"file://{tmp_path}/there")
    fetch(f"file://{tmp_path}/there", tmp_path / "here")
    assert same_bytes(folder, tmp_path / "here")
    if family != "maze":
        assert_shared(tmp_path / "there", names)
        assert_shared(tmp_path / "here", names)
    fetch(f"file://{tmp_path}/there", tmp_path / "part", only=[names[-1]])
    assert verify(tmp_path / "part").sound and list(open_release(tmp_path / "part")) == [names[-1]]
    fetch(f"file://{tmp_path}/there", tmp_path / "part")
    assert same_bytes(folder, tmp_path / "part")


def test_a_file_that_becomes_a_link_leaves_no_unfinished_download(made, tmp_path):
    folder, names, _ = made
    publish(folder, f"file://{tmp_path}/there")
    fetched = tmp_path / "here"
    fetch(f"file://{tmp_path}/there", fetched)
    chunks = [
        fetched / file.path for name in names for c in open_release(fetched)[name].commits.values() for file in c.files
    ]
    for chunk in chunks:  # as a fetch leaves them that is killed while it downloads all at once
        chunk.rename(unfinished(chunk))
    fetch(f"file://{tmp_path}/there", fetched)
    assert not list(fetched.rglob("*.partial")) and verify(fetched).sound


def test_a_damaged_file_harms_all_that_share_it_and_repair_links_them_again(made, tmp_path):
    folder, names, family = made
    publish(folder, f"file://{tmp_path}/r")
    release = open_release(tmp_path / "r")
    file = next(f for f in release[names[0]].commits[0].files if "/physics/" in f"/{f.path}")
    with (tmp_path / "r" / file.path).open("r+b") as handle:
        handle.seek(file.bytes // 2)
        handle.write(b"\xff\x00\xff")
    broken = {finding.subset for finding in verify(tmp_path / "r").findings if finding.subset}
    assert broken == (set(names) if family != "maze" else {names[0]})
    result = CliRunner().invoke(main, ["regenerate", str(tmp_path / "r")])
    assert result.exit_code == 0, result.output
    assert verify(tmp_path / "r").sound and same_bytes(folder, tmp_path / "r")
    if family != "maze":
        assert_shared(tmp_path / "r", names)


def test_a_setting_that_is_added_later_joins_and_its_repair_heals_the_others(tmp_path):
    pattern = {"tasks": "walker-walk", "levels": "random", "episodes": 2, "max_steps": 20}
    for setting in ("none", "static"):
        roll_out(small_recipe(subsets=[pattern | {"settings": [setting]}]), tmp_path / "r")
    names = ["walker-walk/random/none", "walker-walk/random/static"]
    assert_shared(tmp_path / "r", names)
    first = open_release(tmp_path / "r")[names[0]].commits[0].files
    state = next(file.path for file in first if "/state/" in file.path)
    (tmp_path / "r" / state).write_bytes(bytes((tmp_path / "r" / state).stat().st_size))  # both names of it
    result = CliRunner().invoke(main, ["regenerate", str(tmp_path / "r"), "--only", names[1]])
    assert result.exit_code == 0, result.output
    assert verify(tmp_path / "r").sound
    assert_shared(tmp_path / "r", names)


def test_without_links_every_subset_has_files_of_its_own(tmp_path, monkeypatch):
    link = os.link

    def refuse(source, *arguments, **options):
        if not str(source).endswith(".partial"):  # by which files are created
            raise OSError(95, "Operation not supported")
        link(source, *arguments, **options)

    roll_out(small_recipe(), tmp_path / "linked")
    monkeypatch.setattr(os, "link", refuse)
    roll_out(small_recipe(), tmp_path / "r")
    publish(tmp_path / "r", str(tmp_path / "there"))
    for folder in (tmp_path / "r", tmp_path / "there"):
        paths = [path for path in folder.rglob("*") if path.is_file()]
        assert all(path.stat().st_nlink == 1 for path in paths)
        assert same_bytes(tmp_path / "linked", folder) and verify(folder).sound
    shutil.rmtree(tmp_path / "r")
