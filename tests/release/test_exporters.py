"""What every export format must do, for a locomotion task and a maze; formats of other packages are found."""

from __future__ import annotations

import importlib.metadata
import io
import json
import re
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from PIL import Image

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, StoreError, UnknownNameError
from dmcvb_gen.release.export import STAMP, export, registry
from dmcvb_gen.release.export.registry import get_format, register_exporter
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.tfrecord import decode_example, encode_example, offsets, read_example
from tests.conftest import invoke, roll_out, small_recipe

SUBSETS = {"small": "walker-walk/random/static", "mazes": "ant-maze-tiny/random/hidden"}
"""Folder of a release -> a subset of it."""
VIEWS = ("top", "egocentric", "follow", "overhead")
"""Of mazes, in the order in which policies see them (SPEC, section 3)."""


def in_order(names):
    """Names of images in the order of their views; the one name of a task with one view."""
    names = list(names)
    return [name for view in VIEWS for name in names if view in name] or names


def stacked(images):
    """Images of each view as the channels of one array; decoded if they are files."""
    views = [[np.asarray(Image.open(io.BytesIO(i))) if isinstance(i, bytes) else i for i in view] for view in images]
    return np.concatenate([np.stack(view) for view in views], axis=-1)


# -- readers: what the program that a format is for finds of each episode: actions, rewards, images of all views --


def read_hdf5(folder):
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "data_000.hdf5") as file:
        data = {name: file[name][:] for name in file}
    assert len({len(value) for value in data.values()}) == 1  # the loader's own check
    starts = np.flatnonzero(data["step_type"] == 0)
    assert list(np.flatnonzero(data["step_type"] == 2)) == [*(starts[1:] - 1), len(data["step_type"]) - 1]
    for name in ("action", "reward"):
        assert not data[name][starts].any()  # nothing was done before the first observation
    for rows in np.split(np.arange(len(data["step_type"])), starts[1:]):
        images = data["observation"][rows].transpose(0, 2, 3, 1)
        yield data["action"][rows][1:], data["reward"][rows][1:], images


def read_npz(folder):
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as data:
            rows = int(str(path).split("-")[-1][:-4])  # how the loader finds the length
            flags = np.stack([data["is_first"], data["is_last"]])
            assert (flags.argmax(axis=1) == (0, rows - 1)).all() and flags.sum() == 2
            assert not data["action"][0].any() and data["is_terminal"].sum() == (data["discount"][-1] == 0)
            yield data["action"][1:], data["reward"][1:], data["image"]


def read_zarr(folder):
    data = zarr.open_group(str(folder / "data.zarr"), mode="r")
    names = [name for name in data if "hidden_goal" in name] or [name for name in data if name.startswith("pixels")]
    for row, length in enumerate(data["length"][:]):
        images = stacked(data[name][row, : length + 1] for name in in_order(names))
        yield data["action"][row, :length], data["reward"][row, :length], images


def read_replay_buffer(folder):
    assert (folder / "replay_buffer.zarr/data/action/.zarray").is_file()  # Zarr 2, which that code reads
    root = zarr.open_group(str(folder / "replay_buffer.zarr"), mode="r")
    data, ends = root["data"], root["meta/episode_ends"][:]
    assert ends.dtype == np.int64 and {data[name].shape[0] for name in data} == {ends[-1]}
    for first, last in zip([0, *ends], ends, strict=False):
        images = stacked(data[name][first:last] for name in in_order(name for name in data if name.startswith("img")))
        yield data["action"][first:last], data["reward"][first:last], images


def read_minari(folder):
    minari = pytest.importorskip("minari")
    for episode in minari.MinariDataset(folder / "data").iterate_episodes():
        yield episode.actions, episode.rewards, episode.observations["pixels"]


def read_lerobot(folder):
    datasets = pytest.importorskip("datasets")
    table = datasets.load_dataset(str(folder), split="train", cache_dir=str(folder.parent / "cache"))
    names = in_order(name for name in table.features if name.startswith("observation.image"))
    for episode in sorted(set(table["episode_index"])):
        rows = table.filter(lambda index, wanted=episode: index == wanted, input_columns="episode_index")[:]
        assert list(np.flatnonzero(rows["next.done"])) == [len(rows["action"]) - 1]
        images = stacked([np.asarray(picture) for picture in rows[name]] for name in names)
        yield rows["action"], rows["next.reward"], images


