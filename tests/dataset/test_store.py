"""The store: what is written is what is read, and what is not committed is not there."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given
from hypothesis import strategies as st

import dmcvb_gen
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import check_relative_path, parse_commit, parse_manifest
from dmcvb_gen.dataset.schema import create_arrays, picture_codecs, picture_spec
from dmcvb_gen.dataset.writer import finish_release, sha256_file, subset_digest
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.plan import finish, make_plan, prepare
from dmcvb_gen.loaders.painted import Painting, painted_release
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.publish import publish
from dmcvb_gen.tasks import get_task
from tests.conftest import small_recipe

NAME = "walker-walk/random/dynamic"
MAZE = "ant-maze-tiny/random/visible"


@pytest.mark.parametrize(
    "layout",
    [
        "zstd",
        "zstd-9",
        "blosc-bitshuffle",
        "time-zstd",
        "time-delta-zstd",
        "width-delta-zstd",
        "channel-delta-zstd",
        "width-delta-blosc",
    ],
)
def test_every_picture_layout_is_lossless_and_skips_rows_past_the_end(tmp_path, layout):
    assert picture_codecs(layout)
    group = zarr.create_group(str(tmp_path))
    create_arrays(group, (picture_spec("pixels", 8),), 4, 21, 2, layout, 8)
    values = np.random.default_rng(0).integers(0, 255, (2, 21, 8, 8, 3), np.uint8)
    values[:, 8:] = 0
    group["pixels"][2:4] = values
    np.testing.assert_array_equal(zarr.open_group(str(tmp_path), mode="r")["pixels"][2:4], values)
    files = [path for path in tmp_path.rglob("*") if path.is_file() and path.name != "zarr.json"]
    assert len(files) == 1 and files[0].stat().st_size < 2 * 9 * 8 * 8 * 3 + 500


def test_a_release_reads_back_with_its_shapes_and_alignment(small_release):
    release = open_release(small_release)
    assert release.manifest.complete and len(release.subsets) == 3
    subset, task = release[NAME], get_task("walker-walk")
    assert list(subset.episodes) == [0, 1, 2] and list(subset.lengths) == [500] * 3 and subset.steps == 1500
    episode = subset.episode(1)
    assert episode["pixels"].shape == (501, 16, 16, 3) and episode["state"].shape == (501, 24)
    assert episode["action"].shape == (500, 6) and episode["physics"].shape == (501, task.physics_size)
    assert np.abs(episode["action"]).max() <= 1 and episode["action"].std() > 0.4
    assert episode["return"] == pytest.approx(episode["reward"].astype(float).sum(), abs=1e-9)
    assert (episode["discount"] == 1).all() and not episode["terminated"]
    batch = task.batch(1)
    for step in (0, 17, 499):  # row t: physics t gives state t; action t earns reward t and leads to row t + 1
        state = batch.set_physics(episode["physics"][step : step + 1])
        np.testing.assert_array_equal(state[0].astype(np.float32), episode["state"][step])
        result = batch.step(episode["action"][step : step + 1])
        assert result.reward[0].astype(np.float32) == episode["reward"][step]
        np.testing.assert_array_equal(batch.physics()[0], episode["physics"][step + 1])


@pytest.mark.parametrize("family", ["small_release", "maze_release"])
@pytest.mark.parametrize("painted", [False, True])
def test_each_episode_of_a_subset_is_what_reading_it_alone_gives(request, family, painted):
    """In shards of one and of two episodes, the last one not full; mazes' episodes end early."""
    release = open_release(request.getfixturevalue(family))
    for subset in painted_release(release, Painting()).subsets.values() if painted else release.subsets.values():
        read = list(subset.each_episode())
        assert [episode for episode, _ in read] == list(subset.episodes) and len(read) > 1
        for episode, values in read:
            alone = subset.episode(episode)
            assert list(values) == list(alone)
            for name, value in alone.items():
                np.testing.assert_array_equal(values[name], value)


