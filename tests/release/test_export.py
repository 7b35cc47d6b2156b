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
from dmcvb_gen.benchmarks.goals import GoalPairs, goal_pairs
from PIL import Image

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, StoreError, UnknownNameError
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.paint import paint_release
from dmcvb_gen.generate.plan import finish, make_plan, prepare
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.export import STAMP, export
from dmcvb_gen.release.import_tfds import import_tfds
from dmcvb_gen.release.statistics import level_statistics
from dmcvb_gen.release.tfrecord import encode_example, offsets, read_example, record
from dmcvb_gen.release.verify import verify
from dmcvb_gen.tasks import get_task
from tests.conftest import small_recipe

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


def test_minari_opens_its_dataset_and_the_environment(exported, episodes):
    minari = pytest.importorskip("minari")
    dataset = minari.MinariDataset(exported("minari") / "data")
    assert dataset.total_episodes == 2 and dataset.total_steps == 1000
    assert dataset.id == "dmcvb_gen/walker-walk/random-static-v0"
    for episode, ours in zip(dataset.iterate_episodes(), episodes, strict=False):
        np.testing.assert_array_equal(episode.observations["pixels"], ours["pixels"])
        np.testing.assert_array_equal(episode.observations["state"], ours["state"])
        np.testing.assert_array_equal(episode.actions, ours["action"])
        np.testing.assert_array_equal(episode.rewards, ours["reward"])
        assert episode.truncations[-1] and episode.truncations.sum() == 1 and not episode.terminations.any()
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space and env.action_space == dataset.action_space
    assert env.spec.id == "dmcvb_gen/walker-walk-static-v0"
    env.close()


def test_lerobot_tables_are_complete_and_its_pictures_lossless(exported, episodes):
    pq = pytest.importorskip("pyarrow.parquet")
    pandas = pytest.importorskip("pandas")
    folder = exported("lerobot")
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["total_frames"] == 1000 and info["fps"] == 20
    path = folder / info["data_path"].format(chunk_index=0, file_index=0)
    table = pq.read_table(path)
    assert set(table.column_names) == set(info["features"]) and table.num_rows == 1000
    row = table.slice(750, 1).to_pylist()[0]
    picture = np.asarray(Image.open(io.BytesIO(row["observation.image"]["bytes"])))
    np.testing.assert_array_equal(picture, episodes[1]["pixels"][250])
    np.testing.assert_array_equal(np.float32(row["action"]), episodes[1]["action"][250])
    assert (row["episode_index"], row["frame_index"], row["index"]) == (1, 250, 750)
    assert row["timestamp"] == pytest.approx(250 / 20)
    assert table["next.done"].to_pylist().index(True) == 499
    tasks = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.loc["walker-walk (random)"].task_index == 0
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(r["dataset_from_index"], r["dataset_to_index"]) for r in rows] == [(0, 500), (500, 1000)]
    statistics = json.loads((folder / "meta/stats.json").read_text())
    actions = np.concatenate([episodes[0]["action"], episodes[1]["action"]])
    np.testing.assert_allclose(statistics["action"]["std"], actions.std(axis=0), rtol=1e-4)
    assert np.shape(statistics["observation.image"]["mean"]) == (3, 1, 1)


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


@pytest.fixture(scope="module")
def imported(exported, tmp_path_factory):
    """A release imported from a folder in DMC-VB's layout: locomotion/<task>/<level>/<setting>."""
    root = tmp_path_factory.mktemp("dmc_vb")
    target = root / "locomotion/walker_walk/random/static_medium"
    target.parent.mkdir(parents=True)
    shutil.copytree(exported("rlds"), target)
    result = CliRunner().invoke(main, ["import", str(root / "locomotion"), "--out", str(root / "release")])
    assert result.exit_code == 0 and f"{NAME}: 2 episodes" in result.output
    return root / "release"


