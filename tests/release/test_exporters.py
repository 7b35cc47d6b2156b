"""What every export format must do, for a locomotion task and a maze; formats of other packages are found."""

from __future__ import annotations

import importlib.metadata
import io
import json
import shutil
import subprocess
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from click.testing import CliRunner
from PIL import Image

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.release.export import STAMP, export, registry
from dmcvb_gen.release.export.publishing import export_format
from dmcvb_gen.release.export.registry import all_formats, get_format, register_exporter
from dmcvb_gen.release.tfrecord import offsets, read_example

SUBSETS = {"small_release": "walker-walk/random/static", "small_mazes": "ant-maze-tiny/random/hidden"}


VIEWS = ("top", "egocentric", "follow", "overhead")
"""Of mazes, in the order in which policies see them (SPEC, section 3)."""


def in_order(names):
    """Names of images in the order of their views; the one name of a task with one view."""
    names = list(names)
    ordered = [name for view in VIEWS for name in names if view in name]
    return ordered or names


def stacked(images):
    """Images of each view as the channels of one array; decoded if they are files."""
    views = [[np.asarray(Image.open(io.BytesIO(i))) if isinstance(i, bytes) else i for i in view] for view in images]
    return np.concatenate([np.stack(view) for view in views], axis=-1)


# -- readers: what the program that a format is for finds of episode 0: actions, rewards, images of all views --


def read_hdf5(folder):
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "data_000.hdf5") as file:
        return file["action"][1:], file["reward"][1:], file["observation"][:].transpose(0, 2, 3, 1)


def read_npz(folder):
    [path] = folder.glob("*.npz")
    with np.load(path) as data:
        return data["action"][1:], data["reward"][1:], data["image"]


def read_zarr(folder):
    data = zarr.open_group(str(folder / "data.zarr"), mode="r")
    [length] = data["length"][:]
    names = [name for name in data if "hidden_goal" in name] or [name for name in data if name.startswith("pixels")]
    images = stacked(data[name][0, : length + 1] for name in in_order(names))
    return data["action"][0, :length], data["reward"][0, :length], images


def read_replay_buffer(folder):
    data = zarr.open_group(str(folder / "replay_buffer.zarr"), mode="r")["data"]
    images = stacked(data[name][:] for name in in_order(name for name in data if name.startswith("img")))
    return data["action"][:], data["reward"][:], images


def read_minari(folder):
    minari = pytest.importorskip("minari")
    [episode] = minari.MinariDataset(folder / "data").iterate_episodes()
    return episode.actions, episode.rewards, episode.observations["pixels"]


def read_lerobot(folder):
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
    names = in_order(name for name in rows if name.startswith("observation.image"))
    return rows["action"], rows["next.reward"], stacked([file["bytes"] for file in rows[name]] for name in names)


def read_rlds(folder):
    [path] = folder.rglob("*.tfrecord-*")
    [place] = offsets(path)
    example = read_example(path, *place)
    rows = len(example["steps/reward"])
    names = in_order(name for name in example if name.endswith("/pixels") or "camera" in name)
    actions = np.reshape(example["steps/action"], (rows, -1))[:-1]
    return actions, example["steps/reward"][:-1], stacked(example[name] for name in names)


def read_rerun(folder):
    chunk = pytest.importorskip("rerun.chunk")
    found = {}
    for part in chunk.RrdReader(folder / "episode_000000.rrd").stream().to_chunks():
        batch = part.to_record_batch()
        for name in ("Scalars:scalars", "EncodedImage:blob"):
            if name in batch.schema.names:
                order = np.argsort(batch.column("step").to_pylist())
                rows = batch.column(name).to_pylist()
                found.setdefault(part.entity_path.lstrip("/"), []).extend(rows[i] for i in order)
    names = in_order(name for name in found if name.startswith("image"))
    return found["action"], np.ravel(found["reward"]), stacked([bytes(b[0]) for b in found[name]] for name in names)


READERS = {
    "hdf5": read_hdf5,
    "npz": read_npz,
    "replay-buffer": read_replay_buffer,
    "zarr": read_zarr,
    "minari": read_minari,
    "lerobot": read_lerobot,
    "rlds": read_rlds,
    "rerun": read_rerun,
}


@pytest.mark.parametrize("release", SUBSETS)
@pytest.mark.parametrize("to", READERS)
class ExporterTests:
    """The contract: a format's file says which it is, holds the values, is not written twice, and names no folder."""

    @pytest.fixture
    def source(self, release, to, request):
        for module in get_format(to).modules:
            pytest.importorskip(module)
        return request.getfixturevalue(release)

    def test_a_reader_finds_the_stored_values(self, source, release, to, tmp_path):
        name = SUBSETS[release]
        [folder] = export(str(source), to, tmp_path, [name], (0, 1))
        assert export_format(folder) == to
        subset = dmcvb_gen.open(str(source))[name]
        views = ["pixels"] if name.startswith("walker") else [f"pixels_hidden_goal/{view}" for view in VIEWS]
        stored = subset.episode(0, ["action", "reward", *views])
        actions, rewards, images = READERS[to](folder)
        np.testing.assert_array_equal(np.asarray(actions, np.float32), stored["action"])
        np.testing.assert_array_equal(np.asarray(rewards, np.float32), stored["reward"])
        np.testing.assert_array_equal(images, stacked(stored[view][: len(images)] for view in views))
        assert len(images) >= len(stored["reward"])

    def test_the_same_command_again_writes_nothing(self, source, release, to, tmp_path):
        again = [export(str(source), to, tmp_path, [SUBSETS[release]], (0, 1)) for _ in range(2)]
        assert again[0] == again[1]
        with pytest.raises(DmcvbError, match="holds something else"):
            export(str(source), to, tmp_path, [SUBSETS[release]], (1, 2))

    def test_no_file_names_a_folder_of_this_machine(self, source, release, to, tmp_path):
        [folder] = export(str(source), to, tmp_path / "out", [SUBSETS[release]], (0, 1))
        for path in folder.rglob("*"):
            if path.is_file():
                content = path.read_bytes()
                for place in (tmp_path, source, source.parent):
                    assert str(place).encode() not in content, path
        assert json.loads((folder / STAMP).read_text())["format"] == to


