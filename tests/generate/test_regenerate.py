"""Regenerating: a release's shards come out bit for bit; damage is repaired, sound shards stay as they are."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import zarr
from click.testing import CliRunner
from PIL import Image

from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import parse_commit, write_json_atomically
from dmcvb_gen.dataset.shards import chosen_shards
from dmcvb_gen.dataset.writer import commit_path, finish_release, sha256_file
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import write_json
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.inputs import release_inputs
from dmcvb_gen.generate.jobs import make_jobs
from dmcvb_gen.generate.paint import paint_release
from dmcvb_gen.generate.plan import finish, make_plan, prepare
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.release.verify import verify
from tests.conftest import roll_out, small_recipe

NAME = "walker-walk/random/dynamic"


@pytest.fixture
def copy(small_release, tmp_path):
    shutil.copytree(small_release, tmp_path / "copy")
    return tmp_path / "copy"


def files_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stamps_of(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


LOCOMOTION = {"tasks": "walker-walk", "levels": ["random", "expert"], "settings": ["none", "static"], "episodes": 3}
MAZE = {"tasks": "ant-maze-empty7x7", "levels": "random", "settings": ["visible", "hidden", "fixed"]}
MAZE |= {"episodes": 3, "fixed_goals": 2, "episodes_per_goal": 2, "episodes_per_shard": 2}


@pytest.mark.parametrize("trajectories", ["shared", "independent"])
@pytest.mark.parametrize("pattern", [LOCOMOTION, MAZE], ids=["locomotion", "maze"])
def test_the_jobs_are_those_of_the_rollout(tmp_path, pattern, trajectories):
    plan = make_plan(small_recipe(subsets=[pattern], trajectories=trajectories), tmp_path / "r")
    inputs = release_inputs(tmp_path / "r", plan.manifest.subsets)
    jobs = make_jobs(plan.manifest, chosen_shards(plan.manifest), plan.jobs[0].target, inputs)
    assert sorted(jobs, key=str) == sorted(plan.jobs, key=str) and jobs


def test_a_part_of_a_release_comes_out_with_its_digests(small_release):
    before = stamps_of(small_release)
    outcome = Regeneration(small_release, ["*/*/dynamic"], (2, 3)).check()
    [shard] = outcome.shards
    assert outcome.sound and shard.equal and (shard.subset, shard.shard) == (NAME, 1)
    assert outcome.environment == {} and stamps_of(small_release) == before


@pytest.mark.filterwarnings("error:Object at")
@pytest.mark.parametrize("name, shards", [("small_release", 6), ("maze_release", 2)])
def test_nothing_but_the_manifest_is_needed(request, name, shards, tmp_path):
    small_release = request.getfixturevalue(name)
    (tmp_path / "bare").mkdir()
    shutil.copy(small_release / "manifest.json", tmp_path / "bare")
    outcome = Regeneration(tmp_path / "bare").repair()
    assert outcome.sound and len(outcome.shards) == shards
    assert files_of(tmp_path / "bare").keys() - {tmp_path / "bare/manifest.json"}
    for path, data in files_of(small_release).items():
        if path.name not in (".created", ".lock") and "preview" not in path.parts:
            assert (tmp_path / "bare" / path.relative_to(small_release)).read_bytes() == data


@pytest.mark.parametrize("lost", ["a file", "a record too"])
def test_a_part_is_repaired_and_does_not_become_the_whole(small_release, tmp_path, lost):
    Regeneration(small_release, ["*/*/dynamic"], (2, 3)).remake(tmp_path / "part")
    [commit] = open_release(tmp_path / "part")[NAME].commits.values()
    before = files_of(tmp_path / "part")
    (tmp_path / "part" / commit.files[0].path).unlink()
    if lost == "a record too":
        (tmp_path / "part" / commit_path(NAME, 1)).unlink()
    [shard] = Regeneration(tmp_path / "part").repair().shards
    assert shard.repaired and (shard.subset, shard.shard) == (NAME, 1)
    assert files_of(tmp_path / "part").keys() == before.keys() and verify(tmp_path / "part").sound


def test_damaged_and_missing_shards_are_repaired_and_sound_ones_not_touched(copy, small_release):
    pixels = next(file for file in open_release(copy)[NAME].commits[1].files if "/pixels/" in file.path).path
    data = bytearray((copy / pixels).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / pixels).write_bytes(data)
    state = next(f for f in open_release(copy)["walker-walk/random/none"].commits[0].files if "/state/" in f.path).path
    (copy / state).unlink()
    (copy / commit_path("walker-walk/random/static", 1)).unlink()
    before = stamps_of(copy)
    outcome = Regeneration(copy).repair()
    assert outcome.sound and {(shard.subset.split("/")[-1], shard.shard) for shard in outcome.shards} == {
        ("dynamic", 1),
        ("none", 0),
        ("static", 1),
    }
    assert all(shard.repaired and shard.was for shard in outcome.shards)
    assert verify(copy).sound and not list(copy.glob(".regenerate-*"))
    touched = {path for path, stamp in stamps_of(copy).items() if before.get(path) != stamp}
    sound = ("dynamic.zarr", "/c/0"), ("none.zarr", "/c/1"), ("static.zarr", "/c/")
    sound = {path for path in touched for subset, shard in sound if subset in str(path) and shard in str(path)}
    sound -= {path for path in sound if "static.zarr" in str(path) and "/c/1" in str(path)}
    assert not sound and (copy / "manifest.json") not in touched
    for path, data in files_of(small_release).items():
        assert (copy / path.relative_to(small_release)).read_bytes() == data


def test_a_repair_that_is_interrupted_keeps_the_record_of_the_damaged_shard(copy, monkeypatch):
    manifest = open_release(copy).manifest
    commit = copy / commit_path(manifest.subsets[0].name, 0)
    record = parse_commit(commit.read_bytes())
    (copy / record.files[0].path).unlink()

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(StoreError, match="make room"):
        patch.setattr("dmcvb_gen.generate.regenerate.os.replace", full)
        Regeneration(copy).repair()
    assert parse_commit(commit.read_bytes()).same_data(record)
    assert Regeneration(copy).repair().sound and verify(copy).sound


def test_lost_metadata_is_put_back(copy):
    (copy / f"{NAME}.zarr/zarr.json").write_text("{")
    shutil.rmtree(copy / f"{NAME}.zarr/pixels")
    assert Regeneration(copy).repair().sound and verify(copy).sound
    assert Regeneration(copy).repair().shards == ()


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        (f"{NAME}.zarr/discount/zarr.json", b'"level"', b'"leval"'),
        (f"{NAME}.zarr/zarr.json", b'"walker-walk', b'"walker-wa1k'),
        ("files.json", b'"bytes": 1', b'"bytes": 7'),
    ],
)
def test_metadata_that_are_still_json_but_not_what_they_were_are_put_back(copy, name, old, new):
    was = (copy / name).read_bytes()
    (copy / name).write_bytes(was.replace(old, new, 1))
    assert (copy / name).read_bytes() != was and not verify(copy).sound
    assert Regeneration(copy, [NAME], (2, 3)).check().sound, "shards are made with the metadata that are meant"
    assert Regeneration(copy).repair().sound and verify(copy).sound
    assert (copy / name).read_bytes() == was


@pytest.mark.parametrize(
    "field, change",
    [
        ("sha256", lambda text: text[:10] + ("0" if text[10] != "0" else "1") + text[11:]),
        ("bytes", lambda size: size + 1),
        ("steps", lambda steps: steps - 1),
        ("environment", lambda facts: facts | {"numpy": "0.0"}),
    ],
)
def test_a_commit_record_that_is_not_what_it_was_is_put_back(copy, field, change):
    path = copy / commit_path(NAME, 1)
    was, record = path.read_bytes(), json.loads(path.read_bytes())
    place = record["files"][2] if field in ("sha256", "bytes") else record
    place[field] = change(place[field])
    write_json(path, record)
    assert not verify(copy).sound
    [shard] = Regeneration(copy).repair().shards
    assert shard.repaired and "commit record" in shard.was
    assert path.read_bytes() == was and verify(copy).sound


def test_a_release_keeps_its_own_codecs_when_the_code_has_new_ones(copy, monkeypatch):
    monkeypatch.setattr("dmcvb_gen.dataset.writer.picture_layout_for", lambda camera_moves: "zstd-9")
    assert Regeneration(copy, [NAME], (2, 3)).check().sound


def change_actions(folder):
    """Another machine's data: other values under digests of their own."""
    group = zarr.open_group(str(folder / f"{NAME}.zarr"), mode="r+", use_consolidated=False)
    group["action"][0] = group["action"][0] * 0.5
    pixels = group["pixels"][0]
    pixels[:5] = np.minimum(pixels[:5], 250) + 3
    group["pixels"][0] = pixels
    path = folder / commit_path(NAME, 0)
    commit = parse_commit(path.read_text())
    files = [
        file.model_copy(
            update={"bytes": (folder / file.path).stat().st_size, "sha256": sha256_file(folder / file.path)}
        )
        for file in commit.files
    ]
    write_json_atomically(path, commit.model_copy(update={"files": tuple(files)}))
    for path in folder.glob("commits/**/*.json"):
        commit = parse_commit(path.read_text())
        elsewhere = {**commit.environment, "cpu": "Another 9000"}
        write_json_atomically(path, commit.model_copy(update={"environment": elsewhere}))
    finish_release(folder, open_release(folder).manifest)


