"""The store: what is written is what is read, and what is not committed is not there."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.store import open_release
from dmcvb_gen.store.manifest import check_relative_path, parse_commit, parse_manifest
from dmcvb_gen.store.schema import create_arrays, picture_codecs, picture_spec
from dmcvb_gen.store.writer import sha256_file, subset_digest
from dmcvb_gen.tasks import get_task

NAME = "walker-walk/random/dynamic"


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


def test_repainting_a_stored_frame_gives_the_stored_pixels(small_release):
    from dmcvb_gen.labels import EXOGENOUS_NAMES, Exogenous
    from dmcvb_gen.rollout.plan import renderer_for

    subset = open_release(small_release)[NAME]
    episode = subset.episode(2)
    labels = Exogenous(**{name: episode[f"exogenous/{name}"] for name in EXOGENOUS_NAMES})
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
    assert subset.read("state", []).shape == (0, 501, 24)
    with pytest.raises(UnknownNameError, match="state"):
        subset.read("stat")


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
