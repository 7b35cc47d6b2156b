"""Fetching and publishing where something is already, or changes meanwhile: another process, a rollout that goes on."""

from __future__ import annotations

import shutil
import types

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.index import read_index
from dmcvb_gen.dataset.manifest import commit_path
from dmcvb_gen.dataset.writer import finish_release
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.paint import RenderConfig
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.release import fetch as fetching
from dmcvb_gen.release.fetch import fetch, fetch_and_paint
from dmcvb_gen.release.publish import publish, publish_folder
from dmcvb_gen.release.verify import verify
from dmcvb_gen.storage.local import LocalStorage
from tests.conftest import maze_recipe, roll_out, small_recipe
from tests.fake_hub import fake_hub

WALKER = {"tasks": "walker-walk", "levels": "random", "settings": ["none", "static"], "episodes": 2}
RECIPES = {
    "walker": small_recipe(subsets=[WALKER | {"episodes_per_shard": 1, "max_steps": 10}]),
    "maze": maze_recipe(("visible", "hidden"), max_steps=10),
}


@pytest.fixture(scope="module", params=RECIPES)
def made(request, tmp_path_factory):
    """A release of two subsets that share their episodes, in two shards each."""
    folder = tmp_path_factory.mktemp(request.param) / "made"
    roll_out(RECIPES[request.param], folder)
    return folder


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_release_is_not_fetched_to_its_own_folder(made, tmp_path):
    before = content(made)
    (tmp_path / "link").symlink_to(made)
    for source in (str(made), f"file:{made}", f"file://{tmp_path / 'link'}"):
        with pytest.raises(StoreError, match="is the release itself; choose another --out"):
            fetch(source, made)
        with pytest.raises(StoreError, match="is the release itself; choose another --out"):
            fetch_and_paint(source, tmp_path / "link", painter=RenderConfig())
    assert content(made) == before


@pytest.mark.parametrize("place", ["folder", "hub"])
def test_publishing_again_brings_back_what_was_deleted_there(made, tmp_path, monkeypatch, place):
    hub = fake_hub(tmp_path / "hub", monkeypatch)
    url, there = {
        "folder": (f"file:{tmp_path / 'there'}", tmp_path / "there"),
        "hub": ("hf://datasets/me/tiny", hub.folder),
    }[place]
    publish(made, url)
    [(name, subset), *_] = open_release(made).subsets.items()
    (there / commit_path(name, 1)).unlink()
    with pytest.raises(StoreError, match="00001.json of .* is missing; publish the release again"):
        fetch(url, tmp_path / "back")
    chunk = there / subset.commits[0].files[0].path
    chunk.unlink()  # its siblings may be links to it
    chunk.write_bytes(b"half")
    assert publish(made, url).moved == 2 and publish(made, url).moved == 0
    fetch(url, tmp_path / "back")
    assert verify(there).sound and verify(tmp_path / "back").sound


def test_a_publisher_whose_claim_was_taken_over_changes_nothing(made, tmp_path, monkeypatch):
    url, newer, upload_all = f"file:{tmp_path / 'there'}", tmp_path / "newer", LocalStorage.upload_all
    shutil.copytree(made, newer)
    finish_release(newer, open_release(newer).manifest.model_copy(update={"version": "1.0.1"}))

    def another_between(self, *arguments, **options):
        moved = upload_all(self, *arguments, **options)
        monkeypatch.setattr(LocalStorage, "upload_all", upload_all)
        publish(newer, url, take_over=True)
        return moved

    monkeypatch.setattr(LocalStorage, "upload_all", another_between)
    with pytest.raises(StoreError, match=r"already holds \w+ 1\.0\.1"):
        publish(made, url)
    fetch(url, tmp_path / "r")
    assert verify(tmp_path / "r").sound and open_release(tmp_path / "r").manifest.version == "1.0.1"