def test_a_difference_is_said_with_how_far_and_what_differs_in_the_environment(copy):
    change_actions(copy)
    result = CliRunner().invoke(main, ["regenerate", str(copy), "--only", NAME, "--episodes", "0:1", "--check"])
    assert result.exit_code == 1
    assert "action differ, state equal" in result.output and "pixels: max 3, mean" in result.output
    assert "environment: cpu was Another 9000, is" in result.output


def test_a_shard_that_comes_out_otherwise_is_not_put_in(copy):
    change_actions(copy)
    pixels = next(file for file in open_release(copy)[NAME].commits[0].files if "/pixels/" in file.path).path
    (copy / pixels).write_bytes(b"rubbish")
    before = files_of(copy)
    outcome = Regeneration(copy).repair()
    assert not outcome.sound and [shard.repaired for shard in outcome.shards] == [False]
    assert files_of(copy) == before


def test_beside_it_makes_an_equal_release(small_release, tmp_path):
    outcome = Regeneration(small_release, ["*/*/none"]).remake(tmp_path / "beside")
    assert outcome.sound and all(shard.equal for shard in outcome.shards)
    assert list(open_release(tmp_path / "beside").subsets) == ["walker-walk/random/none"]
    with pytest.raises(StoreError, match="remove --out"):
        Regeneration(small_release).remake(small_release)