def test_dmc_vbs_folders_are_imported_whole(imported, episodes):
    release = dmcvb_gen.open(imported)
    assert list(release.subsets) == [NAME] and release.manifest.complete
    for index in range(2):
        found = release[NAME].episode(index)
        for name in ("pixels", "state", "action", "reward", "discount", "length", "terminated", "return"):
            np.testing.assert_array_equal(found[name], episodes[index][name])
    assert verify(imported).sound
    assert next(release[NAME].batches(16))["pixels"].shape == (16, 9, 16, 16)
    with pytest.raises(StoreError, match="was imported"):
        Regeneration(imported).check()
    with pytest.raises(StoreError, match="was imported"):
        repaint(Repainting(imported, imported.parent / "x", size=8))


def test_an_imported_release_keeps_its_pictures(imported, tmp_path):
    """Nobody could paint them again."""
    command = ["publish", str(imported), f"file:{tmp_path / 'there'}", "--no-pixels"]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2 and "publish it with them, without --no-pixels" in result.output
    assert len(result.output.strip().splitlines()) == 1 and not (tmp_path / "there").exists()
    assert not list(imported.parent.glob(".*-light*"))
    with pytest.raises(StoreError, match="was imported.*without paint"):
        dmcvb_gen.open(str(imported), paint=True)


@pytest.mark.parametrize("family", ["locomotion", "mazes"])
def test_an_imported_release_is_exported_to_lerobot(imported, dmcvb_mazes, tmp_path, family):
    folder = imported
    if family == "mazes":
        import_tfds(dmcvb_mazes, folder := tmp_path / "r")
    for out in export(str(folder), "lerobot", tmp_path / "out"):
        info = json.loads((out / "meta/info.json").read_text())
        assert info["fps"] == 20


def check_imported_card(folder):
    """Its card is written, fits, and claims nothing that it has not."""
    write_card(folder)
    assert check_card(folder) == []
    text, metadata = (folder / "README.md").read_text(), (folder / "croissant.json").read_text()
    assert "Imported by dmcvb-gen" in text and "those of the imported data" in text
    for claim in ("regenerate", "full physics states", "`exogenous/`", "`physics`", "None samples", "seed None"):
        assert claim not in text, claim
    assert "exogenous/style" not in text
    assert "can be made again from them" not in metadata and "roll out" not in metadata
    return level_statistics(Release.open(folder))


def test_the_card_of_imported_locomotion(imported, small_release, tmp_path):
    shutil.copytree(imported, tmp_path / "r")
    [found], [made] = check_imported_card(tmp_path / "r"), level_statistics(Release.open(small_release))
    assert found.speed == pytest.approx(made.speed, rel=0.2) and found.height == pytest.approx(made.height, rel=0.1)


def test_the_card_of_imported_mazes(dmcvb_mazes, small_mazes, tmp_path):
    import_tfds(dmcvb_mazes, tmp_path / "r")
    [found], ours = check_imported_card(tmp_path / "r"), Release.open(small_mazes)["ant-maze-tiny/random/fixed"]
    place = get_task(ours.task).state_slices["walker_position"]
    walked = [np.diff(ours.episode(int(e))["state"][:, place][:, :2], axis=0) for e in ours.episodes]
    assert found.speed == pytest.approx(np.linalg.norm(np.concatenate(walked), axis=1).mean() / 0.05)


def test_damaged_or_foreign_folders_are_not_imported(exported, tmp_path):
    with pytest.raises(StoreError, match="no features.json"):
        import_tfds(tmp_path, tmp_path / "r")
    shutil.copytree(exported("rlds"), tmp_path / "somewhere")
    with pytest.raises(StoreError, match="--task"):
        import_tfds(tmp_path / "somewhere", tmp_path / "r")
    [path] = (tmp_path / "somewhere").rglob("*.tfrecord-*")
    data = path.read_bytes()
    what = dict(task="walker-walk", level="random", setting="static")
    for damaged in (data[:-100], data[:5000] + b"x" + data[5001:], b"not records at all"):
        path.write_bytes(damaged)
        with pytest.raises(StoreError, match="damaged"):
            import_tfds(tmp_path / "somewhere", tmp_path / "r", **what)


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
    assert result.exit_code == 2 and "is there already" in result.output
    assert not [path for path in tmp_path.rglob(".*") if path.name != STAMP]