def test_pictures_that_another_process_rendered_meanwhile_stay(made, tmp_path, monkeypatch):
    url, here, real = f"file:{tmp_path / 'there'}", tmp_path / "here", fetching._fetch_commits
    publish_folder(made, url, pixels=False)

    def meanwhile(*arguments):
        monkeypatch.setattr(fetching, "_fetch_commits", real)
        fetch_and_paint(url, here, painter=RenderConfig())
        return real(*arguments)

    monkeypatch.setattr(fetching, "_fetch_commits", meanwhile)
    fetch(url, here)
    commits = [commit for subset in open_release(here).subsets.values() for commit in subset.commits.values()]
    assert len(commits) == 4 and all(commit.painted for commit in commits) and verify(here).sound
    assert open_release(here).manifest.digest == open_release(made).manifest.digest


def test_images_that_were_rendered_here_do_not_grow_and_this_is_said(made, tmp_path):
    shutil.copytree(made, tmp_path / "source")
    url, recipe = f"file:{tmp_path / 'there'}", open_release(made).manifest.recipe
    publish_folder(tmp_path / "source", url, pixels=False)
    fetch_and_paint(url, tmp_path / "here", painter=RenderConfig())
    grown = make_recipe(recipe | {"subsets": [one | {"episodes": 3} for one in recipe["subsets"]]})
    roll_out(grown, tmp_path / "source")
    publish_folder(tmp_path / "source", url, pixels=False)
    with pytest.raises(StoreError, match="images that were rendered here, which do not grow; choose another --out for"):
        fetch(url, tmp_path / "here")
    assert verify(tmp_path / "here").sound


def test_what_was_asked_for_is_told_from_what_shards_bring(tmp_path):
    run, url = CliRunner().invoke, f"file:{tmp_path / 'there'}"
    roll_out(
        small_recipe(subsets=[WALKER | {"episodes": 4, "episodes_per_shard": 2, "max_steps": 3}]), tmp_path / "made"
    )
    publish(tmp_path / "made", url)
    for asked, told in (("0:2", ""), ("2:4", ""), ("0:3", "has the episodes 0:4; you asked for 0:3")):
        result = run(main, ["fetch", url, "--episodes", asked, "--out", str(tmp_path / "here")])
        assert result.exit_code == 0 and told in result.output, result.output
        assert bool(told) == ("fetched whole" in result.output)


@pytest.mark.parametrize("name", ["README.md", "policies/mine.safetensors"])
def test_files_of_something_else_are_no_interrupted_fetch(made, tmp_path, name):
    publish(made, f"file:{tmp_path / 'there'}")
    mine = tmp_path / "here" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(StoreError, match="is not empty and holds no release"):
        fetch(f"file:{tmp_path / 'there'}", tmp_path / "here")
    assert mine.read_text() == "mine"


def test_files_that_become_links_need_room_once(made, tmp_path, monkeypatch):
    paths = [made / file.path for file in read_index(made).files if not file.path.startswith("commits/")]
    needed = sum({path.stat().st_ino: path.stat().st_size for path in paths}.values())
    assert needed < sum(path.stat().st_size for path in paths)
    room = types.SimpleNamespace(free=needed - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: room)
    with pytest.raises(StoreError, match="are needed and .* are free"):
        fetch(str(made), tmp_path / "here")
    room.free = needed
    fetch(str(made), tmp_path / "here")
    assert verify(tmp_path / "here").sound


def test_of_a_rollout_that_is_not_complete_what_is_there_can_be_fetched(made, tmp_path):
    begun, recipe = tmp_path / "begun", RECIPES["maze" if "ant" in next(iter(open_release(made).subsets)) else "walker"]
    roll_out(recipe, begun, jobs=lambda jobs: jobs[:1])  # as --part 1/2 and --finish
    [(name, subset), *_] = open_release(begun).subsets.items()
    [shard] = subset.commits
    with pytest.raises(StoreError, match="does not list commits/.*finish the rollout there, or fetch .* --episodes"):
        fetch(str(begun), tmp_path / "here")
    fetch(str(begun), tmp_path / "here", [name], (shard, shard + 1))
    assert list(open_release(tmp_path / "here")[name].episodes) == [shard] and verify(tmp_path / "here").sound