def tiny_recipe(episodes, **changes):
    short = {"settings": "none", "episodes": episodes, "episodes_per_shard": 2, "max_steps": 3}
    return small_recipe(size=8, subsets=[LOCOMOTION | {"levels": "random"} | short], **changes)


def light_release(folder, episodes=4, **changes):
    """A tiny release without images, or one that is there grown to as many episodes."""
    plan = prepare(make_plan(tiny_recipe(episodes, **changes), folder, pixels=False))
    list(run_jobs(plan.jobs))
    return finish(plan)


def test_beside_it_goes_on_in_what_has_grown_or_been_painted_since(tmp_path):
    light_release(tmp_path / "light")
    again = Regeneration(tmp_path / "light")
    again.remake(tmp_path / "grown")
    light_release(tmp_path / "grown", 6)
    assert again.remake(tmp_path / "grown").sound and verify(tmp_path / "grown").sound

    Regeneration(tmp_path / "light", episodes=(0, 2)).remake(tmp_path / "painted")
    paint_release(tmp_path / "painted")
    assert Regeneration(tmp_path / "light", episodes=(2, 4)).remake(tmp_path / "painted").sound
    assert paint_release(tmp_path / "painted").shards == 1 and verify(tmp_path / "painted").sound
    paint_release(tmp_path / "light")
    images = "walker-walk/random/none.zarr/pixels"
    for path, data in files_of(tmp_path / "light" / images).items():
        assert (tmp_path / "painted" / images / path.relative_to(tmp_path / "light" / images)).read_bytes() == data


def test_beside_it_leaves_another_release_alone(small_release, maze_release, tmp_path):
    shutil.copytree(maze_release, tmp_path / "mazes")
    prepare(make_plan(small_recipe(), tmp_path / "grown"))
    prepare(make_plan(small_recipe(subsets=[MAZE]), tmp_path / "grown"))
    prepare(make_plan(small_recipe(), tmp_path / "other"))
    prepare(make_plan(small_recipe(subsets=[LOCOMOTION]), tmp_path / "other"))
    for source, out in ((small_release, "mazes"), (tmp_path / "grown", "other")):
        before = files_of(tmp_path / out)
        with pytest.raises(StoreError, match="was not made from small .*give another --out"):
            Regeneration(source).remake(tmp_path / out)
        assert files_of(tmp_path / out) == before


def test_bad_requests_say_what_to_do(small_release, tmp_path, copy):
    with pytest.raises(UnknownNameError, match="walker-walk/random/none"):
        Regeneration(small_release, ["cheetah-run"]).check()
    with pytest.raises(StoreError, match="no subset has episodes 7:9"):
        Regeneration(small_release, episodes=(7, 9)).check()
    with pytest.raises(StoreError, match="holds no release"):
        Regeneration(tmp_path).check()
    with pytest.raises(StoreError, match="not those that.*--backgrounds"):
        data = json.loads((copy / "manifest.json").read_text())
        for subset in data["subsets"]:
            if subset["backgrounds"]:
                subset["backgrounds"]["digest"] = "0" * 64
        (copy / "manifest.json").write_text(json.dumps(data))
        Regeneration(copy, [NAME]).check()
    data["schema_version"] = 99
    (copy / "manifest.json").write_text(json.dumps(data))
    result = CliRunner().invoke(main, ["regenerate", str(copy)])
    assert result.exit_code == 2 and "install a newer dmcvb-gen" in result.output