def test_repainting_a_stored_frame_gives_the_stored_pixels(small_release):
    from dmcvb_gen.generate.render import renderer_for

    subset = open_release(small_release)[NAME]
    episode = subset.episode(2)
    labels = subset.labels([2])[0]
    steps = [0, 3, 250, 500]
    renderer, _ = renderer_for(subset.record, "builtin", "train")
    np.testing.assert_array_equal(
        renderer.render(episode["physics"][steps], labels[steps])[:, 0], episode["pixels"][steps]
    )


def test_the_settings_of_a_seed_share_states_and_rewards_and_differ_in_pixels(small_release):
    release = open_release(small_release)
    none, static, dynamic = (release[f"walker-walk/random/{name}"] for name in ("none", "static", "dynamic"))
    for name in ("state", "action", "reward", "physics", "length", "seed"):
        np.testing.assert_array_equal(none.read(name), static.read(name))
        np.testing.assert_array_equal(none.read(name), dynamic.read(name))
    assert (none.read("pixels") != static.read("pixels")).mean() > 0.5
    assert (static.read("pixels") != dynamic.read("pixels")).mean() > 0.3


def test_xarray_opens_a_subset_with_named_dimensions(small_release):
    data = xarray.open_zarr(small_release / f"{NAME}.zarr")
    assert data["pixels"].dims == ("episode", "step", "height", "width", "channel")
    assert data["state"].dims == ("episode", "step", "state_dim") and data["length"].dims == ("episode",)
    assert float(data["reward"].isel(episode=1).sum()) == pytest.approx(
        open_release(small_release)[NAME].returns[1], rel=1e-4
    )
    assert data.attrs["task"] == "walker-walk" and data.attrs["state_fields"]["height"] == [14, 15]


def test_xarray_opens_a_maze_at_its_root_with_all_pictures(maze_release):
    path = maze_release / f"{MAZE}.zarr"
    data = xarray.open_zarr(path)
    subset = open_release(maze_release)[MAZE]
    for view in ("top", "egocentric", "follow", "overhead"):
        for kind in ("pixels", "pixels_hidden_goal"):
            found = data[f"{kind}_{view}"]
            assert found.dims == ("episode", "step", "height", "width", "channel")
            np.testing.assert_array_equal(found[0], subset.read(f"{kind}/{view}", [0])[0])
    assert {"action", "state", "physics"} <= set(data.data_vars) and not data.coords


@pytest.mark.parametrize("name", [NAME, MAZE])
def test_a_release_of_version_1_reads_as_before(small_release, maze_release, tmp_path, name):
    source = small_release if name == NAME else maze_release
    folder = version_1(source, tmp_path / "old", name)
    old, new = open_release(folder)[name], open_release(source)[name]
    assert open_release(folder).manifest.schema_version == 1
    assert old.arrays == new.arrays and old.record.views == new.record.views and old.record.family == new.record.family
    assert old.record.max_steps == (500 if name == NAME else 1200) and not old.record.hidden_goal
    for array in new.arrays:
        np.testing.assert_array_equal(old.read(array), new.read(array))
    data = dmcvb_gen.open(folder)[name].xarray()
    assert {"action", "state", "physics", "exogenous_style"} <= set(data.data_vars)
    xarray.testing.assert_equal(data.drop_attrs(), dmcvb_gen.open(source)[name].xarray().drop_attrs())
    write_card(folder)  # with no digest to say
    assert check_card(folder) == [] and publish(folder, f"file:{tmp_path / 'there'}").moved


