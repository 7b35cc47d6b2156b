"""Manifests in the package: any part of a release that is not here is made, with the released bytes."""

from __future__ import annotations

import json
import lzma
import random

import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.info import describe_release
from dmcvb_gen.generate.recipe import load_recipe
from dmcvb_gen.generate.resolve import resolve
from dmcvb_gen.generate.shipped import ENDING, Shipped, load_shipped, pack, shipped_manifests
from tests.conftest import invoke


@pytest.mark.full
@pytest.mark.parametrize("name", shipped_manifests())
def test_a_random_shard_of_each_has_the_released_bytes(name, tmp_path):
    known = load_shipped(name)
    chosen = random.Random(known.digest)
    records = chosen.sample(known.manifest.subsets, len(known.manifest.subsets))
    for record in {record.family: record for record in records}.values():
        first = chosen.randrange(record.episodes)
        words = ["--only", record.name, "--range", f"{first}:{first + 1}", "--out", tmp_path / record.family]
        assert "same digest" in invoke("regenerate", "--manifest", name, *words, code=0).output


@pytest.mark.slow_cases("dmcvb-mini", "dmcvb-v1")
@pytest.mark.parametrize("name", shipped_manifests())
def test_the_recipe_of_each_still_resolves_to_the_released_layers_and_job_keys(name):
    pixels = name != "dmcvb-v1"  # which was made without images
    assert resolve(load_recipe(name), pixels=pixels).resolved.sha256 in load_shipped(name).manifest.recipes


@pytest.mark.parametrize("release", ["small_release", "small_mazes"])
def test_the_archive_of_a_release_makes_its_shards_and_finds_others(request, release, tmp_path):
    opened = Release.open(request.getfixturevalue(release))
    pack(opened, tmp_path / f"it{ENDING}")
    known, name = load_shipped(tmp_path / f"it{ENDING}"), next(iter(opened))
    assert known.digest == opened.digest and known.recipes == opened.recipes
    asked = ["--only", name, "--range", "0:1", "--json"]
    one, other = (["regenerate", "--manifest", tmp_path / f"{archive}{ENDING}"] for archive in ("it", "other"))
    part = json.loads(invoke(*one, *asked, "--out", tmp_path / "part", code=0).stdout)
    assert part["sound"] and len(part["shards"]) == len(opened[name].layers)
    content = json.loads(lzma.decompress((tmp_path / f"it{ENDING}").read_bytes()))
    content["records"][opened[name].trajectories.name][0] = "0" * 64
    (tmp_path / f"other{ENDING}").write_bytes(lzma.compress(json.dumps(content).encode()))
    wrong = invoke(*other, *asked, "--out", tmp_path / "other", code=1)
    assert [shard["equal"] for shard in json.loads(wrong.stdout)["shards"]].count(False) == 1


WRONG = {
    "empty": b"",
    "text": b"a manifest",
    "no JSON": lzma.compress(b"{"),
    "other JSON": lzma.compress(b'{"manifest": 1}'),
    "a list": lzma.compress(b"[]"),
    "cut": lzma.compress(b"{}" * 1000)[:40],
}


@pytest.mark.parametrize("content", WRONG)
def test_a_wrong_or_damaged_archive_is_refused_in_one_line(tmp_path, content):
    (tmp_path / f"it{ENDING}").write_bytes(WRONG[content])
    said = invoke("regenerate", "--manifest", tmp_path / f"it{ENDING}", "--out", tmp_path / "out", code=2).output
    assert "no archive of a manifest" in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


def test_info_names_the_shipped_release_of_the_same_digest(small_release, monkeypatch):
    release, other = Release.open(small_release), load_shipped("quickstart")
    monkeypatch.setattr("dmcvb_gen.generate.shipped.shipped_manifests", lambda: [release.manifest.name])
    for shipped in (Shipped(release.manifest, (), {}), other):
        monkeypatch.setattr("dmcvb_gen.generate.shipped.load_shipped", lambda name, shipped=shipped: shipped)
        known = None if shipped is other else f"{release.manifest.name} {release.manifest.version}"
        assert describe_release(small_release)["shipped"] == known
