"""A sound release passes; each kind of damage is found by the check that is meant for it."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import RenderingError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.verify import check_files, verify, verify_folder
from tests.conftest import rewrite, roll_out, small_recipe

NAME, MAZE = "walker-walk/random/dynamic", "ant-maze-tiny/random/visible"


@pytest.fixture
def copy(small_release, tmp_path):
    shutil.copytree(small_release, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.mark.parametrize(
    ("release", "counts"),
    [
        ("small_release", {"subsets": 3, "episodes": 9, "steps": 4500}),
        ("small_mazes", {"subsets": 3, "episodes": 6}),
    ],
)
def test_a_sound_release_passes(release, counts, request):
    folder = request.getfixturevalue(release)
    result = verify(folder)
    assert result.sound and result.complete and {**result.checked, **counts} == result.checked
    assert result.digest == sha256_file(folder / "manifest.json") and not result.compared
    done = CliRunner().invoke(main, ["verify", f"{folder}@sha256:{result.digest}"])
    assert done.exit_code == 0 and "All checks passed" in done.output and "not compared" not in done.output
    wrong = CliRunner().invoke(main, ["verify", f"{folder}@sha256:{'0' * 64}"])
    assert wrong.exit_code == 2 and f"is release {result.digest}, not 0000" in wrong.output


def swap_rewards(arrays):
    arrays["reward"][0, :500] = np.roll(arrays["reward"][0, :500], 7)  # the return stays the same


def swap_pixels(arrays):
    arrays["pixels"][1] = arrays["pixels"][0]


def spoil_state(arrays):
    arrays["state"][2, 123, 4] = np.nan


def inflate_return(arrays):
    arrays["return"][1] += 100


def duplicate(arrays):
    for name in ("state", "action", "reward", "physics", "return"):
        arrays[name][2] = arrays[name][0]


def repeat_actions(arrays):
    arrays["action"][2] = arrays["action"][0]


def wild_action(arrays):
    arrays["action"][1, 7, 0] = 1.5


def cut_length(arrays):
    arrays["length"][1] = 0


DAMAGE = {
    swap_rewards: {"rewards", 0},
    swap_pixels: {"pixels", 1},
    spoil_state: {"finite", 2, 123},
    inflate_return: {"returns", 1},
    duplicate: {"duplicates", 2},
    wild_action: {"actions", 1, 7},
    cut_length: {"lengths", 1},
}
"""What is done to the arrays -> the check that finds it, the episode, and the step where that is known."""


@pytest.mark.parametrize("change", DAMAGE, ids=lambda change: change.__name__)
def test_wrong_values_are_found_by_their_check(copy, change):
    rewrite(copy, NAME, change)
    found = verify_folder(copy, names=[NAME]).findings
    places = [{finding.check, finding.episode, finding.step} for finding in found]
    assert any(DAMAGE[change] <= place for place in places), found
    assert {finding.subset for finding in found} == {NAME}


def test_equal_actions_alone_are_no_duplicate(copy):
    rewrite(copy, NAME, repeat_actions)
    assert not any(finding.check == "duplicates" for finding in verify_folder(copy, names=[NAME]).findings)


def test_returns_of_longer_episodes_may_be_higher(tmp_path):
    pattern = {"tasks": "walker-walk", "levels": "expert", "settings": "none", "episodes": 1, "max_steps": 600}
    roll_out(small_recipe(subsets=[pattern], size=8, seed=4), tmp_path / "long")
    assert Release.open(tmp_path / "long")["walker-walk/expert/none"].returns.max() > 1000
    assert verify(tmp_path / "long").sound
    [policy] = (tmp_path / "long/policies").iterdir()
    policy.write_bytes(policy.read_bytes()[:-1] + b"x")
    [found] = check_files(tmp_path / "long")
    assert found.subset == f"policies/{policy.name}" and "does not have its digest" in found.message


def test_what_this_machine_cannot_check_is_not_called_damaged(copy, monkeypatch):
    def fail(*_, **__):
        raise RenderingError("no renderer here")

    monkeypatch.setattr("dmcvb_gen.release.contents.renderer_for", fail)
    result = CliRunner().invoke(main, ["verify", str(copy)])
    assert result.exit_code == 3 and "NOT CHECKED walker-walk" in result.output and "regenerate" not in result.output


def test_a_damaged_layer_is_named_with_its_cure_and_its_values_are_not_read(copy):
    path = next(copy.rglob("random.zarr/dynamic/pixels/c/*/0/0/0/0"))
    path.write_bytes(path.read_bytes()[:100])
    done = CliRunner().invoke(main, ["verify", str(copy), "--json"])
    facts = json.loads(done.output)
    assert done.exit_code == 1 and facts["checked"]["subsets"] == 2
    [finding] = facts["findings"]
    assert finding["subset"] == f"{NAME}/pixels" and "has 100 bytes instead of" in finding["message"]
    assert "`dmcvb-gen regenerate" in CliRunner().invoke(main, ["verify", str(copy)]).output


@pytest.mark.parametrize(("release", "name", "here"), [("small_release", NAME, 2), ("maze_release", MAZE, 1)])
def test_a_part_of_a_release_is_called_incomplete(release, name, here, request, tmp_path):
    source = request.getfixturevalue(release)
    fetch(f"file:{source}", tmp_path / "part", [name], (0, 1))
    result = CliRunner().invoke(main, ["verify", str(tmp_path / "part")])
    planned = Release.open(source)[name].record.episodes
    assert result.exit_code == 3 and f"{name}: {here} of {planned} episodes" in result.output, result.output
    assert "incomplete:" in result.output and "not compared" not in result.output
    others = [other for other in Release.open(source) if other != name]
    for other in others:
        with pytest.raises(StoreError, match="has no episode of it"):
            Release.open(tmp_path / "part")[other]


def test_files_that_no_digest_speaks_of_are_named(copy):
    for path in ("preview/sheet.png", "README.md", "card/returns.png"):  # where commands write
        (copy / path).parent.mkdir(exist_ok=True)
        (copy / path).write_bytes(b"x")
    assert not check_files(copy)
    strange = {"notes.txt", "policies/other.safetensors"}
    for path in strange:
        (copy / path).parent.mkdir(exist_ok=True)
        (copy / path).write_bytes(b"stray")
    assert {(issue.subset, issue.check) for issue in check_files(copy)} == {(path, "files") for path in strange}