def version_1(source, folder, name):
    """One subset of a release as version 1 laid it out: a group for a kind of picture, dimensions named as arrays."""
    shutil.copytree(source, folder, ignore=lambda path, names: [n for n in names if n == "files.json"])
    root = folder / f"{name}.zarr"
    for path in sorted(root.glob("pixels_*")):
        kind, _, view = path.name.rpartition("_")
        zarr.open_group(str(root / kind), mode="a")
        path.rename(root / kind / view)
    for path in root.rglob("zarr.json"):
        data = json.loads(path.read_text())
        data.pop("consolidated_metadata", None)
        data["attributes"].pop("array", None)
        if data["node_type"] == "array":
            data["dimension_names"] = [dimension.removesuffix("_dim") for dimension in data["dimension_names"]]
        path.write_text(json.dumps(data))
    zarr.consolidate_metadata(str(root))
    manifest = json.loads((folder / "manifest.json").read_text())
    keep = ("name task level setting episodes episodes_per_shard size deterministic policies renderer backgrounds "
            "digest").split()  # fmt: skip
    records = [record for record in manifest["subsets"] if record["name"] == name]
    manifest["subsets"] = [{field: record[field] for field in keep} for record in records]
    known = "name version license authors generator recipe subsets environments lineage complete format".split()
    manifest = {field: manifest[field] for field in known} | {"schema_version": 1}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    for path in (folder / "commits" / name).glob("*.json"):
        data = json.loads(path.read_text())
        del data["environment"]
        for file in data["files"]:
            file["path"] = re.sub(r"/(pixels_hidden_goal|pixels)_([a-z]+)/", r"/\1/\2/", file["path"])
        path.write_text(json.dumps(data))
    return folder


def test_a_subset_without_its_marker_keeps_every_shard(small_release, tmp_path):
    """`publish` and plain copies do not carry `.created`; going on with a rollout must not start the subset anew."""
    folder = tmp_path / "copy"
    shutil.copytree(small_release, folder)
    (folder / f"{NAME}.zarr" / ".created").unlink()
    (folder / "commits" / NAME / "00001.json").unlink()
    (folder / f"{NAME}.zarr" / "reward" / "zarr.json").unlink()
    (folder / "files.json").unlink()  # there is none while a rollout is under way
    kept = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json"}
    plan = prepare(make_plan(small_recipe(), folder))
    assert {path: path.read_bytes() for path in kept if path.name != "files.json"} == {
        path: data for path, data in kept.items() if path.name != "files.json"
    }
    assert [job.shard for job in plan.jobs] == [1]
    assert (folder / f"{NAME}.zarr" / "reward" / "zarr.json").is_file()
    for _ in run_jobs(plan.jobs, 1):
        pass
    digests = {subset.name: subset.digest for subset in finish(plan).subsets}
    assert digests == {name: subset.record.digest for name, subset in open_release(small_release).subsets.items()}


def test_the_store_knows_no_tasks():
    code = "import sys, dmcvb_gen.dataset; print([m for m in sys.modules if m in ('mujoco', 'dmcvb_gen.tasks')])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_a_commit_says_where_it_was_made_and_the_manifest_sums_up(small_release, tmp_path):
    release = open_release(small_release)
    made = [commit.environment for subset in release.subsets.values() for commit in subset.commits.values()]
    assert all(environment["mujoco"] for environment in made)
    assert release.manifest.environments == (made[0],)
    folder = tmp_path / "copy"
    shutil.copytree(small_release, folder)
    path = folder / "commits" / NAME / "00001.json"
    commit = json.loads(path.read_text())
    commit["environment"]["cpu"] = "Another 9000"
    path.write_text(json.dumps(commit))
    finished = finish_release(folder, release.manifest)
    assert [where["cpu"] for where in finished.environments] == [made[0]["cpu"], "Another 9000"]


def test_digests_of_the_records_are_those_of_the_files(small_release):
    release = open_release(small_release)
    for subset in release.subsets.values():
        for commit in subset.commits.values():
            for file in commit.files:
                assert sha256_file(small_release / file.path) == file.sha256
        assert subset.record.digest == subset_digest(subset.commits)


