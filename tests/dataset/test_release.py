"""A release from its first file to its copy: what readers see, and what never changes."""

from __future__ import annotations

import itertools
import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.dataset import gate, writer
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import COPY, ShardRecord, canonical_json, record_path, shard_size
from dmcvb_gen.dataset.writer import (
    begin,
    finish,
    put,
    put_back,
    put_shard,
    read_provenance,
    write_provenance,
    wrong_bytes,
)
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.store import open_store
from tests.dataset import made_up, oracle

NAME = "hop/random/dynamic"


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "release")


def test_readers_get_the_values_that_were_written(store):
    subset = made_up.make(store, made_up.recipe(3))[NAME]
    layers = {spec.name: layer for layer in subset.layers for spec in layer.arrays}
    for name, layer in layers.items():
        parts = [dict(made_up.values(layer, shard))[name] for shard in (0, 1)]
        np.testing.assert_array_equal(subset.read(name), np.concatenate(parts)[:3], err_msg=name)
    assert len(subset) == 3 and subset.steps == subset.read("length").sum()
    landed = pickle.loads(pickle.dumps(subset))
    np.testing.assert_array_equal(landed.read("pixels"), subset.read("pixels"))


def test_readers_take_no_notice_of_zarr_metadata(store):
    before = made_up.make(store, made_up.recipe(2))[NAME].read("pixels")
    for path in store.folder.rglob("zarr.json"):
        path.write_text('{"zarr_format": 2}')
    np.testing.assert_array_equal(Release.open(store)[NAME].read("pixels"), before)


def test_a_release_in_the_making_opens_by_its_records(store):
    wanted = made_up.recipe(4)
    begin(store, wanted, {})
    assert len(Release.open(store)) == 0
    for layer in wanted.layers[:3]:  # trajectories, labels and images of the first setting
        put_shard(store, layer, 1, made_up.values(layer, 1))
    release = Release.open(store)
    assert release.in_the_making and list(release) == ["hop/random/none"]
    assert list(release["hop/random/none"].episodes) == [2, 3]
    assert finish(store).in_the_making


def test_growing_keeps_every_file_and_the_older_manifest(store):
    first = made_up.make(store, made_up.recipe(2))
    before = {path: oracle.sha256(store.folder / path) for path in store.list()}
    second = made_up.make(store, made_up.recipe(5))
    after = {path: oracle.sha256(store.folder / path) for path in store.list()}
    changed = {path for path in before if before[path] != after.get(path)}
    assert {path for path in changed if not path.endswith("zarr.json")} == {"manifest.json"}
    assert after[f"manifests/{first.digest}.json"] == first.digest
    assert len(second[NAME]) == 5 and oracle.check(store.folder)


def test_images_are_added_as_further_layers(store):
    light = made_up.make(store, made_up.recipe(5, images=False))
    with pytest.raises(StoreError, match="paint"):
        light[NAME].read("pixels")
    assert light[NAME].unpainted.all()
    begin(store, made_up.recipe(2), {})
    assert Release.open(store)[NAME].arrays == light[NAME].arrays
    part = made_up.make(store, made_up.recipe(2))[NAME]
    assert len(part) == 5 and list(np.flatnonzero(~part.unpainted)) == [0, 1] and len(part.read("pixels", [0, 1])) == 2
    with pytest.raises(StoreError, match="without images"):
        part.array("pixels")[:]
    painted = made_up.make(store, made_up.recipe(5))
    assert painted.digest != light.digest and not painted[NAME].unpainted.any()
    here = {layer.name: layer.list for layer in light.manifest.layers}
    assert here.items() <= {layer.name: layer.list for layer in painted.manifest.layers}.items()


def test_images_that_are_added_after_a_growth_are_listed(store):
    for count, images in ((3, False), (3, True), (5, False)):
        made_up.make(store, made_up.recipe(count, images=images))
    for layer in made_up.recipe(5).layers:
        if layer.kind == "images":
            put_shard(store, layer, 2, made_up.values(layer, 2))
    grown = finish(store)
    assert not any(subset.unpainted.any() for subset in grown.subsets.values()) and not grown.unfinished


def test_what_was_painted_first_is_the_release_that_is_made_at_once(store, tmp_path):
    at_once = made_up.recipe(5)
    made_up.make(store, at_once.model_copy(update={"recipe": {}}))  # as `paint` writes it
    assert made_up.make(store, at_once).digest == made_up.make(open_store(tmp_path / "other"), at_once).digest


def test_plain_readers_see_images_that_are_not_the_first(store):
    made_up.make(store, made_up.recipe(5, images=False))
    wanted = made_up.recipe(5)
    begin(store, wanted, {})
    layer = wanted.layers[2]
    put_shard(store, layer, 1, made_up.values(layer, 1))
    finish(store)
    assert json.loads((store.folder / layer.group / "pixels/zarr.json").read_bytes())["shape"][0] == 4


GROWTHS = [made_up.recipe(2), made_up.recipe(5), made_up.recipe(4, ["none"]), made_up.recipe(3, images=False)]


@pytest.mark.parametrize("order", [*itertools.permutations(range(len(GROWTHS)))][::5])
def test_growths_in_any_order_give_one_manifest_and_asking_for_less_changes_none(store, tmp_path, order):
    largest = made_up.make(open_store(tmp_path / "largest"), GROWTHS[1])
    for index in order:
        release = made_up.make(store, GROWTHS[index])
    assert release.digest == largest.digest and len(release.manifest.recipes) == 1


