"""Exports, read back as the programs that they are for read them."""

from __future__ import annotations

import io
import json
import shutil
import struct
import sys
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import zarr
from click.testing import CliRunner
from PIL import Image

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, StoreError, UnknownNameError
from dmcvb_gen.release.export import STAMP, export
from dmcvb_gen.release.fetch import fetch
from tests.conftest import roll_out, small_recipe

NAME = "walker-walk/random/static"


@pytest.fixture(scope="module")
def episodes(small_release):
    subset = Release.open(small_release)[NAME]
    return [subset.episode(index) for index in range(3)]


@pytest.fixture(scope="module")
def exported(small_release, tmp_path_factory):
    """format -> its folder of the static subset's episodes 0 and 1, made once."""
    made = {}

    def get(to, **options):
        if to not in made:
            out = tmp_path_factory.mktemp(to)
            [made[to]] = export(small_release, to, out, [NAME], (0, 2), **options)
        return made[to]

    return get


def test_hdf5_reads_as_v_d4rls_loader_reads_it(exported, episodes):
    h5py = pytest.importorskip("h5py")
    [path] = sorted(exported("hdf5").glob("*.hdf5"))
    with h5py.File(path) as file:
        data = {name: file[name][:] for name in file}
    assert {"observation", "action", "reward", "discount", "step_type"} <= set(data)
    assert all(len(value) == 1002 for value in data.values())  # the loader's own check: all of one length
    assert data["observation"].shape == (1002, 3, 16, 16) and data["observation"].dtype == np.uint8
    number, step = -1, 0
    for row in range(1002):  # one time step after another, as dm_env gives them
        first = {0: True, 1: False, 2: False}[data["step_type"][row]]
        number, step = (number + 1, 0) if first else (number, step + 1)
        np.testing.assert_array_equal(data["observation"][row], episodes[number]["pixels"][step].transpose(2, 0, 1))
        if first:
            assert not data["action"][row].any() and data["reward"][row] == 0
        else:
            np.testing.assert_array_equal(data["action"][row], episodes[number]["action"][step - 1])
            assert data["reward"][row] == episodes[number]["reward"][step - 1]
    assert number == 1 and list(np.flatnonzero(data["step_type"] == 2)) == [500, 1001]


def test_npz_reads_as_v_d4rls_dreamer_reads_it(exported, episodes):
    files = sorted(exported("npz").glob("*.npz"))
    assert [int(str(path).split("-")[-1][:-4]) for path in files] == [501, 501]  # how the loader finds the length
    with files[1].open("rb") as file:
        data = dict(np.load(file))
    np.testing.assert_array_equal(data["image"], episodes[1]["pixels"])
    np.testing.assert_array_equal(data["action"][1:], episodes[1]["action"])
    np.testing.assert_array_equal(data["reward"][1:], episodes[1]["reward"])
    assert data["is_first"][0] and data["is_first"].sum() == 1 and data["is_last"][500] and data["is_last"].sum() == 1
    assert not data["is_terminal"].any() and (data["discount"] == 1).all() and not data["action"][0].any()


def test_the_replay_buffer_has_diffusion_policys_layout(exported, episodes):
    folder = exported("replay-buffer") / "replay_buffer.zarr"
    assert (folder / "data/img/.zarray").is_file()  # Zarr 2, which that code reads
    root = zarr.open_group(str(folder), mode="r")
    ends = root["meta/episode_ends"][:]
    assert list(ends) == [500, 1000] and ends.dtype == np.int64
    for name in root["data"]:
        assert root["data"][name].shape[0] == ends[-1]
    np.testing.assert_array_equal(root["data/img"][500:1000], episodes[1]["pixels"][:500])
    np.testing.assert_array_equal(root["data/action"][500:1000], episodes[1]["action"])
    np.testing.assert_array_equal(root["data/state"][:500], episodes[0]["state"][:500])