def read_rlds(folder):
    [described] = folder.rglob("features.json")
    features = json.loads(described.read_text())["featuresDict"]["features"]
    step = features["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    named = {f"steps/observation/{name}" for name in step.pop("observation")["featuresDict"]["features"]}
    [path] = folder.rglob("*.tfrecord-*")
    for place in offsets(path):
        example = read_example(path, *place)
        assert set(example) == named | {f"steps/{name}" for name in step} | set(features) - {"steps"}
        rows = len(example["steps/reward"])
        assert list(np.flatnonzero(example["steps/is_last"])) == [rows - 1]
        names = in_order(name for name in example if name.endswith("/pixels") or "camera" in name)
        actions = np.reshape(example["steps/action"], (rows, -1))[:-1]
        yield actions, example["steps/reward"][:-1], stacked(example[name] for name in names)


READERS = {
    "hdf5": read_hdf5,
    "npz": read_npz,
    "replay-buffer": read_replay_buffer,
    "zarr": read_zarr,
    "minari": read_minari,
    "lerobot": read_lerobot,
    "rlds": read_rlds,
}


@pytest.fixture(params=["small_release", "small_mazes"])
def source(request):
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("to", READERS)
def test_an_export_has_the_stored_values_no_place_of_this_machine_and_is_not_written_twice(source, to, tmp_path):
    for module in get_format(to).modules:
        pytest.importorskip(module)
    name = SUBSETS[source.name]
    [folder] = export(str(source), to, tmp_path, [name], (0, 2))
    assert to == json.loads((folder / STAMP).read_text())["format"]
    subset = dmcvb_gen.open(str(source))[name]
    views = ["pixels"] if name.startswith("walker") else [f"pixels_hidden_goal/{view}" for view in VIEWS]
    for index, (actions, rewards, images) in enumerate(READERS[to](folder)):
        stored = subset.episode(index, ["action", "reward", *views])
        np.testing.assert_array_equal(np.asarray(actions, np.float32), stored["action"])
        np.testing.assert_array_equal(np.asarray(rewards, np.float32), stored["reward"])
        np.testing.assert_array_equal(images, stacked(stored[view][: len(images)] for view in views))
        assert len(images) >= len(stored["reward"])
    assert index == 1
    written = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    for path in written:
        content = path.read_bytes()
        assert not any(str(place).encode() in content for place in (tmp_path, source, source.parent)), path
    assert export(str(source), to, tmp_path, [name], (0, 2)) == [folder]
    assert written == {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(DmcvbError, match="holds something else"):
        export(str(source), to, tmp_path, [name], (1, 2))


def test_examples_are_those_of_tensorflow():
    """The message of TensorFlow's own tutorial on tf.train.Example, to the byte."""
    bytes_of_the_tutorial = (
        b"\nR\n\x14\n\x08feature2\x12\x08\n\x06\n\x04goat\n\x11\n\x08feature1\x12\x05\x1a\x03\n\x01\x04\n\x14\n\x08"
        b"feature3\x12\x08\x12\x06\n\x04[\xd3|?\n\x11\n\x08feature0\x12\x05\x1a\x03\n\x01\x00"
    )
    found = decode_example(bytes_of_the_tutorial)
    assert found == {"feature0": [0], "feature1": [4], "feature2": [b"goat"], "feature3": [np.float32(0.9876)]}
    assert decode_example(encode_example(found)) == found and len(encode_example(found)) == len(bytes_of_the_tutorial)


def test_rlds_has_dmc_vbs_names(small_release, tmp_path):
    [folder] = export(str(small_release), "rlds", tmp_path, [SUBSETS["small"]], (0, 1))
    [path] = folder.rglob("*.tfrecord-00000-of-00001")
    [place] = offsets(path)
    state = Release.open(small_release)[SUBSETS["small"]].episode(0, ["state"])["state"]
    np.testing.assert_array_equal(read_example(path, *place)["steps/observation/height"], state[:, 14])
    [described] = folder.rglob("features.json")
    step = json.loads(described.read_text())["featuresDict"]["features"]["steps"]["sequence"]["feature"]
    observation = step["featuresDict"]["features"]["observation"]["featuresDict"]["features"]
    assert observation["height"]["tensor"]["shape"] == {} and observation["velocity"]["tensor"]["dtype"] == "float64"
    names = json.loads(described.with_name("metadata.json").read_text())
    assert names["action"][-1] == "left_ankle" and names["joints"][-1] == "left_ankle"


def test_a_zarr_group_has_all_arrays_of_a_subset_for_zarr_and_xarray(source, tmp_path):
    subset = dmcvb_gen.open(source)[SUBSETS[source.name]]
    [folder] = export(source, "zarr", tmp_path, [subset.name], (1, 2))
    with warnings.catch_warnings(action="error"):
        group = zarr.open_group(str(folder / "data.zarr"), mode="r")
        data = xarray.open_zarr(folder / "data.zarr").load()
    names = {name: name.replace("/", "_") for name in subset.arrays}
    assert {*group} == {*data.variables} == {*names.values(), "episode"}
    assert data["episode"].values.tolist() == [1] and data["length"].dims == ("episode",)
    for name, flat in names.items():
        stored = subset.read(name, [1])
        np.testing.assert_array_equal(group[flat][:], stored)
        np.testing.assert_array_equal(data[flat].values, stored)
        assert data[flat].dims == subset.array(name).dimensions and data[flat].dtype == stored.dtype
    actuator = {"walker-walk": "left_ankle"}.get(subset.task, "walker/back_left_ankle")
    assert data.attrs["task"] == subset.task and data["action"].attrs["names"][-1] == actuator
    assert len(data["state"].attrs["names"]) == data["state"].shape[-1] and data.attrs["joints"]


def test_an_export_into_the_release_itself_is_refused(small_release):
    before = sorted(small_release.rglob("*"))
    for out in (small_release, small_release / "exports"):
        with pytest.raises(StoreError, match="lies in the release itself; give another folder"):
            export(str(small_release), "npz", out)
    assert sorted(small_release.rglob("*")) == before


def test_every_format_of_this_package_has_a_reader_and_its_line_in_the_docs():
    here = [kind for kind in registry.FORMATS.all().values() if kind.write.__module__.startswith("dmcvb_gen.")]
    assert sorted(kind.name for kind in here) == sorted(READERS)
    page = (Path(__file__).parents[2] / "docs/exports.md").read_text()
    for kind in here:
        needs = ", ".join(f"`{module}`" for module in kind.modules)
        assert re.search(rf"^\| `{kind.name}` \|.*\| {needs} \|$", page, re.MULTILINE)


def test_a_format_of_another_package_is_found_by_its_entry_point(maze_release, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "their_exporter", types.ModuleType("their_exporter"))

    class Entry(importlib.metadata.EntryPoint):
        def load(self):
            if self.name == "broken":
                raise ImportError("something is missing")

            @register_exporter("returns")
            def write(source, folder):
                returns = [str(float(episode.reward.astype(np.float64).sum())) for episode in source]
                (folder / "returns.txt").write_text("\n".join(returns))

    formats = registry.FORMATS
    entries = [Entry(name, "their_exporter", formats.group) for name in ("broken", "returns")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries if group == formats.group else [])
    monkeypatch.setattr(formats, "_things", dict(formats.all()))
    monkeypatch.setattr(formats, "_loaded", False)
    invoke("export", maze_release, "--to", "returns", "--out", tmp_path, code=0)
    [subset] = dmcvb_gen.open(str(maze_release)).subsets.values()
    text = (tmp_path / subset.name / "returns.txt").read_text()
    np.testing.assert_allclose([float(line) for line in text.split()], subset.returns, rtol=1e-6)
    with pytest.raises(DmcvbError, match="two formats are called npz"):
        register_exporter("npz")(lambda source, folder: None)


# -- the command --------------------------------------------------------------------------------------------


def test_an_interrupted_export_goes_on_and_folders_are_named_as_out_names_them(small_release, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["export", small_release, "--to", "npz", "--only", "*/none", "--only", "*/static", "--range", "2:3"]
    done = invoke(*command, "--out", "here", code=0)
    assert done.output.splitlines()[-1] == "here/walker-walk/random/static"
    kept = tmp_path / "here/walker-walk/random/none"
    Path("here/walker-walk/random/static").rename("gone")
    written = kept.stat().st_mtime_ns
    there = invoke(*command, "--out", tmp_path / "here", code=0).output.splitlines()[-1]
    assert there == f"{tmp_path}/here/walker-walk/random/static" and list(Path(there).glob("*.npz"))
    assert kept.stat().st_mtime_ns == written
    assert not [path for path in tmp_path.rglob(".*") if path.name != STAMP]


@pytest.mark.slow
def test_of_unfinished_releases_only_the_same_one_counts_as_exported(tmp_path):
    for name, seed in (("a", 3), ("b", 4)):
        release = roll_out(small_recipe(seed=seed), tmp_path / name, works=lambda works: works[:1])
        assert release.in_the_making
    for _ in range(2):  # the second time, everything is there
        export(tmp_path / "a", "npz", tmp_path / "x", ["*/static"], (0, 2))
    with pytest.raises(StoreError, match="holds something else"):
        export(tmp_path / "b", "npz", tmp_path / "x", ["*/static"], (0, 2))


MISTAKES = {
    "no format": (dict(to="csv"), UnknownNameError, "lerobot"),
    "a reader's name": (dict(to="tfds"), DmcvbError, "unknown format 'tfds'. Did you mean 'rlds'?"),
    "no episodes": (dict(episode_range=(50, 60)), StoreError, "none of the episodes 50:60"),
    "no package": (dict(to="hdf5"), DmcvbError, "h5py.*: pip install h5py"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_answered(small_release, tmp_path, monkeypatch, name):
    given, error, words = MISTAKES[name]
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(error, match=words):
        export(small_release, **(dict(to="npz", out=tmp_path) | given))


@pytest.mark.slow
def test_workers_write_to_a_relative_folder_which_minari_takes_for_one_of_its_own(small_mazes, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    for folder in export(str(small_mazes), "minari", "here", ["*/hidden", "*/fixed"], workers=2):
        assert folder.relative_to(tmp_path / "here/dmcvb_gen") and (folder / "data/metadata.json").is_file()


def test_nothing_that_is_missing_is_left_out_silently(small_release, tmp_path):
    fetch(f"file:{small_release}", tmp_path / "part", ["*/static"], (0, 1))
    command = ["export", tmp_path / "part", "--to", "npz", "--out", tmp_path / "out", "--only"]
    refused = invoke(*command, "*/static", code=2).output
    assert "walker-walk/random/static has 2 of 3 episodes and lacks episode 2" in refused
    assert "has no episode of it" in invoke(*command, "*/none", code=2).output
    assert not list((tmp_path / "out").rglob("*.npz"))
    invoke(*command, "*/static", "--range", "0:2", code=0)
