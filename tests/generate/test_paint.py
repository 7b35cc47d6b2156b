"""Releases without images: made so, painted whole or in part, at another size, and compared with what is known."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.dataset.writer import finish_copy
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.paint import Wanted, paint_release
from dmcvb_gen.storage.store import open_store
from tests.conftest import invoke, maze_recipe, records, roll_out, small_recipe, wrong_files

SHORT = {"tasks": "walker-walk", "levels": "random", "episodes": 3, "episodes_per_shard": 2, "max_steps": 6}
RECIPES = {
    "walker": small_recipe(subsets=[SHORT | {"settings": ["none", "dynamic"]}]),
    "maze": maze_recipe(settings=("visible", "hidden"), max_steps=30),
}


@pytest.fixture(scope="module", params=RECIPES)
def made(request, tmp_path_factory):
    """A folder with a painted release, and the same made without images."""
    folder = tmp_path_factory.mktemp(request.param)
    roll_out(RECIPES[request.param], folder / "painted")
    roll_out(RECIPES[request.param], folder / "light", pixels=False)
    return folder


@pytest.fixture
def light(made, tmp_path):
    return shutil.copytree(made / "light", tmp_path / "light")


def copy_without_images(source, target):
    """What `fetch --no-pixels` leaves: all but the image layers' files and records, and copy.json."""
    release = Release.open(source)
    shutil.copytree(source, target)
    for name, layer in release.layers.items():
        if layer.kind == "images":
            shutil.rmtree(target / "records" / name)
            shutil.rmtree(target / layer.group / layer.arrays[0].stored_name)
    (target / "manifest.json").unlink()
    store, text = open_store(target), (source / "manifest.json").read_bytes()
    return finish_copy(store, text, "there", release.shards(images=False))


def test_painting_a_light_release_gives_the_records_of_a_painted_one(made, light):
    release = Release.open(light)
    assert not any(layer.kind == "images" for layer in release.layers.values()) and not release.shortfalls
    told = json.loads(invoke("paint", light, "--workers", 1, "--json").stdout)
    images = [layer for layer in Release.open(made / "painted").layers.values() if layer.kind == "images"]
    assert told["shards"] == 2 * len(images) and told["known"] == 0 and told["complete"]
    assert records(Release.open(light)) == records(Release.open(made / "painted"))
    assert "All local shards have images already" in invoke("paint", light).output


@pytest.mark.slow
def test_a_part_can_be_painted_and_the_rest_says_how(made, light):
    name = next(iter(Release.open(light)))
    done = paint_release(light, only=[name], episodes=(0, 1))
    subset, stored = Release.open(light)[name], Release.open(made / "painted")[name]
    array, here = stored.pixel_arrays[0], list(subset.trajectories.episodes_of(0))
    assert done.shards == len(stored.pixel_arrays)
    assert np.array_equal(subset.read(array, here), stored.read(array, here))
    last = int(subset.episodes[-1])
    with pytest.raises(StoreError, match="dmcvb-gen paint"):
        subset.read(array, [last])
    assert subset.unpainted.tolist() == [index not in here for index in range(len(subset))]
    assert invoke("preview", light, "--episodes", 1).exit_code == 0  # of what has images
    paint_release(light)
    assert records(Release.open(light)) == records(Release.open(made / "painted"))


def test_images_that_are_known_are_compared_and_others_are_named(made, tmp_path):
    copy = copy_without_images(made / "painted", tmp_path / "light")
    digest = copy.digest
    done = paint_release(tmp_path / "light")
    assert done.known == done.shards > 0 and not done.differing and done.release.digest == digest
    other = copy_without_images(made / "painted", tmp_path / "other").layers
    layer = next(layer for layer in other.values() if layer.kind == "images")
    [listed] = [path for path in (tmp_path / "other/layers").iterdir() if path.stem == layer.list]
    [file] = Release.open(tmp_path / "other").records(layer.name)[1].files.values()
    text = listed.read_text().replace(file.sha256, "0" * 64)
    _swap_list(tmp_path / "other", layer, text)
    result = invoke("paint", tmp_path / "other")
    assert result.exit_code == 1 and f"differs: {layer.name} shard 1" in result.output
    assert not (tmp_path / "other" / record_path(layer.name, 1)).exists()


def _swap_list(folder, layer, text):
    """Give a copy another list of a layer, as if it had been copied from a release made elsewhere."""
    import hashlib

    digest = hashlib.sha256(text.encode()).hexdigest()
    (folder / "layers" / f"{digest}.json").write_text(text)
    manifest = (folder / "manifest.json").read_text().replace(layer.list, digest)
    (folder / "manifest.json").write_text(manifest)
    copy = json.loads((folder / "copy.json").read_text())
    copy["manifest"] = hashlib.sha256(manifest.encode()).hexdigest()
    (folder / "copy.json").write_text(json.dumps(copy))


def test_a_copy_gains_images_of_another_size_and_keeps_its_digest(made, tmp_path):
    digest = copy_without_images(made / "painted", tmp_path / "copy").digest
    maze = "maze" in str(made)
    wanted = Wanted(24, ("top",), "hidden") if maze else Wanted(24)
    done = paint_release(tmp_path / "copy", wanted=wanted)
    name = next(iter(done.release))
    arrays = [array for array in done.release[name].arrays if array.startswith("at24/")]
    assert arrays == (["at24/pixels_hidden_goal/top"] if maze else ["at24/pixels"])
    assert done.release[name].read(arrays[0]).shape[2:] == (24, 24, 3)
    assert done.release.digest == digest and Release.open(tmp_path / "copy")[name].read(arrays[0]).any()
    assert not wrong_files(tmp_path / "copy")