def example_class():
    """tf.train.Example, built from its published definition with Google's protocol buffer library."""
    descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="example_test.proto", package="t", syntax="proto3")

    def message(name, *fields):
        made = file.message_type.add(name=name)
        for field in fields:
            made.field.add(**field)
        return made

    def field(name, number, kind, label=1, **more):
        return dict(name=name, number=number, type=kind, label=label, **more)

    message("BytesList", field("value", 1, 12, 3))
    message("FloatList", field("value", 1, 2, 3))
    message("Int64List", field("value", 1, 3, 3))
    kinds = (("bytes_list", "BytesList"), ("float_list", "FloatList"), ("int64_list", "Int64List"))
    message("Feature", *(field(n, i, 11, type_name=f".t.{t}") for i, (n, t) in enumerate(kinds, 1)))
    features = message("Features", field("feature", 1, 11, 3, type_name=".t.Features.FeatureEntry"))
    entry = features.nested_type.add(name="FeatureEntry")
    entry.field.add(**field("key", 1, 9))
    entry.field.add(**field("value", 2, 11, type_name=".t.Feature"))
    entry.options.map_entry = True
    message("Example", field("features", 1, 11, type_name=".t.Features"))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Example"))


def read_tfrecords(path):
    data, offset = path.read_bytes(), 0
    while offset < len(data):
        [length] = struct.unpack_from("<Q", data, offset)
        for start, size in ((offset, 8), (offset + 12, length)):
            crc = google_crc32c.value(data[start : start + size])
            masked = (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF
            assert struct.unpack_from("<I", data, start + size) == (masked,)
        yield data[offset + 12 : offset + 12 + length]
        offset += 16 + length


def test_rlds_records_are_examples_of_the_features_that_the_folder_names(exported, episodes):
    [folder] = (path for path in exported("rlds").iterdir() if path.is_dir())
    info = json.loads((folder / "dataset_info.json").read_text())
    [split] = info["splits"]
    assert folder.name == info["version"] == "1.0.0" and split["shardLengths"] == ["2"]
    [path] = folder.glob(f"{info['name']}-train.tfrecord-00000-of-00001")
    examples = [example_class().FromString(data) for data in read_tfrecords(path)]
    assert len(examples) == 2
    values = examples[1].features.feature
    step = json.loads((folder / "features.json").read_text())["featuresDict"]["features"]["steps"]["sequence"][
        "feature"
    ]
    named = {f"steps/{name}" for name in step["featuresDict"]["features"] if name != "observation"}
    observation = step["featuresDict"]["features"]["observation"]["featuresDict"]["features"]
    named |= {f"steps/observation/{name}" for name in observation} | {"episode_index"}
    assert set(values) == named
    pictures = values["steps/observation/pixels"].bytes_list.value
    assert len(pictures) == 501
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(pictures[500]))), episodes[1]["pixels"][500])
    actions = np.array(values["steps/action"].float_list.value, np.float32).reshape(501, 6)
    np.testing.assert_array_equal(actions[:500], episodes[1]["action"])
    rewards = np.array(values["steps/reward"].float_list.value, np.float32)
    np.testing.assert_array_equal(rewards[:500], episodes[1]["reward"])
    heights = np.array(values["steps/observation/height"].float_list.value, np.float32)  # DMC-VB's own names
    np.testing.assert_array_equal(heights, episodes[1]["state"][:, 14])
    assert observation["height"]["tensor"]["shape"] == {} and observation["velocity"]["tensor"]["dtype"] == "float64"
    last = list(values["steps/is_last"].int64_list.value)
    assert last.index(1) == 500 and sum(last) == 1 and sum(values["steps/is_terminal"].int64_list.value) == 0


def test_the_command_exports_goes_on_and_never_writes_over(small_release, tmp_path):
    command = ["export", str(small_release), "--to", "npz", "--range", "2:3", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0 and len(list((tmp_path / NAME).glob("*.npz"))) == 1
    shutil.rmtree(tmp_path / NAME)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    result = CliRunner().invoke(main, command)  # as after a run that was stopped before the last subset
    assert result.exit_code == 0 and len(list((tmp_path / NAME).glob("*.npz"))) == 1 and kept
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in kept.items())
    command[command.index("2:3")] = "1:3"
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2 and "holds something else" in result.output
    assert not [path for path in tmp_path.rglob(".*") if path.name != STAMP]