def test_a_policy_that_is_nowhere_is_named(copy):
    data = json.loads((copy / "manifest.json").read_text())
    data["subsets"][0]["policies"] = [{"name": "mine", "digest": "f" * 64, "path": "policies/mine.safetensors"}]
    (copy / "manifest.json").write_text(json.dumps(data))
    with pytest.raises(StoreError, match="policies/mine.safetensors"):
        Regeneration(copy).check()


def test_a_manifest_alone_is_enough(tmp_path):
    patterns = [LOCOMOTION | {"settings": "dynamic", "levels": "expert"}, MAZE | {"settings": ["hidden", "fixed"]}]
    short = [pattern | {"max_steps": 5, "episodes": 2} for pattern in patterns]
    made = roll_out(small_recipe(subsets=short), tmp_path / "r")
    (tmp_path / "card").mkdir()
    shutil.copy(tmp_path / "r/manifest.json", tmp_path / "card/kept.json")
    shutil.rmtree(tmp_path / "r")

    command = ["regenerate", "--manifest", str(tmp_path / "card/kept.json"), "--out", str(tmp_path / "again")]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    assert "made again with the same digest" in result.output and "no digest" not in result.output
    again = open_release(tmp_path / "again").manifest
    assert {s.name: s.digest for s in again.subsets} == {s.name: s.digest for s in made.subsets} and len(
        again.subsets
    ) == 3
    assert [path.name for path in (tmp_path / "card").iterdir()] == ["kept.json"]

    wrong = made.model_copy(update={"subsets": tuple(s.model_copy(update={"digest": "0" * 64}) for s in made.subsets)})
    write_json_atomically(tmp_path / "card/wrong.json", json.loads(wrong.model_dump_json()))
    part = ["--manifest", str(tmp_path / "card/wrong.json"), "--only", "*/*/hidden", "--out", str(tmp_path / "part")]
    result = CliRunner().invoke(main, ["regenerate", *part])
    assert result.exit_code == 1 and "other bytes" in result.output


@pytest.mark.parametrize("arguments", [[], ["r", "--manifest", __file__], ["--manifest", __file__]])
def test_a_manifest_and_a_release_are_not_mixed_up(arguments):
    assert CliRunner().invoke(main, ["regenerate", *arguments]).exit_code == 2


@pytest.mark.parametrize("more", [[], ["--check"], ["--only", "*/*/none"]])
def test_a_manifests_file_is_no_release_to_repair(small_release, tmp_path, more):
    shutil.copy(small_release / "manifest.json", tmp_path / "kept.json")
    result = CliRunner().invoke(main, ["regenerate", str(tmp_path / "kept.json"), *more])
    assert result.exit_code == 2 and "--manifest" in result.output and "--out" in result.output, result.output
    assert [path.name for path in tmp_path.iterdir()] == ["kept.json"]


def test_lost_videos_are_put_back_and_named(tmp_path):
    videos = tmp_path / "videos/train"
    videos.mkdir(parents=True)
    for number in range(2):
        Image.fromarray(np.full((16, 16, 3), 90 * number, np.uint8)).save(videos / f"{number}.png")
    pattern = LOCOMOTION | {"settings": "static", "episodes": 1, "max_steps": 3}
    roll_out(small_recipe(subsets=[pattern], backgrounds=str(tmp_path / "videos")), tmp_path / "r")
    [folder] = (tmp_path / "r/backgrounds").iterdir()
    shutil.rmtree(folder)
    command = ["regenerate", str(tmp_path / "r"), "--backgrounds", str(tmp_path / "videos")]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0 and "2 other files put back" in result.output, result.output
    assert "nothing" not in result.output and verify(tmp_path / "r").sound
    assert "nothing is damaged" in CliRunner().invoke(main, command).output
    [picture, _] = sorted((tmp_path / "r/backgrounds").rglob("*.png"))
    picture.write_bytes(picture.read_bytes()[:20])
    found = {(finding.check, finding.subset) for finding in verify(tmp_path / "r").findings}
    assert any(check == "files" for check, _ in found), found
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0 and "nothing" not in result.output and verify(tmp_path / "r").sound


def test_a_damaged_policy_is_put_back(tmp_path):
    pattern = LOCOMOTION | {"levels": "expert", "settings": "none", "episodes": 1, "max_steps": 3}
    roll_out(small_recipe(subsets=[pattern]), tmp_path / "r")
    [policy] = (tmp_path / "r/policies").iterdir()
    policy.write_bytes(policy.read_bytes()[:20])
    assert not verify(tmp_path / "r").sound
    outcome = Regeneration(tmp_path / "r").repair()
    assert outcome.restored == (f"policies/{policy.name}",) and verify(tmp_path / "r").sound
