"""Releases without images: made so, painted whole or in part, at another size, and compared with what is known."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.paint import Wanted, paint_release
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from tests.conftest import invoke, records, rewrite, wrong_files


@pytest.fixture
def light(painted_and_light, tmp_path):
    return shutil.copytree(painted_and_light / "light", tmp_path / "light")


def test_painting_a_light_release_gives_the_records_of_a_painted_one(painted_and_light, light):
    release = Release.open(light)
    assert not any(layer.kind == "images" for layer in release.layers.values()) and not release.shortfalls
    told = json.loads(invoke("paint", light, "--workers", 1, "--json").stdout)
    images = [layer for layer in Release.open(painted_and_light / "painted").layers.values() if layer.kind == "images"]
    assert told["shards"] == 2 * len(images) and told["known"] == 0 and told["complete"]
    assert records(Release.open(light)) == records(Release.open(painted_and_light / "painted"))
    assert "All local shards have images already" in invoke("paint", light).output


@pytest.mark.slow
def test_a_part_can_be_painted_and_the_rest_says_how(painted_and_light, light):
    name = next(iter(Release.open(light)))
    done = paint_release(light, only=[name], episodes=(0, 1))
    subset, stored = Release.open(light)[name], Release.open(painted_and_light / "painted")[name]
    array, here = stored.pixel_arrays[0], list(subset.trajectories.episodes_of(0))
    assert done.shards == len(stored.pixel_arrays)
    assert np.array_equal(subset.read(array, here), stored.read(array, here))
    last = int(subset.episodes[-1])
    with pytest.raises(StoreError, match="dmcvb-gen paint"):
        subset.read(array, [last])
    assert subset.unpainted.tolist() == [index not in here for index in range(len(subset))]
    assert invoke("preview", light, "--episodes", 1).exit_code == 0  # of what has images
    paint_release(light)
    assert records(Release.open(light)) == records(Release.open(painted_and_light / "painted"))


def test_images_that_are_known_are_compared_and_others_are_named(painted_and_light, tmp_path, caplog):
    source = shutil.copytree(painted_and_light / "painted", tmp_path / "source")
    publish(source, f"file:{tmp_path}/light", pixels=False)
    digest = Release.open(source).digest
    done = paint_release(tmp_path / "light")
    assert done.known == done.shards > 0 and not done.differing and done.release.digest == digest
    chunk = next(path for path in (tmp_path / "light").rglob("pixels*/c/**/*") if path.is_file())
    chunk.write_bytes(bytes(chunk.stat().st_size))
    assert [shard.repaired for shard in Regeneration(tmp_path / "light").repair().shards] == [True]
    layer = next(layer for layer in Release.open(source).layers.values() if layer.kind == "images")
    array, name = layer.arrays[0].name, layer.name.rpartition("/")[0]
    rewrite(source, name, lambda arrays: arrays[array][2].fill(9))  # as if it had been made elsewhere
    publish(source, f"file:{tmp_path}/other", pixels=False)
    [note] = (tmp_path / "other/provenance").iterdir()
    note.write_text(note.read_text().replace('"mujoco":"', '"mujoco":"\\u0007'))
    said = invoke("paint", tmp_path / "other", code=1).output
    assert f"differs: {layer.name} shard 1" in said and "mujoco is" in caplog.text and "\x07" not in caplog.text
    assert not (tmp_path / "other" / record_path(layer.name, 1)).exists()


def test_a_part_is_painted_and_repaired_without_the_settings_that_share_its_trajectories(painted_and_light, tmp_path):
    other, name = Release.open(painted_and_light / "light")
    fetch(f"file:{painted_and_light / 'light'}", tmp_path / "part", [name])
    done = paint_release(tmp_path / "part")
    painted = Release.open(painted_and_light / "painted")[name]
    assert done.shards == 2 * len(painted.pixel_arrays)
    for layer in painted.layers:
        assert done.release.records(layer.name) == painted.release.records(layer.name)
    assert Regeneration(tmp_path / "part").check().sound and not Regeneration(tmp_path / "part").repair().shards
    with pytest.raises(StoreError, match=f"is a copy without {other}"):
        paint_release(tmp_path / "part", [other])


def test_a_copy_gains_images_of_another_size_and_keeps_its_digest(painted_and_light, tmp_path):
    publish(painted_and_light / "painted", f"file:{tmp_path}/copy", pixels=False)
    digest = Release.open(painted_and_light / "painted").digest
    maze = "ant-maze-tiny/random/hidden" in Release.open(painted_and_light / "light")
    wanted = Wanted(24, ("top",)) if maze else Wanted(24)
    done = paint_release(tmp_path / "copy", wanted=wanted)
    name = next(iter(done.release))
    arrays = [array for array in done.release[name].arrays if array.startswith("at24/")]
    assert arrays == (["at24/pixels/top", "at24/pixels_hidden_goal/top"] if maze else ["at24/pixels"])
    assert done.release[name].read(arrays[0]).shape[2:] == (24, 24, 3)
    assert done.release.digest == digest and Release.open(tmp_path / "copy")[name].read(arrays[0]).any()
    assert not wrong_files(tmp_path / "copy")