def test_of_unfinished_releases_only_the_same_one_counts_as_exported(tmp_path):
    for name, seed in (("a", 3), ("b", 4)):
        release = roll_out(small_recipe(seed=seed), tmp_path / name, works=lambda works: works[:1])
        assert release.in_the_making
    for _ in range(2):  # the second time, everything is there
        export(tmp_path / "a", "npz", tmp_path / "x", [NAME], (0, 2))
    with pytest.raises(StoreError, match="holds something else"):
        export(tmp_path / "b", "npz", tmp_path / "x", [NAME], (0, 2))


def test_mistakes_are_answered(small_release, tmp_path, monkeypatch):
    with pytest.raises(UnknownNameError, match="lerobot"):
        export(small_release, "csv", tmp_path)
    with pytest.raises(DmcvbError, match="unknown format 'tfds'. Did you mean 'rlds'?"):
        export(small_release, "tfds", tmp_path)
    with pytest.raises(UnknownNameError, match="walker-walk/random/none"):
        export(small_release, "npz", tmp_path, ["cheetah-run"])
    with pytest.raises(StoreError, match="none of the episodes 50:60"):
        export(small_release, "npz", tmp_path, episode_range=(50, 60))

    with pytest.raises(StoreError, match="s3://bucket/x is a URL; give a local one"):
        export(small_release, "npz", "s3://bucket/x")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(DmcvbError, match="h5py.*: pip install h5py"):
        export(small_release, "hdf5", tmp_path)


@pytest.mark.slow
def test_workers_write_what_one_process_writes(small_release, small_mazes, tmp_path, monkeypatch):
    """To a relative folder, which minari takes for one of its own."""
    monkeypatch.chdir(tmp_path)
    for folder, name in ((small_release, "walker-walk/random"), (small_mazes, "*/hidden"), (small_mazes, "*/fixed")):
        export(str(folder), "npz", "one", [name])
        export(str(folder), "npz", "two", [name], workers=2)
    files = {path.relative_to("one"): path.read_bytes() for path in Path("one").rglob("*.npz")}
    assert len(files) == 13
    assert files == {path.relative_to("two"): path.read_bytes() for path in Path("two").rglob("*.npz")}
    [folder] = export(str(small_release), "minari", "here", [NAME])
    assert folder.is_absolute() and (folder / "data/metadata.json").is_file()
    assert folder == tmp_path / "here/dmcvb_gen/walker-walk/random-static-v0"


@pytest.mark.parametrize("release", ["small_release", "small_mazes"])
def test_nothing_that_is_damaged_or_missing_is_left_out_silently(release, request, tmp_path):
    source = request.getfixturevalue(release)
    folder, names = tmp_path / "release", list(dmcvb_gen.open(str(source)).subsets)
    shutil.copytree(source, folder)
    name, out = names[-1], tmp_path / "out"
    command = ["export", str(folder), "--to", "npz", "--out", str(out), "--only", name]
    shards = Release.open(folder).shards([name])
    shard = max((file for shard in shards for file in shard.files), key=lambda file: file.bytes).path
    whole = (folder / shard).read_bytes()
    (folder / shard).write_bytes(whole[:50] + bytes(255 - byte for byte in whole[50:90]) + whole[90:])
    for lost in (False, True):
        if lost:
            (folder / shard).unlink()
        result = CliRunner().invoke(main, command)
        assert result.exit_code == 2 and len(result.output.strip().splitlines()) <= 2, result.output
        assert not list(out.rglob("*.npz")) and not list(out.rglob("*.partial"))
    fetch(f"file:{source}", tmp_path / "part", [name], (0, 1))
    command[1] = str(tmp_path / "part")
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2 and f"{name} has" in result.output and "--only" in result.output
    result = CliRunner().invoke(main, [*command, "--range", "0:1"])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(main, [*command[:-1], names[0]])
    assert result.exit_code == 2 and "has no episode of it" in result.output
