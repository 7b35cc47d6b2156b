"""Releases that grow: what was there stays byte for byte, what contradicts is refused, the old version stays whole."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.append import merged, next_version
from dmcvb_gen.dataset.manifest import PolicyRecord
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import copy_file
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.plan import finish, finish_target, make_plan, prepare
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.generate.target import Target
from dmcvb_gen.release.card import write_card
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from dmcvb_gen.storage.base import Storage
from tests.conftest import TINY_MAZE, maze_recipe, roll_out, small_recipe

SHORT = {"levels": "random", "max_steps": 20}
WALKER = SHORT | {"tasks": "walker-walk", "settings": "none", "episodes": 1, "episodes_per_shard": 1}


def walker(*patterns, **changes):
    return small_recipe(subsets=[WALKER | pattern for pattern in patterns or ({},)], **changes)


def shards_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if "/c/" in p.as_posix() and p.is_file()}


@pytest.fixture(scope="module")
def grown(tmp_path_factory):
    """A release of one walker episode, then grown by an episode, another setting and a maze; and copies of both."""
    folder = tmp_path_factory.mktemp("grown") / "release"
    roll_out(walker(), folder)
    shutil.copytree(folder, folder.parent / "before")
    roll_out(walker({"episodes": 2}, {"settings": "static", "episodes": 2}), folder)
    maze = SHORT | {"tasks": TINY_MAZE, "settings": "hidden", "episodes": 1}
    roll_out(small_recipe(seed=8, subsets=[maze]), folder)
    return folder


def test_what_was_there_stays_and_the_rest_is_what_one_rollout_gives(grown, tmp_path):
    before, after = shards_of(grown.parent / "before"), shards_of(grown)
    assert before and before.items() <= after.items() and verify(grown).sound and verify(grown).complete
    manifest = open_release(grown).manifest
    assert manifest.version == "1.2.0" and [addition.version for addition in manifest.additions] == ["1.1.0", "1.2.0"]
    assert manifest.additions[0].subsets == {"walker-walk/random/none": (1, 2), "walker-walk/random/static": (0, 2)}
    assert manifest.recipe_of("ant-maze-tiny/random/hidden")["seed"] == 8
    at_once = roll_out(walker({"episodes": 2}, {"settings": "static", "episodes": 2}), tmp_path / "once")
    digests = {record.name: record.digest for record in manifest.subsets}
    assert {record.name: record.digest for record in at_once.subsets}.items() <= digests.items()


@pytest.mark.parametrize("marked", [True, False], ids=["rolled out here", "fetched"])
def test_arrays_grow_whole_wherever_growing_was_interrupted(grown, tmp_path, monkeypatch, marked):
    name, recipe = "walker-walk/random/none.zarr", walker({"episodes": 3})

    def begin(folder, last=10**9):
        """Grow the metadata; the disk is full after so many files."""
        shutil.copytree(grown.parent / "before", folder, dirs_exist_ok=True)
        if not marked:
            (folder / name / ".created").unlink(missing_ok=True)
        left = iter(range(last))

        def copy(source, target):
            if tmp_path in Path(target).parents and next(left, None) is None:
                raise OSError(28, "No space left on device")
            copy_file(source, target)

        with monkeypatch.context() as patch:
            patch.setattr("dmcvb_gen.dataset.writer.copy_file", copy)
            prepare(make_plan(recipe, folder))
        return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("zarr.json")}

    wanted = begin(tmp_path / "once")
    group = json.loads((tmp_path / "once" / name / "zarr.json").read_text())
    assert {array["shape"][0] for array in group["consolidated_metadata"]["metadata"].values() if "shape" in array} == {
        3
    }
    assert wanted[Path(name) / "zarr.json"] != (grown.parent / "before" / name / "zarr.json").read_bytes()
    for files in range(0, len(wanted), 3):
        with pytest.raises(StoreError, match="room"):
            begin(tmp_path / str(files), files)
        prepare(make_plan(recipe, tmp_path / str(files)))
        again = {path.relative_to(tmp_path / str(files)): path for path in (tmp_path / str(files)).rglob("zarr.json")}
        assert {path: file.read_bytes() for path, file in again.items()} == wanted


@pytest.mark.parametrize("name", ["none.zarr/state/zarr.json", "static.zarr/zarr.json", "hidden.zarr/zarr.json"])
@pytest.mark.parametrize("damage", ["changed", "deleted"])
def test_damage_never_becomes_what_is_right(grown, tmp_path, name, damage):
    shutil.copytree(grown, tmp_path / "copy")
    [path] = (tmp_path / "copy").rglob(name)
    was, manifest = path.read_bytes(), (tmp_path / "copy/manifest.json").read_bytes()
    if damage == "changed":
        path.write_bytes(was.replace(b'"zarr_format": 3', b'"zarr_format":  3', 1))
    else:
        path.unlink()
    roll_out(walker(), tmp_path / "copy")  # nothing to do, and nothing done
    assert (tmp_path / "copy/manifest.json").read_bytes() == manifest and not verify(tmp_path / "copy").sound
    for there in (tmp_path / "copy", f"file://{tmp_path}/copy"):
        with pytest.raises(StoreError, match=f"{path.name}.*(damaged|missing); mend it first"):
            finish_target(Target.at(there, scratch=tmp_path / "scratch"))
    with pytest.raises(StoreError, match=f"{path.name}.*(damaged|missing); mend it first: dmcvb-gen regenerate"):
        prepare(make_plan(walker({"episodes": 3}), tmp_path / "copy"))
    Regeneration(tmp_path / "copy").repair()
    assert path.read_bytes() == was and verify(tmp_path / "copy").sound
    prepare(make_plan(walker({"episodes": 3}), tmp_path / "copy"))


def test_an_old_recipe_run_again_changes_nothing(grown):
    manifest = (grown / "manifest.json").read_bytes()
    assert not make_plan(walker(), grown).jobs
    roll_out(walker(), grown)
    assert (grown / "manifest.json").read_bytes() == manifest


@pytest.mark.parametrize(
    "recipe, words",
    [
        (lambda: walker(seed=4), "seed 3, asked for 4"),
        (lambda: walker(size=32), "size 16, asked for 32"),
        (lambda: walker(split="val"), "split train, asked for val"),
        (lambda: walker({"settings": "static", "episodes": 1}), "never shrinks"),
    ],
)
def test_what_contradicts_is_refused_by_name_before_any_work(grown, recipe, words):
    before = {path: path.read_bytes() for path in grown.rglob("*") if path.is_file()}
    with pytest.raises(StoreError, match=words) as caught:
        make_plan(recipe(), grown)
    assert "walker-walk/random/" in str(caught.value) and "delete" not in str(caught.value)
    assert before == {path: path.read_bytes() for path in grown.rglob("*") if path.is_file()}


def test_a_policy_is_the_same_whatever_its_record_says_of_its_training(grown):
    old = open_release(grown).manifest
    policy = PolicyRecord(name="own", digest="0" * 64, header={"training": {"init_from": "/home/somebody/x"}})
    bare = policy.model_copy(update={"header": {"training": {"init_from": "x"}}})
    other = policy.model_copy(update={"digest": "1" * 64})

    def given(policy):
        subsets = [old.subsets[0].model_copy(update={"policies": (policy,)}), *old.subsets[1:]]
        return old.model_copy(update={"subsets": tuple(subsets)})

    assert merged(given(policy), given(bare), "here") == given(policy)
    with pytest.raises(StoreError, match="with policies"):
        merged(given(policy), given(other), "here")


def test_a_shard_that_is_not_full_or_fixed_goals_cannot_grow(tmp_path):
    three = {"episodes": 3, "episodes_per_shard": 2}
    plan_of = lambda recipe: make_plan(recipe, tmp_path / "r")  # noqa: E731
    (tmp_path / "r").mkdir()
    manifest = plan_of(walker(three)).manifest
    (tmp_path / "r/manifest.json").write_text(manifest.model_dump_json())
    with pytest.raises(StoreError, match="last shard has 1 of 2"):
        plan_of(walker(three | {"episodes": 5}))
    fixed = {"settings": ["fixed"], "episodes": None, "episodes_per_goal": 1}
    manifest = plan_of(maze_recipe(**fixed, fixed_goals=1)).manifest
    (tmp_path / "r/manifest.json").write_text(manifest.model_dump_json())
    with pytest.raises(StoreError, match="fixed_goals 1, asked for 2|number does not grow"):
        plan_of(maze_recipe(**fixed, fixed_goals=2))


def test_versions_count_up():
    assert [next_version(version) for version in ("1.0.0", "1.9.3", "2.0")] == ["1.1.0", "1.10.0", "2.1.0"]


def test_a_fetched_copy_follows_a_release_that_grew(grown, tmp_path):
    url = f"file://{tmp_path}/there"
    publish(grown.parent / "before", url)
    fetch(url, tmp_path / "copy")
    fetch(url, tmp_path / "part", only=["walker-walk"], episodes=(0, 1))
    inodes = {path: path.stat().st_ino for name in shards_of(tmp_path / "copy") if (path := tmp_path / "copy" / name)}
    publish(grown, url)
    for copy in ("copy", "part"):
        moved = fetch(url, tmp_path / copy)
        assert 0 < moved.moved < moved.files and verify(tmp_path / copy).sound
        assert open_release(tmp_path / copy).manifest == open_release(grown).manifest
    assert inodes and inodes == {path: path.stat().st_ino for path in inodes}
    with pytest.raises(StoreError, match="choose another --out"):  # there is no way back
        fetch(f"file://{grown.parent}/before", tmp_path / "copy")


def test_a_published_release_grows_by_its_new_shards_alone(grown, tmp_path):
    url, there = f"file://{tmp_path}/there", tmp_path / "there"
    publish(grown.parent / "before", url)
    old = {path: path.stat().st_mtime_ns for path in there.rglob("*") if "/c/" in path.as_posix()}
    moved = publish(grown, url)
    new = shards_of(grown).keys() - shards_of(grown.parent / "before").keys()
    assert len(new) <= moved.moved < moved.files
    assert old == {path: path.stat().st_mtime_ns for path in old}
    assert verify(there).sound and open_release(url).manifest == open_release(grown).manifest
    fetch(url, tmp_path / "back", ["*/*/hidden"])
    assert verify(tmp_path / "back").sound
    with pytest.raises(StoreError, match="never changes"):
        publish(grown.parent / "before", url)


MAZES = SHORT | {"tasks": TINY_MAZE, "settings": ["visible", "hidden"], "episodes_per_shard": 1}
SETTINGS = {"settings": ["none", "static"]}


@pytest.mark.parametrize("family", ["walker", pytest.param("maze", marks=pytest.mark.slow)])
@pytest.mark.parametrize("bucket", [False, True], ids=["folder", "bucket"])
def test_what_grows_by_parts_is_sound_at_every_moment(tmp_path, family, bucket):
    """Two subsets of one episode grow to two: first the one, then another subset is asked for, then the rest."""
    there = f"file://{tmp_path}/r" if bucket else str(tmp_path / "r")

    def recipe(episodes, **changes):
        pattern = (MAZES if family == "maze" else WALKER | SETTINGS) | {"episodes": episodes} | changes
        return small_recipe(subsets=[pattern], size=16)

    def done(recipe, only=(), shared=False):
        target = Target.at(there, scratch=tmp_path / "scratch")
        plan = prepare(make_plan(recipe, target, only), shared=shared)
        for _ in run_jobs(plan.jobs):
            pass
        finish(plan)
        verified = verify(tmp_path / "r")
        assert verified.sound, verified.findings
        return verified.complete

    assert done(recipe(1))
    assert not done(recipe(2), only=["*/*/none", "*/*/hidden"][family == "maze" :][:1])
    more = {"levels": "random"} | (
        {"settings": "fixed", "fixed_goals": 1} if family == "maze" else {"settings": "dynamic"}
    )
    assert not done(recipe(1, **more), shared=True)
    assert done(recipe(2))


@pytest.mark.parametrize("bucket", [False, True], ids=["folder", "bucket"])
def test_the_last_to_finish_keeps_what_others_added_meanwhile(tmp_path, bucket):
    """Walker's rollout ends while somebody has begun to add a maze; then that one ends."""
    there = f"file://{tmp_path}/r" if bucket else str(tmp_path / "r")
    maze = small_recipe(seed=8, subsets=[SHORT | {"tasks": TINY_MAZE, "settings": "hidden", "episodes": 1}])

    def begun(recipe):
        return prepare(make_plan(recipe, Target.at(there, scratch=tmp_path / "scratch")))

    def done(plan):
        for _ in run_jobs(plan.jobs):
            pass
        return finish(plan)

    first = begun(walker())
    second = begun(maze)
    assert not done(first).complete and len(open_release(there).manifest.subsets) == 2
    assert done(second).complete and verify(tmp_path / "r").sound
    written = (tmp_path / "r/manifest.json").read_bytes()
    assert finish_target(Target.at(there, scratch=tmp_path / "scratch")).complete
    assert (tmp_path / "r/manifest.json").read_bytes() == written


