"""Repainting: new pixels from stored physics, equal to what a rollout would have painted; nothing is simulated."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.generate.modalities import stored_in
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.verify import verify
from dmcvb_gen.rendering import available_renderers
from dmcvb_gen.tasks import get_task
from tests.conftest import records, rewrite, roll_out, short_recipe
from tests.distractors.test_backgrounds import write_frames


@pytest.fixture
def no_simulation(monkeypatch):
    monkeypatch.setattr("dmcvb_gen.generate.engine.simulate", lambda *_, **__: pytest.fail("repainting simulated"))


@pytest.fixture(scope="module")
def dynamic(small_release, tmp_path_factory):
    out = tmp_path_factory.mktemp("repainted") / "r"
    repaint(Repainting(small_release, out, ["*/*/none"], distractor="dynamic"), 1)
    return out


NAME = "walker-walk/random/dynamic"


def test_a_subset_without_videos_is_repainted_with_those_of_the_others(tmp_path):
    for split in ("train", "val"):
        write_frames(tmp_path / "videos" / split / "a", [np.full((16, 16, 3), 90, np.uint8)] * 3, "png")
    roll_out(short_recipe(backgrounds=str(tmp_path / "videos")), tmp_path / "r")
    repaint(Repainting(tmp_path / "r", tmp_path / "new", ["*/*/none"], distractor="static"), 1)
    [new], old = Release.open(tmp_path / "new").manifest.subsets, Release.open(tmp_path / "r")[NAME].record
    assert new.backgrounds == old.backgrounds and new.backgrounds["source"] != "builtin"


def test_a_repainted_subset_has_the_records_of_a_rolled_out_one(small_release, dynamic):
    ours, theirs = Release.open(dynamic), Release.open(small_release)
    assert records(ours) == {name: theirs.records(name) for name in theirs[NAME].record.layers}


def test_a_repainted_release_is_sound_names_its_source_and_can_be_regenerated(dynamic, small_release):
    assert verify(dynamic).sound and Regeneration(dynamic, episodes=(2, 3)).check().sound
    release = Release.open(dynamic)
    [recipe] = release.recipes
    source = Release.open(small_release)
    assert recipe.derived == {"kind": "repaint", "name": "small", "version": "1.0.0", "digest": source.digest}
    assert release.manifest.name == "small-repainted" and not release.shortfalls


def test_a_part_is_repainted_as_the_part_that_it_is(small_release, tmp_path, no_simulation):
    fetch(f"file:{small_release}", tmp_path / "part", ["*/static"])
    release = repaint(Repainting(tmp_path / "part", tmp_path / "r", size=8))
    assert list(release) == ["walker-walk/random/static"] and not release.unfinished


def test_another_size_keeps_everything_but_the_pixels(small_release, tmp_path, no_simulation):
    repaint(Repainting(small_release, tmp_path / "r", ["*/*/static"], size=24, labels=["depth", "segmentation"]))
    old, new = (Release.open(folder)["walker-walk/random/static"] for folder in (small_release, tmp_path / "r"))
    assert new.read("pixels").shape == (3, 501, 24, 24, 3)
    for name in set(old.arrays) - {"pixels"}:
        np.testing.assert_array_equal(old.read(name), new.read(name))
    depth, geoms = new.read("depth", [0])[0], new.read("segmentation", [0])[0]
    assert depth.shape == geoms.shape == (501, 24, 24) and depth.dtype == np.float32
    assert depth.max() > 1 and ((geoms >= 0) == (depth > 0)).mean() > 0.99 and len(np.unique(geoms)) > 3
    assert verify(tmp_path / "r").sound


@pytest.mark.slow
@pytest.mark.parametrize("source, name", [("small_release", NAME), ("small_mazes", "ant-maze-tiny/random/hidden")])
def test_wrong_labels_are_found(request, source, name, tmp_path):
    """The digests are right; only the states can give such labels away."""
    labels = ["depth", "segmentation", "parts", "flow"]
    repaint(Repainting(request.getfixturevalue(source), tmp_path / "r", [name], size=16, labels=labels))
    assert verify(tmp_path / "r").sound
    arrays = [array for array in stored_in(Release.open(tmp_path / "r")[name].arrays) if not array.endswith("/top")]

    def change(group):
        for array in arrays:
            group[array][:] = group[array][:, ::-1].copy()

    rewrite(tmp_path / "r", name, change)
    found = verify(tmp_path / "r").findings
    assert {(issue.check, issue.message.split()[0]) for issue in found} == {("modalities", name) for name in arrays}


@pytest.mark.slow
@pytest.mark.skipif(available_renderers()["opengl"] is not None, reason="no EGL here")
def test_labels_of_hidden_goals_do_not_show_them(small_mazes, tmp_path):
    repaint(Repainting(small_mazes, tmp_path / "r", size=24, labels=["segmentation"]))
    seen = {}
    for name, subset in Release.open(tmp_path / "r").subsets.items():
        arrays = [array for array in subset.arrays if array.startswith("segmentation")]
        goal = get_task(subset.task).goal_geoms
        seen[name.rsplit("/")[-1]] = any(np.isin(subset.read(array, [0]), goal).any() for array in arrays)
    assert seen == {"visible": True, "hidden": False, "fixed": False}


def test_an_interrupted_repaint_goes_on(small_release, dynamic, tmp_path, no_simulation):
    shutil.copytree(dynamic, tmp_path / "r")
    (tmp_path / "r" / record_path(f"{NAME}/pixels", 1)).unlink()
    again = repaint(Repainting(small_release, tmp_path / "r", ["*/*/none"], distractor="dynamic"), 1)
    assert not again.shortfalls and again.digest == Release.open(dynamic).digest


def test_a_folder_with_another_release_is_left_alone(small_release, small_mazes, dynamic, tmp_path):
    shutil.copytree(small_mazes, tmp_path / "mazes")
    shutil.copytree(dynamic, tmp_path / "dynamic")
    for folder, request in (
        ("mazes", dict(only=["*/*/none"], distractor="dynamic")),
        ("dynamic", dict(only=["*/*/none"], distractor="dynamic", labels=["depth"])),
    ):
        before = (tmp_path / folder / "manifest.json").read_bytes()
        with pytest.raises(StoreError, match="not this repaint; give another --out"):
            repaint(Repainting(small_release, tmp_path / folder, **request))
        assert (tmp_path / folder / "manifest.json").read_bytes() == before and verify(tmp_path / folder).sound


def test_mistakes_are_refused_before_any_painting(small_release, tmp_path):
    out = tmp_path / "r"
    for mistaken, words in (
        (Repainting(small_release, out, distractor="static"), "would become walker-walk/random/static.*--only"),
        (Repainting(small_release, out, size=4), "8 to 1024"),
        (Repainting(small_release, out, renderer="povray"), "native"),
        (Repainting(small_release, out, ["*/*/none"], distractor="blurry"), "dynamic"),
        (Repainting(small_release, small_release), "the release itself"),
    ):
        with pytest.raises(DmcvbError, match=words):
            repaint(mistaken)
    assert not out.exists()


def test_a_damaged_source_is_not_painted(copy, tmp_path):
    path = copy / "walker-walk/random.zarr/trajectories/physics/c/0/0/0"
    data = bytearray(path.read_bytes())
    data[100] ^= 255
    path.write_bytes(data)
    with pytest.raises(StoreError, match="physics.*does not have its digest; run `dmcvb-gen regenerate"):
        repaint(Repainting(copy, tmp_path / "r", ["*/*/none"], size=8))


@pytest.mark.slow
def test_a_maze_repainted_for_evaluation_is_what_its_rollout_would_be(tmp_path):
    maze = dict(tasks="ant-maze-empty7x7", settings=["visible", "hidden"], episodes=2, max_steps=3, size=8)
    roll_out(short_recipe(**maze), tmp_path / "train")
    wanted = roll_out(short_recipe(**maze, split="val"), tmp_path / "wanted")
    found = repaint(Repainting(tmp_path / "train", tmp_path / "val", split="val"), 1)
    assert records(found) == records(wanted)
    assert {subset.split for subset in found.manifest.subsets} == {"val"}
    for folder, styles in (("train", {2, 3, 4, 5}), ("val", {1})):
        for subset in Release.open(tmp_path / folder).subsets.values():
            assert set((subset.read("exogenous/style") // 100).ravel()) <= styles
    assert Regeneration(tmp_path / "val").check().sound