class TestExporters(ExporterTests):
    """The formats of this package."""


@pytest.mark.parametrize("release", SUBSETS)
def test_a_zarr_group_has_all_arrays_of_a_subset_for_zarr_and_xarray(release, request, tmp_path):
    subset = dmcvb_gen.open(request.getfixturevalue(release))[SUBSETS[release]]
    [folder] = export(request.getfixturevalue(release), "zarr", tmp_path, [subset.name], (1, 2))
    with warnings.catch_warnings(action="error"):
        group, data = (
            zarr.open_group(str(folder / "data.zarr"), mode="r"),
            xarray.open_zarr(folder / "data.zarr").load(),
        )
    names = {name: name.replace("/", "_") for name in subset.arrays}
    assert {*group} == {*data.variables} == {*names.values(), "episode"}
    assert data["episode"].values.tolist() == [1] and data["length"].dims == ("episode",)
    for name, flat in names.items():
        stored = subset.read(name, [1])
        np.testing.assert_array_equal(group[flat][:], stored)
        np.testing.assert_array_equal(data[flat].values, stored)
        assert data[flat].dims == subset.array(name).dimensions and data[flat].dtype == stored.dtype
    assert data.attrs["task"] == subset.task
    assert (
        data["action"].attrs["names"][-1]
        == {"walker": "left_ankle", "ant": "walker/back_left_ankle"}[subset.task.split("-")[0]]
    )
    assert len(data["state"].attrs["names"]) == data["state"].shape[-1] and data.attrs["joints"]


@pytest.mark.parametrize("whole", ["small_release", "maze_release"])
def test_an_export_into_the_release_itself_is_refused(whole, request, tmp_path):
    folder = shutil.copytree(request.getfixturevalue(whole), tmp_path / "r")
    before = sorted(folder.rglob("*"))
    for out in (folder, folder / "exports"):
        with pytest.raises(StoreError, match="lies in the release itself; give another folder"):
            export(str(folder), "npz", out)
    assert sorted(folder.rglob("*")) == before


def test_every_format_of_this_package_has_a_reader_and_its_line_in_the_docs():
    here = {name: kind for name, kind in all_formats().items() if kind.write.__module__.startswith("dmcvb_gen.")}
    assert sorted(here) == sorted(READERS)
    page = (Path(__file__).parents[2] / "docs/exports.md").read_text()
    for name, kind in here.items():
        needs = ", ".join(f"`{module}`" for module in kind.modules)
        assert f"| `{name}` | {kind.reader} | {kind.keeps} | {kind.drops} | {needs} |\n" in page


def test_a_format_of_another_package_is_found_by_its_entry_point(small_release, maze_release, tmp_path, monkeypatch):
    module = types.ModuleType("their_exporter")
    monkeypatch.setitem(sys.modules, "their_exporter", module)

    def register():
        @register_exporter("returns", reader="anybody", keeps="returns", drops="all else", mark="returns.txt")
        def write(source, folder):
            returns = [str(float(episode.reward.astype(np.float64).sum())) for episode in source]
            (folder / "returns.txt").write_text("\n".join(returns))

    class Entry(importlib.metadata.EntryPoint):
        def load(self):
            if self.name == "broken":
                raise ImportError("something is missing")
            register()

    formats = registry.FORMATS
    entries = [Entry(name, "their_exporter", formats.group) for name in ("broken", "returns")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries if group == formats.group else [])
    monkeypatch.setattr(formats, "_things", dict(all_formats()))
    monkeypatch.setattr(formats, "_loaded", False)
    for release in (small_release, maze_release):
        command = ["export", str(release), "--to", "returns", "--out", str(tmp_path / release.parent.name)]
        result = CliRunner().invoke(main, command)
        assert result.exit_code == 0, result.output
        for subset in dmcvb_gen.open(str(release)).subsets.values():
            text = (tmp_path / release.parent.name / subset.name / "returns.txt").read_text()
            np.testing.assert_allclose([float(line) for line in text.split()], subset.returns, rtol=1e-6)
    with pytest.raises(DmcvbError, match="two formats are called npz"):
        register_exporter("npz", reader="", keeps="", drops="", mark="")(lambda source, folder: None)


def test_the_command_names_folders_as_out_names_them(small_release, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["export", str(small_release), "--to", "npz", "--only", "*/none", "--range", "0:1", "--out"]
    assert CliRunner().invoke(main, [*command, "here"]).output.splitlines()[-1] == "here/walker-walk/random/none"
    there = str(tmp_path / "there")
    assert CliRunner().invoke(main, [*command, there]).output.splitlines()[-1] == f"{there}/walker-walk/random/none"


def test_exporting_hdf5_needs_no_simulator(small_release, tmp_path):
    pytest.importorskip("h5py")
    code = (
        "import sys;"
        "sys.modules.update(dict.fromkeys(('mujoco', 'dm_control', 'numba', 'torch')));"
        "from dmcvb_gen.release.export import export;"
        f"print(export({str(small_release)!r}, 'hdf5', {str(tmp_path)!r}, ['*/none'], (0, 1)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and "walker-walk/random/none" in done.stdout, done.stderr[-1500:]
