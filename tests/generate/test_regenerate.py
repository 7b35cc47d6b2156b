"""Shards made again from the manifest alone: compared, put back, or made into a new release."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.repaint import Repainting, repaint
from tests.conftest import invoke, rewrite, roll_out, short_recipe
from tests.dataset.oracle import contents

NAME = "walker-walk/random/dynamic"
GROUP = "walker-walk/random.zarr"


@pytest.mark.slow_cases("small_mazes")
@pytest.mark.parametrize("release", ["small_release", "small_mazes"])
def test_a_check_writes_nothing_and_finds_every_bit_equal(release, request):
    folder = request.getfixturevalue(release)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    outcome = Regeneration(folder, workers=1).check()
    layers = Release.open(folder).layers
    assert outcome.sound and all(shard.equal and not shard.was for shard in outcome.shards) and not outcome.left
    assert len(outcome.shards) == sum(layer.shards for layer in layers.values())
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


DAMAGE = {
    "a bit": lambda path: path.write_bytes(path.read_bytes()[:-9] + b"\x01" + path.read_bytes()[-8:]),
    "its end": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "all of it": lambda path: path.unlink(),
}


FILES = {
    f"{NAME}/pixels": f"{GROUP}/dynamic/pixels/c/1/0/0/0/0",
    f"{NAME}/labels": f"{GROUP}/dynamic/exogenous/camera_position/c/0/0/0/0",
    "walker-walk/random/trajectories": f"{GROUP}/trajectories/physics/c/1/0/0",
}


@pytest.mark.parametrize("how", DAMAGE)
@pytest.mark.parametrize("layer", FILES)
def test_a_damaged_file_is_put_back_and_no_other_is_touched(copy, small_release, layer, how):
    path = FILES[layer]
    DAMAGE[how](copy / path)
    stamps = {other: other.stat().st_mtime_ns for other in copy.rglob("c/**/*") if other.is_file()}
    outcome = Regeneration(copy).repair()
    [shard] = outcome.shards
    assert outcome.sound and shard.repaired and shard.layer == layer and path in shard.was
    assert contents(copy) == contents(small_release)
    stamps.pop(copy / path, None)
    assert stamps.items() <= {other: other.stat().st_mtime_ns for other in copy.rglob("c/**/*")}.items()
    assert Regeneration(copy).repair().shards == ()


def test_lists_records_and_plain_metadata_are_put_back_and_recipes_are_named(copy, small_release):
    lost, altered = record_path(f"{NAME}/pixels", 1), record_path(f"{NAME}/labels", 0)
    (copy / lost).unlink()
    (copy / altered).write_text("{}")
    outcome = Regeneration(copy, [NAME]).repair()
    assert outcome.restored == (altered, lost) and not outcome.shards
    lost = next(iter((copy / "layers").iterdir()))
    lost.write_text("{}")
    shutil.rmtree(copy / GROUP / "dynamic/exogenous/style")
    (copy / GROUP / "zarr.json").write_text("{")
    outcome = Regeneration(copy).repair()
    assert outcome.sound and outcome.restored == (f"layers/{lost.name}",)
    assert contents(copy) == contents(small_release)
    next((copy / "recipes").iterdir()).write_text("{}")
    with pytest.raises(StoreError, match="recipes/.* was altered"):
        Regeneration(copy).repair()


def change_actions(folder):
    """Another machine's data: other values under digests of their own."""

    def change(arrays):
        arrays["action"][0] *= 0.5
        arrays["pixels"][0, :5] = np.minimum(arrays["pixels"][0, :5], 250) + 3

    rewrite(folder, NAME, change)
    [note] = (folder / "provenance").glob("*.json")
    facts = json.loads(note.read_text())
    facts["environment"]["cpu"] = "Another 9000"
    note.write_text(json.dumps(facts))


def test_a_difference_is_said_with_how_far_and_what_differs_in_the_environment(copy):
    change_actions(copy)
    said = invoke("regenerate", copy, "--only", NAME, "--range", "0:1", "--check", code=1).output
    assert "trajectories shard 0 (episodes 0:2): MISMATCH: digest differs; action: max" in said
    assert "pixels: max 3, mean" in said and "state: max" not in said
    assert "environment: cpu was Another 9000 and is" in said


def test_a_file_that_comes_out_otherwise_is_not_put_in(copy):
    change_actions(copy)
    (copy / GROUP / "dynamic/pixels/c/0/0/0/0/0").write_bytes(b"rubbish")
    before = contents(copy)
    outcome = Regeneration(copy).repair()
    assert not outcome.sound and [shard.repaired for shard in outcome.shards] == [False]
    assert contents(copy) == before


def test_beside_it_makes_an_equal_release_and_goes_on_in_what_has_grown(tmp_path):
    source = roll_out(short_recipe(), tmp_path / "source")
    part = Regeneration(source.path, ["*/*/none"], (0, 1)).remake(tmp_path / "beside")
    assert part.sound and {shard.layer.split("/")[-1] for shard in part.shards} == {"trajectories", "labels", "pixels"}
    assert Regeneration(source.path).remake(tmp_path / "beside").sound
    assert Release.open(tmp_path / "beside").digest == source.digest
    roll_out(short_recipe(episodes=5), tmp_path / "beside")
    assert Regeneration(source.path).remake(tmp_path / "beside").sound
    (tmp_path / "beside" / GROUP / "dynamic/pixels/c/0/0/0/0/0").write_bytes(b"rubbish")
    assert not Regeneration(source.path).remake(tmp_path / "beside").sound


def test_videos_and_policies_that_are_lost_are_put_back(tmp_path):
    for name, gray in {"train/0.png": 0, "train/1.png": 90, "val/0.png": 200}.items():
        (tmp_path / "videos" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((16, 16, 3), gray, np.uint8)).save(tmp_path / "videos" / name)
    one = dict(levels="expert", settings="static", episodes=1, max_steps=3)
    roll_out(short_recipe(**one, backgrounds=str(tmp_path / "videos")), tmp_path / "r")
    before = contents(tmp_path / "r")
    for name, message in {"train/00000.png": "are not those that", "val/00000.png": "run `dmcvb-gen reg"}.items():
        [frame] = (tmp_path / "r/backgrounds").glob(f"*/{name}")
        saved = frame.read_bytes()
        Image.fromarray(np.full((16, 16, 3), 77, np.uint8)).save(frame)
        with pytest.raises(StoreError, match=message):
            repaint(Repainting(tmp_path / "r", tmp_path / "painted", size=8))
        with pytest.raises(StoreError, match="png is not the one that the recipe names"):
            Regeneration(tmp_path / "r").remake(tmp_path / "beside")
        frame.write_bytes(saved)
    shutil.rmtree(tmp_path / "r/backgrounds")
    [policy] = (tmp_path / "r/policies").iterdir()
    policy.write_bytes(policy.read_bytes()[:20])
    command = ["regenerate", tmp_path / "r", "--backgrounds", tmp_path / "videos"]
    assert "restored 4 other files" in invoke(*command, code=0).output
    assert contents(tmp_path / "r") == before
    assert "no shard is damaged" in invoke(*command).output
