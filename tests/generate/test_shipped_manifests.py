"""Manifests in the package: any part of a release that is not here is made, with the released bytes."""

from __future__ import annotations

import random
import shutil

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset.index import INDEX, read_index
from dmcvb_gen.dataset.manifest import MANIFEST
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.shipped import manifest_source, shipped_manifests, unpack, write_archive


def run(*arguments):
    return CliRunner().invoke(main, ["regenerate", *map(str, arguments)])


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_manifests())
def test_a_random_shard_of_each_has_the_released_bytes(name, tmp_path):
    with manifest_source(name) as folder:
        manifest, index = load_manifest(folder)[1], read_index(folder)
    assert manifest.complete and manifest.name == name
    chosen = random.Random(manifest.digest)
    families = {
        record.task.startswith("ant-maze"): record for record in chosen.sample(manifest.subsets, len(manifest.subsets))
    }
    for record in families.values():
        first = chosen.randrange(record.episodes)
        out = tmp_path / record.task
        done = run("--manifest", name, "--only", record.name, "--episodes", f"{first}:{first + 1}", "--out", out)
        assert done.exit_code == 0 and "made again with the same digest" in done.output, done.output
        digests = {file.path: file.sha256 for file in index.files}
        made = [path for path in (out / f"{record.name}.zarr").rglob("c/**/*") if path.is_file()]
        assert made and all(sha256_file(path) == digests[path.relative_to(out).as_posix()] for path in made)


def test_the_archive_of_a_release_makes_its_shards_and_finds_others(small_release, tmp_path):
    archive = tmp_path / "small.tar.xz"
    assert write_archive(small_release, archive) == archive.stat().st_size
    members = unpack(archive)
    assert members == {name: (small_release / name).read_bytes() for name in (MANIFEST, INDEX)}
    (tmp_path / "bare").mkdir()
    for name, content in members.items():
        (tmp_path / "bare" / name).write_bytes(content)
    record = load_manifest(small_release)[1].subsets[0]
    outcome = Regeneration(tmp_path / "bare", [record.name], (0, 1)).remake(tmp_path / "part")
    assert [shard.equal for shard in outcome.shards] == [True]
    text = (tmp_path / "bare" / INDEX).read_text()
    shard = next(f for f in read_index(small_release).files if f.path.startswith(f"{record.name}.zarr/action/c/0"))
    (tmp_path / "bare" / INDEX).write_text(text.replace(shard.sha256, "0" * 64))
    outcome = Regeneration(tmp_path / "bare", [record.name], (0, 1)).remake(tmp_path / "other")
    assert not any(shard.equal for shard in outcome.shards), "an index that was altered proves nothing"


def test_an_incomplete_release_is_not_shipped(small_release, tmp_path):
    shutil.copytree(small_release, tmp_path / "r")
    (tmp_path / "r" / INDEX).unlink()
    with pytest.raises(StoreError, match="not complete"):
        write_archive(tmp_path / "r", tmp_path / "r.tar.xz")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("quickstrat", "quickstart"),
        ("nothing/manifest.json", "is not there"),
        (".", "is a folder"),
    ],
)
def test_other_manifests_are_refused_in_one_line(given, message, tmp_path):
    done = run("--manifest", given, "--out", tmp_path / "out")
    assert done.exit_code in (1, 2) and message in done.output and "Traceback" not in done.output
    assert not (tmp_path / "out").exists()
