"""Manifests in the package: any part of a release that is not here is made, with the released bytes."""

from __future__ import annotations

import hashlib
import random
import shutil
import tarfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset.index import INDEX, parse_index
from dmcvb_gen.dataset.manifest import MANIFEST, Manifest
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.errors import RecipeError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.generate.recipe import load_recipe
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.request import make_request
from dmcvb_gen.generate.shipped import (
    ENDING,
    SHARDS,
    manifest_source,
    pack,
    read_complete,
    read_shard_digests,
    shipped_manifests,
    unpack,
    with_shard_digests,
)

CARDS = Path(__file__).parents[2] / "dataset_cards"


def run(*arguments):
    return CliRunner().invoke(main, ["regenerate", *map(str, arguments)])


PARTS = [name for name in shipped_manifests() if name.startswith("dmcvb-v1-")]


@pytest.mark.parametrize("name", PARTS)
def test_a_part_of_dmcvb_v1_has_its_shards(name):
    """So that a shard of the whole stands for the same one of a part."""
    with manifest_source("dmcvb-v1") as whole, manifest_source(name) as part:
        ours, shards = load_manifest(part)[1].subsets, read_shard_digests(part)
        theirs, all_shards = load_manifest(whole)[1].subsets, read_shard_digests(whole)
    assert (
        ours and {record.name: record for record in theirs}.items() >= {record.name: record for record in ours}.items()
    )
    assert set(shards) == {record.name for record in ours} and shards.items() <= all_shards.items()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(shipped_manifests()) - set(PARTS)))
def test_a_random_shard_of_each_has_the_released_bytes(name, tmp_path):
    with manifest_source(name) as folder:
        manifest = load_manifest(folder)[1]
        shards = read_shard_digests(folder)
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
        folder = out / f"{record.name}.zarr"
        made = {path.relative_to(out).as_posix(): path for path in folder.rglob("c/**/*") if path.is_file()}
        lines = "".join(f"{sha256_file(made[path])}  {path}\n" for path in sorted(made))
        assert made and hashlib.sha256(lines.encode()).hexdigest() in shards[record.name]


@pytest.mark.parametrize("name", shipped_manifests())
def test_the_files_of_a_card_give_the_shards_of_the_package(name):
    members = unpack(CARDS / name / f"files{ENDING}")
    index = parse_index(members[INDEX])
    manifest = Manifest.model_validate_json(members[MANIFEST])
    assert Manifest.model_validate_json((CARDS / name / MANIFEST).read_bytes()).digest == manifest.digest
    with manifest_source(name) as folder, manifest_source(CARDS / name / f"files{ENDING}") as whole:
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == with_shard_digests(manifest, index)
        assert read_complete(whole) == (manifest, index)
        with pytest.raises(StoreError, match=f"dataset_cards/{name}/files"):
            read_complete(folder)


def bare(folder, members):
    """A folder with the members of an archive."""
    pack(members, folder.with_suffix(ENDING))
    assert unpack(folder.with_suffix(ENDING)) == members
    folder.mkdir()
    for name, content in members.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("list_name", [INDEX, SHARDS])
def test_the_archive_of_a_release_makes_its_shards_and_finds_others(small_release, tmp_path, list_name):
    manifest, index = read_complete(small_release)
    files = {name: (small_release / name).read_bytes() for name in (MANIFEST, INDEX)}
    folder = bare(tmp_path / "bare", files if list_name == INDEX else with_shard_digests(manifest, index))
    record = manifest.subsets[0]
    outcome = Regeneration(folder, [record.name], (0, 1)).remake(tmp_path / "part")
    assert [shard.equal for shard in outcome.shards] == [True]
    text = (folder / list_name).read_text()
    if list_name == INDEX:
        promised = next(f.sha256 for f in index.files if f.path.startswith(f"{record.name}.zarr/action/c/0"))
    else:
        promised = read_shard_digests(folder)[record.name][0]
    (folder / list_name).write_text(text.replace(promised, "0" * 64))
    outcome = Regeneration(folder, [record.name], (0, 1)).remake(tmp_path / "other")
    assert not any(shard.equal for shard in outcome.shards)


def test_shards_of_another_manifest_prove_nothing(small_release, tmp_path):
    manifest, index = read_complete(small_release)
    folder = bare(tmp_path / "bare", with_shard_digests(manifest, index))
    (folder / MANIFEST).write_bytes((folder / MANIFEST).read_bytes() + b"\n")
    record = manifest.subsets[0]
    outcome = Regeneration(folder, [record.name], (0, 1)).remake(tmp_path / "part")
    assert [shard.equal for shard in outcome.shards] == [None]


def test_an_incomplete_release_is_not_shipped(small_release, tmp_path):
    shutil.copytree(small_release, tmp_path / "r")
    (tmp_path / "r" / INDEX).unlink()
    with pytest.raises(StoreError, match="not complete"):
        read_complete(tmp_path / "r")


def test_a_wrong_or_damaged_archive_is_refused_in_one_line(tmp_path):
    whole = (CARDS / "quickstart" / f"files{ENDING}").read_bytes()
    middle = len(whole) // 2
    wrong = {
        "empty": b"",
        "cut": whole[:middle],
        "altered": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
        "text": b"a manifest",
    }
    for name, content in wrong.items():
        (tmp_path / f"{name}{ENDING}").write_bytes(content)
    pack({"../../other": b"{}"}, tmp_path / f"strange{ENDING}")
    with tarfile.open(tmp_path / f"link{ENDING}", "w:xz") as archive:
        link = tarfile.TarInfo(MANIFEST)
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/hostname"
        archive.addfile(link)
    for name in (*wrong, "strange", "link"):
        done = run("--manifest", tmp_path / f"{name}{ENDING}", "--out", tmp_path / "out")
        assert done.exit_code == 2 and "no archive of a manifest" in done.output, (name, done.output)
        assert len(done.output.splitlines()) == 1 and not (tmp_path / "out").exists()


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


def test_a_folder_of_the_same_name_hides_nothing_that_is_shipped(tmp_path, monkeypatch):
    """`rollout --recipe quickstart --out quickstart` is run again to resume."""
    monkeypatch.chdir(tmp_path)
    for name in ("quickstart", "empty7x7"):
        (tmp_path / name).mkdir()
    assert load_recipe("quickstart").name == "quickstart"
    assert make_request(["walker-walk"], None, episodes=1).name == "walker-walk-random"
    assert make_request([], None, layouts=("empty7x7",)).subsets[0].tasks == ("ant-maze-empty7x7",)
    with manifest_source("quickstart") as folder:
        assert (folder / "manifest.json").is_file()
    with pytest.raises(RecipeError, match="Is a directory"):
        load_recipe("./quickstart")