def test_of_unfinished_releases_only_the_same_one_counts_as_exported(tmp_path):
    for name, seed in (("a", 3), ("b", 4)):
        plan = prepare(make_plan(small_recipe(seed=seed), tmp_path / name, ()))
        for _ in run_jobs(plan.jobs[:1], 1):
            pass
        assert Release.open(tmp_path / name).manifest.digest is None
    subset = next(iter(Release.open(tmp_path / "a").subsets))
    for _ in range(2):  # the second time, everything is there
        export(tmp_path / "a", "npz", tmp_path / "x", [subset], (0, 2))
    with pytest.raises(StoreError, match="not of this release and these options"):
        export(tmp_path / "b", "npz", tmp_path / "x", [subset], (0, 2))


def test_mistakes_are_answered(small_release, tmp_path, monkeypatch):
    with pytest.raises(UnknownNameError, match="lerobot"):
        export(small_release, "csv", tmp_path)
    with pytest.raises(UnknownNameError, match="walker-walk/random/none"):
        export(small_release, "npz", tmp_path, ["cheetah-run"])
    with pytest.raises(StoreError, match="none of the episodes 50:60"):
        export(small_release, "npz", tmp_path, episodes=(50, 60))

    with pytest.raises(DmcvbError, match="--video is not for hdf5"):
        export(small_release, "hdf5", tmp_path, video=True)
    with pytest.raises(StoreError, match="s3://bucket/x is a URL; give a local one"):
        export(small_release, "npz", "s3://bucket/x")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(DmcvbError, match="h5py.*: pip install h5py"):
        export(small_release, "hdf5", tmp_path)


def test_workers_write_what_one_process_writes(small_release, small_mazes, tmp_path, monkeypatch):
    """To a relative folder, which minari takes for one of its own."""
    monkeypatch.chdir(tmp_path)
    told = []
    for folder, name in ((small_release, "walker-walk/random"), (small_mazes, "*/hidden"), (small_mazes, "*/fixed")):
        export(str(folder), "npz", "one", [name])
        export(str(folder), "npz", "two", [name], workers=2, tick=told.append)
    assert sum(told) == 9 + 2 + 2
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
    name = names[1]
    command = ["export", str(folder), "--to", "npz", "--out", str(tmp_path / "out")]

    shard = max((folder / f"{name}.zarr").rglob("c/0/*/*/*/0"), key=lambda path: path.stat().st_size)
    whole = shard.read_bytes()
    shard.write_bytes(whole[:50] + bytes(255 - byte for byte in whole[50:90]) + whole[90:])
    result = CliRunner().invoke(main, [*command, "--only", name])
    assert result.exit_code == 2 and name in result.output and len(result.output.strip().splitlines()) <= 2
    assert not list((tmp_path / "out").rglob("*.npz")) and not list((tmp_path / "out").rglob("*.partial"))
    shard.write_bytes(whole)

    record = sorted((folder / "commits" / name).glob("*.json"))[-1]
    record.unlink()
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2 and f"{name} has" in result.output and "--episodes" in result.output
    assert not list((tmp_path / "out").rglob("*.npz"))
    result = CliRunner().invoke(main, [*command, "--only", name, "--range", "0:1"])
    assert result.exit_code == 0, result.output

    shutil.rmtree(folder / "commits" / name)
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2 and f"{name} has 0 of" in result.output


