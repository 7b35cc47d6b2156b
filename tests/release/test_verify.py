"""A sound release passes; each kind of damage is found by the check that is meant for it."""

from __future__ import annotations

import json
from unittest.mock import Mock

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import RenderingError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify, verify_folder
from tests.conftest import invoke, rewrite, roll_out, short_recipe, wrong_files

NAME, MAZE = "walker-walk/random/dynamic", "ant-maze-tiny/random/visible"


COUNTS = {"small_release": {"subsets": 3, "episodes": 9, "steps": 4500}, "small_mazes": {"subsets": 3, "episodes": 6}}


@pytest.mark.parametrize("release", COUNTS)
def test_a_sound_release_passes(release, request):
    folder = request.getfixturevalue(release)
    result = verify(folder)
    assert result.sound and result.complete and COUNTS[release].items() <= result.checked.items()
    assert result.digest == sha256_file(folder / "manifest.json") and not result.compared


def test_all_count_the_files_that_the_digest_covers(small_release, tmp_path):
    url, part = f"file:{tmp_path / 'there'}", tmp_path / "part"
    count = publish(small_release, url).files
    uncovered = {"zarr.json", "manifest.json", ".lock"}
    files = [path for path in (tmp_path / "there").rglob("*") if path.is_file() and path.name not in uncovered]
    assert count == sum("provenance" not in path.parts for path in files)
    for release, everything in ((small_release, False), (url, True), (url, False)):
        assert verify(release, everything=everything).covered == count
    assert f"files of {count})" in invoke("verify", url, code=0).output
    moved = json.loads(invoke("fetch", url, "--only", "*/none", "--out", part, "--json", code=0).stdout)
    found = verify(part)
    assert moved["files"] == found.covered == found.checked["files"]


def swap_rewards(arrays):
    arrays["reward"][0, :500] = np.roll(arrays["reward"][0, :500], 7)  # the return stays the same


def duplicate(arrays):
    for name in ("state", "action", "reward", "physics", "return"):
        arrays[name][2] = arrays[name][0]


def enrich(arrays):
    arrays["return"][1] += 2000 - arrays["reward"][1, 3]
    arrays["reward"][1, 3] = 2000


def put(name, place, value):
    """A change of one number."""
    return lambda arrays: arrays[name].__setitem__(place, value)


DAMAGE = {
    "rewards in another order": (swap_rewards, {"rewards", 0}),
    "pixels of another episode": (lambda arrays: put("pixels", 1, arrays["pixels"][0])(arrays), {"pixels", 1}),
    "a state that is none": (put("state", (2, 123, 4), np.nan), {"finite", 2, 123}),
    "another return": (put("return", 1, 100), {"returns", 1}),
    "an episode twice": (duplicate, {"duplicates", 2}),
    "a wild action": (put("action", (1, 7, 0), 1.5), {"actions", 1, 7}),
    "no length": (put("length", 1, 0), {"lengths", 1}),
    "an end that was none": (put("terminated", 1, True), {"lengths", 1}),
    "another state": (put("state", (0, 0, 3), 9.0), {"states", 0}),
    "a leap": (put("physics", (0, 1, 4), 9.0), {"physics", 0}),
    "a return that no episode has": (enrich, {"returns", 1}),
}
"""Damage to the arrays, the check that finds it, the episode, and the step if it is known."""


@pytest.mark.parametrize("name", DAMAGE)
def test_wrong_values_are_found_by_their_check(copy, name):
    change, place = DAMAGE[name]
    rewrite(copy, NAME, change)
    found = verify_folder(copy, names=[NAME]).findings
    assert any(place <= {finding.check, finding.episode, finding.step} for finding in found), found
    assert {finding.subset for finding in found} == {NAME}


def test_equal_actions_alone_are_no_duplicate(copy):
    rewrite(copy, NAME, lambda arrays: put("action", 2, arrays["action"][0])(arrays))
    assert not any(finding.check == "duplicates" for finding in verify_folder(copy, names=[NAME]).findings)


def test_returns_of_longer_episodes_may_be_higher(tmp_path):
    one = dict(levels="expert", settings="none", episodes=1, max_steps=600)
    roll_out(short_recipe(**one, size=8, seed=4), tmp_path / "long")
    assert Release.open(tmp_path / "long")["walker-walk/expert/none"].returns.max() > 1000
    assert verify(tmp_path / "long").sound
    [policy] = (tmp_path / "long/policies").iterdir()
    policy.write_bytes(policy.read_bytes()[:-1] + b"x")
    [found] = wrong_files(tmp_path / "long")
    assert found.subset == f"policies/{policy.name}" and "does not have its digest" in found.message


def test_what_this_machine_cannot_check_is_not_called_damaged(copy, monkeypatch):
    error = RenderingError("no renderer here")
    monkeypatch.setattr("dmcvb_gen.release.contents.renderer_for", Mock(side_effect=error))
    said = invoke("verify", copy, code=3).output
    assert "NOT CHECKED walker-walk" in said and "regenerate" not in said


def test_a_damaged_layer_is_named_with_its_cure_and_its_values_are_not_read(copy):
    path = next(copy.rglob("random.zarr/dynamic/pixels/c/*/0/0/0/0"))
    path.write_bytes(path.read_bytes()[:100])
    facts = json.loads(invoke("verify", copy, "--json", code=1).output)
    assert facts["checked"]["subsets"] == 2
    [finding] = facts["findings"]
    assert finding["subset"] == f"{NAME}/pixels" and "has 100 bytes instead of" in finding["message"]
    assert "`dmcvb-gen regenerate" in invoke("verify", copy).output


@pytest.mark.parametrize(("release", "name", "here"), [("small_release", NAME, 2), ("maze_release", MAZE, 1)])
def test_a_part_of_a_release_is_called_incomplete(release, name, here, request, tmp_path):
    source = request.getfixturevalue(release)
    fetch(f"file:{source}", tmp_path / "part", [name], (0, 1))
    said = invoke("verify", tmp_path / "part", code=3).output
    assert f"{name}: {here} of {Release.open(source)[name].record.episodes} episodes" in said
    assert "incomplete:" in said and "not compared" not in said


def test_a_manifest_that_does_not_follow_from_its_recipes_is_no_sound_release(copy):
    text = (copy / "manifest.json").read_bytes()
    (copy / "manifest.json").write_bytes(text.replace(b'"right_hip"', b'"left_nose"'))
    assert [issue.subset for issue in wrong_files(copy)] == ["manifest.json"] and b"right_hip" in text


def test_files_that_no_digest_speaks_of_are_named(copy):
    for path in ("preview/sheet.png", "README.md", "card/returns.png"):  # where commands write
        (copy / path).parent.mkdir(exist_ok=True)
        (copy / path).write_bytes(b"x")
    assert not wrong_files(copy)
    empty = "walker-walk/random.zarr/trajectories/terminated/c/0"  # which holds its fill value alone
    strange = {"notes.txt", "policies/other.safetensors", "walker-walk/stray", empty, f"manifests/{'0' * 64}.json"}
    for path in strange:
        (copy / path).parent.mkdir(exist_ok=True)
        (copy / path).write_bytes(b"stray")
    assert {(issue.subset, issue.check) for issue in wrong_files(copy)} == {(path, "files") for path in strange}