@pytest.mark.parametrize("family", ["walker", "maze"])
@pytest.mark.parametrize("bucket", [False, True], ids=["folder", "bucket"])
def test_a_release_that_is_finished_in_between_is_never_called_damaged(tmp_path, monkeypatch, family, bucket):
    """One of two shards is made and the digests written, then the other; the second time writing them is cut off."""
    there, scratch = f"file://{tmp_path}/r" if bucket else str(tmp_path / "r"), tmp_path / "scratch"
    pattern = MAZES | {"settings": "visible"} if family == "maze" else WALKER
    recipe = small_recipe(subsets=[pattern | {"episodes": 2}], size=16)
    prepare(make_plan(recipe, Target.at(there, scratch=scratch)), shared=True)
    for part in (1, 2):
        for _ in run_jobs(make_plan(recipe, Target.at(there, scratch=scratch), part=(part, 2)).jobs):
            pass
        if part == 1:
            assert not finish_target(Target.at(there, scratch=scratch)).complete
    looked = CliRunner().invoke(main, ["verify", there])
    assert looked.exit_code == 3 and "not finished" in looked.output, looked.output
    if not bucket:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr("dmcvb_gen.files.write_bytes", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
            finish_target(Target.at(there))  # the index is new, the manifest is not
    assert finish_target(Target.at(there, scratch=scratch)).complete
    assert CliRunner().invoke(main, ["verify", there]).exit_code == 0 and verify(tmp_path / "r").sound


def test_readers_of_the_old_version_see_it_whole_until_the_new_manifest_is_there(grown, tmp_path, monkeypatch):
    url, write = f"file://{tmp_path}/there", Storage.write
    publish(grown.parent / "before", url)

    def stop(storage, path, data):
        if path == "manifest.json":
            raise StoreError("cut off")
        write(storage, path, data)

    monkeypatch.setattr(Storage, "write", stop)
    with pytest.raises(StoreError, match="cut off"):
        publish(grown, url)
    old = open_release(url)
    assert old.manifest.version == "1.0.0" and list(old.subsets) == ["walker-walk/random/none"]
    assert json.dumps(old["walker-walk/random/none"].episode(0)["reward"].tolist())
    assert list(old["walker-walk/random/none"].episodes) == [0]
    monkeypatch.setattr(Storage, "write", write)
    publish(grown, url)
    assert open_release(url).manifest.version == "1.2.0" and verify(tmp_path / "there").sound


def test_the_card_lists_the_arrays_of_every_kind_of_subset(grown, tmp_path):
    text = write_card(grown, tmp_path)[0].read_text()
    arrays = text.split("## Arrays")[1].split("## Returns")[0]
    assert "`walker-walk/random/none`, `walker-walk/random/static`:" in arrays
    assert "| `pixels` | uint8 |" in arrays and "| `pixels_hidden_goal_top` | uint8 |" in arrays
    assert arrays.count("| `physics` | float64 |") == 2


def test_repainting_keeps_to_the_recipe_that_added_each_subset(grown, tmp_path):
    name = "ant-maze-tiny/random/hidden"
    manifest = repaint(Repainting(grown, tmp_path / "new", split="val"))
    assert manifest.recipe_of(name)["seed"] == 8 and manifest.recipe["seed"] == 3
    maze = SHORT | {"tasks": TINY_MAZE, "settings": "hidden", "episodes": 1}
    whole = roll_out(small_recipe(seed=8, split="val", subsets=[maze]), tmp_path / "whole")
    digests = {record.name: record.digest for record in manifest.subsets}
    assert digests[name] == whole.subsets[0].digest and len(digests) == 3
