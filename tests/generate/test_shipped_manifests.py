"""Releases that the package describes: any shard comes out as it was released, on any machine."""

from __future__ import annotations

import io
import json
import lzma
import random
import tarfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset3 import Release
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.generate.shipped import load_shipped, pack, shipped_manifests
from tests.dataset3 import oracle

CARDS = Path(__file__).parents[2] / "dataset_cards"


def run(*arguments):
    return CliRunner().invoke(main, ["regenerate", *map(str, arguments)])


@pytest.mark.parametrize("name", shipped_manifests())
def test_the_package_and_the_card_describe_one_release(name):
    shipped = load_shipped(name)
    with tarfile.open(CARDS / name / "files.tar.xz") as archive:
        files = {entry.name: archive.extractfile(entry).read() for entry in archive if entry.isfile()}
    assert sha256_bytes(files["manifest.json"]) == shipped.digest
    assert (CARDS / name / "manifest.json").read_bytes() == files["manifest.json"]
    for layer in json.loads(files["manifest.json"])["layers"]:
        text = files[f"layers/{layer['list']}.json"]
        assert sha256_bytes(text) == layer["list"]
        canonical = [json.dumps(shard, sort_keys=True, separators=(",", ":")) for shard in json.loads(text)["shards"]]
        assert tuple(sha256_bytes(f"{each}\n".encode()) for each in canonical) == shipped.records[layer["name"]]


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_manifests())
def test_a_random_shard_of_each_kind_has_the_released_bytes(name, tmp_path):
    shipped = load_shipped(name)
    chosen = random.Random(shipped.digest)
    records = list(shipped.manifest.subsets)
    families = {record.family: record for record in chosen.sample(records, len(records))}
    for record in families.values():
        first = chosen.randrange(record.episodes)
        out = tmp_path / record.family
        done = run("--manifest", name, "--only", record.name, "--range", f"{first}:{first + 1}", "--out", out)
        assert done.exit_code == 0, done.output
        for layer in record.layers:
            shard = first // shipped.manifest.layer(layer).episodes_per_shard
            made = oracle.sha256(out / f"records/{layer}/{shard:05d}.json")
            assert made == shipped.records[layer][shard], layer


def test_the_archive_of_a_release_makes_its_shards_and_finds_others(small_release, tmp_path):
    archive = tmp_path / "small.json.xz"
    pack(Release.open(small_release), archive)
    name = "walker-walk/random/none"
    done = run("--manifest", archive, "--only", name, "--range", "0:1", "--out", tmp_path / "same")
    assert done.exit_code == 0, done.output
    content = json.loads(lzma.decompress(archive.read_bytes()))
    content["records"][f"{name}/labels"][0] = "0" * 64
    archive.write_bytes(lzma.compress(json.dumps(content).encode()))
    done = run("--manifest", archive, "--only", name, "--range", "0:1", "--out", tmp_path / "other")
    assert done.exit_code == 1 and f"{name}/labels shard 0" in done.output


DAMAGED = {
    "no archive": b"x",
    "cut": lzma.compress(b"{}")[:-5],
    "no object": lzma.compress(b"[]"),
    "no manifest": lzma.compress(b'{"manifest": 1, "recipes": [], "records": {}}'),
    "a tar": io.BytesIO(lzma.compress(b"manifest.json" + bytes(2000))).getvalue(),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_archive_is_one_line(name, tmp_path):
    path = tmp_path / "a.json.xz"
    path.write_bytes(DAMAGED[name])
    with pytest.raises(StoreError, match="no archive of a manifest, or damaged") as caught:
        load_shipped(path)
    assert "\n" not in str(caught.value)


def test_an_unknown_name_lists_the_known_ones(tmp_path):
    with pytest.raises(UnknownNameError, match="quickstart"):
        load_shipped("quickstrat")
    with pytest.raises(StoreError, match="is no file"):
        load_shipped(tmp_path / "none.json.xz")
