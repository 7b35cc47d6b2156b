"""Releases that were rolled out are read as they were written, by any selection."""

from __future__ import annotations

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import Copy, FileRecord, LayerList, Manifest, Resolved, ShardRecord, parse
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.loaders.painted import Painting, painted_release
from dmcvb_gen.tasks import get_task

NAME = "walker-walk/random/dynamic"
MAZE = "ant-maze-tiny/random/visible"


def test_a_release_reads_back_with_its_shapes_and_alignment(small_release):
    release = Release.open(small_release)
    assert not release.in_the_making and len(release.subsets) == 3
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
    release = Release.open(request.getfixturevalue(family))
    for subset in painted_release(release, Painting()).subsets.values() if painted else release.subsets.values():
        read = list(subset.each_episode())
        assert [episode for episode, _ in read] == list(subset.episodes) and len(read) > 1
        for episode, values in read:
            alone = subset.episode(episode)
            assert list(values) == list(alone)
            for name, value in alone.items():
                np.testing.assert_array_equal(values[name], value)


def test_any_selection_gives_what_numpy_gives_and_a_wrong_one_is_no_damage(small_release):
    subset = Release.open(small_release)[NAME]
    stored, whole, mask = subset.array("state"), subset.read("state"), np.array([True, False, True])
    for episodes in ([2, 0], slice(1, 3), slice(None, None, -1), []):
        np.testing.assert_array_equal(subset.read("state", episodes), whole[episodes])
    with pytest.raises(UnknownNameError, match="state"):
        subset.read("stat")
    for index in (1, -1, [2, 0], [], mask, slice(None, None, -1), (), ..., (..., 3), (mask, 0), (0, [1, 5])):
        np.testing.assert_array_equal(stored[index], whole[index])
    for index in (7, [0, 99], [0.5], ["a"], 0.5, "a", None, np.array([True, False]), ([0, 2], [1, 2]), (0, 0, 0, 0)):
        with pytest.raises(IndexError):
            stored[index]


@pytest.mark.parametrize("path", ["/etc/passwd", "../x", "a/../../b", "a//b", "", "a/./b", "c:\\x", "a/\x00"])
def test_paths_that_leave_their_folder_are_refused(path):
    with pytest.raises(ValueError, match="should match pattern"):
        FileRecord(path=path, bytes=1, sha256="0" * 64)


@given(st.text())
def test_no_text_makes_a_manifest_crash(text):
    for model in (Manifest, Resolved, LayerList, ShardRecord, Copy):
        with pytest.raises(StoreError):
            parse(model, text.encode(errors="surrogatepass"), "here")


@pytest.mark.parametrize("family,name", [("small_release", NAME), ("maze_release", MAZE)])
def test_xarray_opens_a_set_of_trajectories_with_all_its_settings(request, family, name):
    root = request.getfixturevalue(family)
    subset = Release.open(root)[name]
    group = subset.trajectories.group.removesuffix("/trajectories")
    tree = xarray.open_datatree(str(root / group), engine="zarr")
    states, setting = tree["trajectories"], tree[subset.setting]
    assert states["state"].dims == ("episode", "step", "state_dim") and states["length"].dims == ("episode",)
    assert states["action"].attrs["low"] == [-1.0] * states["action"].shape[-1]
    for array in subset.pixel_arrays:
        found = setting[array.replace("/", "_")]
        assert found.dims == ("episode", "step", "height", "width", "channel")
        np.testing.assert_array_equal(found[0], subset.read(array, [0])[0])
    assert tree.attrs["task"] == subset.task and not states.coords
    labels = zarr.open_group(str(root / group), mode="r")[f"{subset.setting}/exogenous/style"]
    np.testing.assert_array_equal(labels[:], subset.read("exogenous/style"))
    merged = xarray.merge([states.to_dataset(), setting.to_dataset()])
    assert {"state", "pixels" if family == "small_release" else "pixels_top"} <= {*merged}