def test_what_is_not_committed_is_not_there(small_release, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(small_release, copy)
    (copy / "commits" / NAME / "00000.json").unlink()
    subset = open_release(copy)[NAME]
    assert list(subset.episodes) == [2]
    with pytest.raises(StoreError, match="no episode 0"):
        subset.read("state", [0])
    file = next(file for file in subset.commits[1].files if "/pixels/" in file.path)
    (copy / file.path).write_bytes((copy / file.path).read_bytes()[:-10])  # cut short
    assert NAME not in open_release(copy).subsets


def test_reading_any_selection_gives_what_whole_reading_gives(small_release):
    subset = open_release(small_release)[NAME]
    whole = subset.read("state")
    np.testing.assert_array_equal(subset.read("state", [2, 0]), whole[[2, 0]])
    np.testing.assert_array_equal(subset.read("state", slice(1, 3)), whole[1:3])
    np.testing.assert_array_equal(subset.read("state", slice(None, None, -1)), whole[::-1])
    assert subset.read("state", []).shape == (0, 501, 24)
    with pytest.raises(UnknownNameError, match="state"):
        subset.read("stat")


def test_arrays_take_numpys_indices_and_a_wrong_one_is_no_damage(small_release):
    stored = open_release(small_release)[NAME].array("state")
    whole = stored[:]
    mask = np.array([True, False, True])
    for index in (1, -1, [2, 0], mask, slice(None, None, -1), (), ..., (..., 3), (mask, 0), (0, [1, 5])):
        np.testing.assert_array_equal(stored[index], whole[index])
    np.testing.assert_array_equal(stored[[]], whole[:0])
    for index in (7, [0, 99], [0.5], ["a"], 0.5, "a", None, np.array([True, False]), ([0, 2], [1, 2]), (0, 0, 0, 0)):
        with pytest.raises(IndexError, match="StoredArray state"):
            stored[index]


@pytest.mark.parametrize("path", ["/etc/passwd", "../x", "a/../../b", "a//b", "", "a/./b", "c:\\x", "a/\x00"])
def test_paths_that_leave_their_folder_are_refused(path):
    with pytest.raises(ValueError, match="not a plain relative path"):
        check_relative_path(path)


@given(st.text())
def test_no_text_makes_a_manifest_crash(text):
    with pytest.raises(StoreError):
        parse_manifest(text)
    with pytest.raises(StoreError):
        parse_commit(text)


def test_a_chunk_larger_than_a_shard_is_refused_before_it_is_decoded(small_release, tmp_path):
    name = next(iter(open_release(small_release).subsets))
    shutil.copytree(small_release, tmp_path / "r")
    for path in (tmp_path / "r" / f"{name}.zarr").rglob("zarr.json"):
        node = json.loads(path.read_bytes())
        metadata = (node.get("consolidated_metadata") or {}).get("metadata", {})
        for array in [metadata.get("length"), node if path.parent.name == "length" else None]:
            if array:
                array["chunk_grid"]["configuration"]["chunk_shape"] = [10**9]
        path.write_text(json.dumps(node))
    with pytest.raises(StoreError, match="length of .* in chunks of .1000000000"):
        open_release(tmp_path / "r")[name].read("length")


def test_a_newer_schema_is_refused_with_the_cure(small_release):
    data = json.loads((small_release / "manifest.json").read_text())
    data["schema_version"] += 1
    with pytest.raises(StoreError, match="install a newer dmcvb-gen"):
        parse_manifest(json.dumps(data))


def test_a_folder_without_a_release_says_so(tmp_path):
    with pytest.raises(StoreError, match="holds no release"):
        open_release(tmp_path)


def test_a_release_is_read_through_a_url(small_release):
    release = open_release(f"file://{small_release}")
    np.testing.assert_array_equal(release[NAME].read("reward"), open_release(small_release)[NAME].read("reward"))


def test_the_root_digest_names_the_data_and_not_the_machine(small_release):
    from dmcvb_gen.dataset.index import read_index, root_digest

    manifest = open_release(small_release).manifest
    listed = read_index(small_release).files
    elsewhere = manifest.model_copy(update={"environments": ({"cpu": "another"},)})
    moved = [f.model_copy(update={"sha256": "0" * 64}) if f.path.startswith("commits/") else f for f in listed]
    assert root_digest(moved, elsewhere) == manifest.digest
    other = [f.model_copy(update={"sha256": "0" * 64}) if f.path.endswith("/zarr.json") else f for f in listed]
    assert root_digest(other, manifest) != manifest.digest