@pytest.fixture(scope="module")
def dmcvb_mazes(small_mazes, tmp_path_factory):
    """Maze folders as DMC-VB has them: 165 numbers (no height, no activation), fixed goals a folder a seed."""
    root = tmp_path_factory.mktemp("dmc_vb_mazes")
    left_out = ("steps/observation/walker/body_height", "steps/observation/target_activated")
    for setting in ("visible", "hidden", "fixed"):
        for episodes in ((0, 1), (1, 2)) if setting == "fixed" else ((0, 2),):
            out = root / f"made_{setting}_{episodes[0]}"
            [made] = export(str(small_mazes), "rlds", out, [f"*/{setting}"], episodes)
            for file in made.rglob("*.tfrecord*"):
                examples = [read_example(file, *place) for place in offsets(file)]
                thinned = [{k: v for k, v in example.items() if k not in left_out} for example in examples]
                assert all(len(t) == len(e) - 2 for t, e in zip(thinned, examples, strict=True))
                file.write_bytes(b"".join(record(encode_example(example)) for example in thinned))
            place = f"antmaze_random_{setting}_goal/empty7x7/expert"
            place = f"antmaze_fixed_hidden_goal/empty7x7/{episodes[0]}" if setting == "fixed" else place
            (root / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(made, root / place)
            shutil.rmtree(out)
    return root


def test_dmc_vbs_mazes_are_imported_by_the_names_of_their_fields(dmcvb_mazes, small_mazes, tmp_path):
    import_tfds(dmcvb_mazes, tmp_path / "r")
    release, ours = dmcvb_gen.open(str(tmp_path / "r")), Release.open(small_mazes)
    assert len(release.subsets) == 3 and release.manifest.complete
    for setting in ("visible", "hidden", "fixed"):
        subset, made = release[f"ant-maze-empty7x7/expert/{setting}"], ours[f"ant-maze-tiny/random/{setting}"]
        assert subset.record.hidden_goal == (setting != "visible") and subset.record.views == made.record.views
        assert subset.record.fixed_goals == (2 if setting == "fixed" else None)
        root = "pixels" if setting == "visible" else "pixels_hidden_goal"
        assert set(subset.pixel_arrays) == {f"{root}/{view}" for view in made.record.views}
        for index in range(2):
            found, expected = subset.episode(index), made.episode(index)
            for name in (*subset.pixel_arrays, "state", "action", "reward", "discount", "terminated", "goal_pair"):
                np.testing.assert_array_equal(found[name], expected[name])
        batch = next(subset.batches(8, pictures=["top"]))
        assert batch["pixels"].shape == (8, 9, 16, 16) and batch["state"].shape == (8, 167)
    result = verify(tmp_path / "r")
    assert result.sound, result.findings


def split_files(folder, count):
    """The one TFRecord file of a folder as `count` files, an episode or none each; gives their paths."""
    [whole] = folder.rglob("*.tfrecord-*")
    data = [record(encode_example(read_example(whole, *place))) for place in offsets(whole)]
    stem = whole.name.rsplit("-", 3)[0]
    whole.unlink()
    files = [whole.with_name(f"{stem}-{number:05d}-of-{count:05d}") for number in range(count)]
    for number, file in enumerate(files):
        file.write_bytes(data[number] if number < len(data) else b"")
    return files


@pytest.mark.parametrize("family", ["locomotion", "mazes"])
def test_folders_that_lack_files_are_imported_only_when_asked(exported, dmcvb_mazes, tmp_path, family, monkeypatch):
    shards = {"locomotion": 1, "ant-maze": 1}  # else a release of one episode does not grow
    monkeypatch.setattr("dmcvb_gen.release.import_tfds.DEFAULT_EPISODES_PER_SHARD", shards)
    mazes = family == "mazes"
    place = "antmaze_random_visible_goal/empty7x7/expert" if mazes else "locomotion/walker_walk/random/static_medium"
    shutil.copytree(dmcvb_mazes / place if mazes else exported("rlds"), tmp_path / place)
    files = split_files(tmp_path / place, 3)
    for missing, out in ((files[0], "without_first"), (files[1], "without_second")):
        hidden = missing.rename(tmp_path / "away")
        number = files.index(missing)
        command = ["import", str(tmp_path / place.split("/")[0]), "--out", str(tmp_path / out)]
        refused = CliRunner().invoke(main, command)
        assert refused.exit_code == 2 and f"2 of 3 files (number {number} is missing)" in refused.output
        assert not (tmp_path / out).exists()
        assert CliRunner().invoke(main, [*command, "--partial"]).exit_code == 0
        again = CliRunner().invoke(main, [*command, "--partial"])
        assert again.exit_code == 0 and "1 episode" in again.output
        hidden.rename(missing)
        before = (tmp_path / out / "manifest.json").read_bytes()
        other = CliRunner().invoke(main, command)
        assert other.exit_code == 2 and "choose another --out" in other.output and "2 other files" in other.output
        assert (tmp_path / out / "manifest.json").read_bytes() == before
    away = [file.rename(tmp_path / file.name) for file in files[1:]]
    command = ["import", str(tmp_path / place.split("/")[0]), "--out", str(tmp_path / "grown")]
    assert CliRunner().invoke(main, [*command, "--partial"]).exit_code == 0
    for file, path in zip(away, files[1:], strict=True):
        file.rename(path)
    grown = CliRunner().invoke(main, command)
    assert grown.exit_code == 0 and "2 episodes" in grown.output, grown.output
    import_tfds(tmp_path / place.split("/")[0], tmp_path / "whole")
    [grown], [whole] = (dmcvb_gen.open(tmp_path / name).subsets.values() for name in ("grown", "whole"))
    for index in range(2):
        for name, value in whole.episode(index).items():
            np.testing.assert_array_equal(grown.episode(index)[name], value)
    assert verify(tmp_path / "grown").sound


@pytest.mark.parametrize("family", ["locomotion", "mazes"])
def test_an_import_has_the_time_limit_of_its_episodes(family, tmp_path):
    if family == "mazes":
        task, setting, place = "ant-maze-empty7x7", "--goal=hidden", "antmaze_random_hidden_goal/empty7x7/random"
    else:
        task, setting, place = "cheetah-run", "--distractor=static", "locomotion/cheetah_run/random/static_medium"
    made = ["rollout", task, "--level=random", setting, "--episodes=2", "--max-steps=7", "--size=16"]
    assert CliRunner().invoke(main, [*made, f"--out={tmp_path / 'made'}"]).exit_code == 0
    [folder] = export(str(tmp_path / "made"), "rlds", tmp_path / "out")
    (tmp_path / place).parent.mkdir(parents=True)
    shutil.move(folder, tmp_path / place)
    import_tfds(tmp_path / place.split("/")[0], tmp_path / "r")
    assert [record.max_steps for record in Release.open(tmp_path / "r").manifest.subsets] == [7]
    result = verify(tmp_path / "r")
    assert result.sound, result.findings


def test_fixed_goals_of_unequal_numbers_of_episodes_are_all_found(dmcvb_mazes, small_mazes, tmp_path):
    place = "antmaze_fixed_hidden_goal"
    shutil.copytree(dmcvb_mazes / place, tmp_path / place)
    first, _ = sorted((tmp_path / place).rglob("*.tfrecord-*"))
    first.write_bytes(first.read_bytes() * 3)
    import_tfds(tmp_path / place, tmp_path / "r")
    [subset] = dmcvb_gen.open(tmp_path / "r").subsets.values()
    assert subset.read("goal_pair").tolist() == [0, 0, 0, 1]
    assert goal_pairs(subset) == GoalPairs((0, 1))
    made = Release.open(small_mazes)["ant-maze-tiny/random/fixed"]
    for pair in (0, 1):
        target = get_task(made.task).state_slices["target_position"]
        row = int(np.flatnonzero(subset.read("goal_pair") == pair)[0])
        np.testing.assert_array_equal(subset.episode(row)["state"][0, target], made.episode(pair)["state"][0, target])


def test_folders_that_do_not_say_what_they_are_are_refused(dmcvb_mazes, tmp_path):
    shutil.copytree(dmcvb_mazes / "antmaze_random_hidden_goal/empty7x7/expert", tmp_path / "x")
    with pytest.raises(StoreError, match="antmaze_fixed_hidden_goal/empty7x7/<seed>"):
        import_tfds(tmp_path / "x", tmp_path / "r")
    what = dict(task="ant-maze-empty7x7", level="expert")
    with pytest.raises(StoreError, match="no image observation/lowres_top_camera;"):
        import_tfds(tmp_path / "x", tmp_path / "r", **what, setting="visible")
    import_tfds(tmp_path / "x", tmp_path / "r", **what, setting="hidden")


def test_a_feature_that_is_none_is_refused_in_one_line(tmp_path):
    steps = {"featuresDict": {"features": {"reward": [1, 2]}}}
    tree = {"featuresDict": {"features": {"steps": {"sequence": {"feature": steps}}}}}
    (tmp_path / "features.json").write_text(json.dumps(tree))
    with pytest.raises(StoreError, match="features.json does not describe RLDS steps"):
        import_tfds(tmp_path, tmp_path / "out", task="walker-walk", level="expert", setting="none")


def test_fixed_goals_exported_to_rlds_keep_their_pairs(small_mazes, tmp_path):
    [made] = export(str(small_mazes), "rlds", tmp_path / "out", ["*/fixed"])
    import_tfds(made, tmp_path / "r", task="ant-maze-empty7x7", level="random", setting="fixed")
    [subset] = dmcvb_gen.open(tmp_path / "r").subsets.values()
    assert subset.read("goal_pair").tolist() == [0, 1]
    assert (subset.record.fixed_goals, subset.record.episodes_per_goal) == (2, 1)


def test_the_time_limit_is_that_of_a_late_episode_if_the_first_ones_reach_the_goal(dmcvb_mazes, tmp_path):
    place = "antmaze_random_visible_goal/empty7x7/expert"
    shutil.copytree(dmcvb_mazes / place, tmp_path / place)
    [file] = (tmp_path / place).rglob("*.tfrecord-*")
    example = read_example(file, *next(iter(offsets(file))))
    steps = {name: value for name, value in example.items() if name.startswith("steps/")}
    count = len(steps["steps/reward"])
    short = {name: value[: len(value) * 3 // count] for name, value in steps.items()}  # two transitions
    short |= {"steps/is_terminal": np.array([0, 0, 1])}
    cut = {name: value[: len(value) * 5 // count] for name, value in steps.items()}
    cut |= {"steps/is_terminal": np.zeros(5, int)}
    few = record(encode_example(short)), record(encode_example(cut))
    file.write_bytes(few[0] * 25 + few[1])
    import_tfds(tmp_path / place.split("/")[0], tmp_path / "r")
    [subset] = Release.open(tmp_path / "r").subsets.values()
    assert subset.record.max_steps == 4 and subset.read("length").tolist() == [2] * 25 + [4]


def test_what_an_imported_release_grew_by_can_be_painted_and_made_again(imported, tmp_path):
    shutil.copytree(imported, tmp_path / "r")
    more = {"tasks": "cheetah-run", "levels": "random", "settings": "none", "episodes": 1, "max_steps": 3}
    plan = prepare(make_plan(small_recipe(subsets=[more]), tmp_path / "r", pixels=False))
    for _ in run_jobs(plan.jobs):
        pass
    finish(plan)
    assert paint_release(tmp_path / "r").shards == 1
    assert Regeneration(tmp_path / "r", ["cheetah-run"]).check().sound
    request = Repainting(tmp_path / "r", tmp_path / "again", size=20)
    assert [subset.name for subset in repaint(request).subsets] == ["cheetah-run/random/none"]
    with pytest.raises(StoreError, match="was imported.*--only"):
        Regeneration(tmp_path / "r").check()