def test_a_manifest_that_another_process_finished_meanwhile_is_not_replaced(store, monkeypatch):
    build = writer.build_manifest

    def overtaken(*known):
        monkeypatch.undo()
        made_up.make(store, made_up.recipe(5))
        return build(*known)

    made_up.make(store, made_up.recipe(2))
    monkeypatch.setattr(writer, "build_manifest", overtaken)
    assert len(made_up.make(store, made_up.recipe(3))[NAME]) == len(Release.open(store)[NAME]) == 5


@pytest.mark.parametrize("bound", ["MANIFEST_BYTES", "RECIPE_BYTES", "COPY_BYTES"])
def test_what_is_parsed_is_bounded(store, monkeypatch, bound):
    made_up.make(store, made_up.recipe(2))
    store.create(COPY, b"{}")
    monkeypatch.setattr(gate, bound, 1)
    with pytest.raises(StoreError, match="larger than the 1 bytes"):
        gate.read_recipes(store)
        Release.open(store)


REFUSED = {
    "another seed": ({"makes": {"seed": 2}}, {}, "seed 1, asked for 2"),
    "another shard size": ({"episodes_per_shard": 3}, {}, "episodes_per_shard 2, asked"),
    "other styles": ({}, {"split": "val"}, "hop/random/none has split train, asked for val; choose another --out"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_recipe_that_contradicts_the_release_changes_nothing(store, name):
    of_layer, of_subsets, message = REFUSED[name]
    made_up.make(store, made_up.recipe(2))
    before = store.list()
    wanted, layer = made_up.recipe(4), made_up.TRAJECTORIES.model_copy(update=of_layer)
    other = {"layers": (layer, *wanted.layers[1:])}
    other |= {"subsets": tuple(subset.model_copy(update=of_subsets) for subset in wanted.subsets)}
    with pytest.raises(StoreError, match=message):
        begin(store, wanted.model_copy(update=other), {})
    assert store.list() == before


def test_other_bytes_are_never_put_over_a_file(store):
    wanted = made_up.recipe(2)
    begin(store, wanted, {})
    write_provenance(store, "test")
    layer = wanted.layers[2]
    record = put_shard(store, layer, 0, made_up.values(layer, 0))
    before = oracle.sha256(store.folder / layer.file_path(layer.arrays[0], 0))
    with pytest.raises(StoreError, match="other bytes .*made by dmcvb-gen"):
        put_shard(store, layer, 0, made_up.values(layer, 1))
    path = layer.file_path(layer.arrays[0], 0)
    assert put(store, path, b"other", first_wins=True) == record.files[layer.arrays[0].name]
    assert oracle.sha256(store.folder / path) == before


def test_the_record_of_another_job_is_refused(store):
    wanted = made_up.recipe(2)
    begin(store, wanted, {})
    layer = wanted.layers[1]
    store.create(record_path(layer.name, 0), canonical_json(ShardRecord(key="0" * 64, files={})))
    for act in (
        lambda: put_shard(store, layer, 0, made_up.values(layer, 0)),
        lambda: Release.open(store).records(layer.name),
    ):
        with pytest.raises(StoreError, match=f"another job .0{{12}}.*{layer.job_key(0)[:12]}"):
            act()


def test_a_folder_of_something_else_is_no_place_for_a_release(store):
    (store.folder).mkdir()
    (store.folder / "thesis.tex").write_text("x")
    with pytest.raises(StoreError, match=r"other files \(thesis.tex\); choose an empty place"):
        begin(store, made_up.recipe(2), {})


def test_a_release_is_no_place_for_another(store):
    made_up.make(store, made_up.recipe(2))
    with pytest.raises(StoreError, match="lies in the release .*; choose another --out"):
        begin(open_store(store.folder / "inner"), made_up.recipe(2), {})


def test_what_is_no_note_of_provenance_is_left_out(store):
    write_provenance(store, "test")
    for name, junk in {"0": b"garbage", "1": b"[]", "9": b'{"environment":{"cpu":["a"]}}'}.items():
        store.create(f"provenance/{name}.json", junk)
    assert [{*map(type, note["environment"].values())} for note in read_provenance(store)] == [{str}, set()]


def test_repair_puts_back_recorded_bytes_alone(store):
    release = made_up.make(store, made_up.recipe(2))
    file = next(file for shard in release.shards([NAME]) for file in shard.files if "pixels" in file.path)
    data = (store.folder / file.path).read_bytes()
    (store.folder / file.path).write_bytes(data[:-1] + b"x")
    assert wrong_bytes(store, file) == "does not have its digest"
    with pytest.raises(StoreError, match="nothing was changed"):
        put_back(store, file, b"other")
    put_back(store, file, data)
    assert wrong_bytes(store, file) is None and oracle.check(store.folder)


@given(st.integers(1, 10**6), st.integers(1, 1000))
def test_shards_are_full_and_nearly_equal(episodes, most):
    size = shard_size(episodes, most)
    shards = -(-episodes // size)
    assert size <= most and shards == -(-episodes // most) or size < most
    assert 0 <= shards * size - episodes < shards
