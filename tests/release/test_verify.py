"""A sound release passes; each kind of damage is found by the check that is meant for it."""

from __future__ import annotations

import hashlib
import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from dmcvb_gen.dataset.index import is_card

from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.writer import commit_path, finish_release
from dmcvb_gen.errors import RenderingError, StoreError
from dmcvb_gen.release.card import write_card
from dmcvb_gen.release.verify import check_files, verify
from tests.conftest import rewrite, roll_out, small_recipe

NAME = "walker-walk/random/dynamic"


@pytest.fixture
def copy(small_release, tmp_path):
    shutil.copytree(small_release, tmp_path / "copy")
    return tmp_path / "copy"


def test_the_cure_is_that_of_what_is_damaged(copy):
    write_card(copy)
    card = copy / "README.md"
    card.write_text(card.read_text() + "more")
    result = CliRunner().invoke(main, ["verify", str(copy)])
    assert result.exit_code == 1 and "FAIL files: README.md: has" in result.output, result.output
    assert "`dmcvb-gen card" in result.output and "regenerate" not in result.output
    write_card(copy)
    assert verify(copy).sound


def test_what_this_machine_cannot_check_is_not_called_damaged(copy, monkeypatch):
    def fail(*_, **__):
        raise RenderingError("no renderer here")

    monkeypatch.setattr("dmcvb_gen.release.contents.renderer_for", fail)
    result = CliRunner().invoke(main, ["verify", str(copy)])
    assert result.exit_code == 3 and "NOT CHECKED" in result.output and "regenerate" not in result.output


def checks(folder):
    return {(finding.check, finding.subset) for finding in verify(folder).findings}


def test_a_sound_release_passes(small_release):
    result = verify(small_release)
    assert result.sound and result.checked == {"subsets": 3, "episodes": 9, "steps": 4500}


def test_a_flipped_byte_is_found_by_its_digest(copy):
    file = next(file for file in open_release(copy)[NAME].commits[1].files if "/pixels/" in file.path)
    data = bytearray((copy / file.path).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / file.path).write_bytes(data)
    [finding] = verify(copy).findings
    assert finding.check == "files" and "pixels" in finding.message and "shard 1" in finding.message


@pytest.fixture(scope="module")
def policy_release(tmp_path_factory):
    """A release with a policy file and a card."""
    folder = tmp_path_factory.mktemp("policies") / "release"
    pattern = {"tasks": "walker-walk", "levels": "expert", "settings": "none", "episodes": 1}
    roll_out(small_recipe(name="policies", subsets=[pattern]), folder)
    write_card(folder)
    return folder


@pytest.mark.parametrize("which", ["walker", "maze"])
def test_a_flipped_byte_in_any_file_is_found_and_named(policy_release, maze_release, which):
    folder = policy_release if which == "walker" else maze_release
    assert not list(check_files(folder))
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stat().st_size]
    names = {path.relative_to(folder).as_posix() for path in files}
    assert {"manifest.json", "files.json"} <= names and any(name.endswith("/zarr.json") for name in names)
    assert which == "maze" or any(name.startswith("policies/") for name in names)
    for path in files:
        data = path.read_bytes()
        for place in {0, len(data) // 2, len(data) - 1}:
            changed = bytearray(data)
            changed[place] ^= 1
            path.write_bytes(changed)
            found = [str(finding) for finding in check_files(folder)]
            path.write_bytes(data)
            name = path.relative_to(folder).as_posix()
            assert found and any(name in text for text in found), (name, place, found)
    assert not list(check_files(folder))


def test_the_root_digest_is_printed_and_covers_all_but_card_and_machine(policy_release, tmp_path):
    digest = open_release(policy_release).manifest.digest
    lines = []
    for path in sorted(policy_release.rglob("*"), key=lambda path: path.relative_to(policy_release).as_posix()):
        name = path.relative_to(policy_release).as_posix()
        if path.is_file() and path.name not in (".created", ".lock", "files.json") and not is_card(name):
            if name.startswith("commits/"):
                continue
            data = path.read_bytes()
            if name == "manifest.json":
                bare = json.loads(data) | {"digest": None, "environments": []}
                data = (json.dumps(bare, indent=1) + "\n").encode()
            lines.append(f"{hashlib.sha256(data).hexdigest()}  {name}\n")
    assert hashlib.sha256("".join(lines).encode()).hexdigest() == digest
    for command in ("verify", "info"):
        assert digest in CliRunner().invoke(main, [command, str(policy_release)]).output
    assert digest in (policy_release / "README.md").read_text()


def test_a_part_of_a_release_is_called_incomplete(copy, maze_release, tmp_path):
    for shard in (0, 1):
        (copy / commit_path(NAME, shard)).unlink()
    finish_release(copy, open_release(copy).manifest)
    result = CliRunner().invoke(main, ["verify", str(copy)])
    assert result.exit_code == 3 and f"{NAME}: 0 of 3 episodes" in result.output
    assert "incomplete: 6 of 9 episodes" in result.output
    with pytest.raises(StoreError, match="none of its episodes are here"):
        open_release(copy)[NAME]
    shutil.copytree(maze_release, tmp_path / "maze")
    (tmp_path / "maze" / commit_path("ant-maze-tiny/random/visible", 1)).unlink()
    finish_release(tmp_path / "maze", open_release(tmp_path / "maze").manifest)
    found = verify(tmp_path / "maze")
    assert found.sound and found.incomplete == {"ant-maze-tiny/random/visible": (1, 2)}


def test_a_truncated_shard_is_found(copy):
    file = next(file for file in open_release(copy)[NAME].commits[0].files if "/state/" in file.path)
    (copy / file.path).write_bytes((copy / file.path).read_bytes()[:100])
    assert ("files", NAME) in checks(copy)


def test_a_swapped_reward_is_found_by_simulating_again(copy):
    def swap(group):
        rewards = group["reward"][0]
        rewards[:500] = np.roll(rewards[:500], 7)  # the return stays the same
        group["reward"][0] = rewards

    rewrite(copy, NAME, swap)
    found = verify(copy).findings
    assert {finding.check for finding in found} <= {"rewards", "returns"} and any(f.check == "rewards" for f in found)
    assert all(finding.episode == 0 and finding.subset == NAME for finding in found)


def test_pixels_of_another_episode_are_found_by_painting_again(copy):
    def swap(group):
        group["pixels"][1] = group["pixels"][0]

    rewrite(copy, NAME, swap)
    found = verify(copy).findings
    assert {finding.check for finding in found} == {"pixels"} and {finding.episode for finding in found} == {1}


def test_a_nan_state_is_found_with_its_step(copy):
    def spoil(group):
        state = group["state"][2]
        state[123, 4] = np.nan
        group["state"][2] = state

    rewrite(copy, NAME, spoil)
    found = [finding for finding in verify(copy).findings if finding.check == "finite"]
    assert [(finding.episode, finding.step) for finding in found] == [(2, 123)]


def test_returns_of_longer_episodes_may_be_higher(tmp_path):
    pattern = {"tasks": "walker-walk", "levels": "expert", "settings": "none", "episodes": 1, "max_steps": 600}
    roll_out(small_recipe(subsets=[pattern], size=8, seed=4), tmp_path / "long")
    assert open_release(tmp_path / "long")["walker-walk/expert/none"].returns.max() > 1000
    assert verify(tmp_path / "long").sound


def test_a_return_that_does_not_match_is_found(copy):
    def inflate(group):
        returns = group["return"][:]
        returns[1] += 100
        group["return"][:] = returns

    rewrite(copy, NAME, inflate)
    assert checks(copy) == {("returns", NAME)}


def test_a_duplicated_episode_is_found(copy):
    def duplicate(group):
        for name in ("state", "action", "reward", "physics", "return"):
            group[name][2] = group[name][0]

    rewrite(copy, NAME, duplicate)
    assert ("duplicates", NAME) in checks(copy)


def test_a_missing_shard_of_a_complete_release_is_found(copy):
    (copy / commit_path(NAME, 1)).unlink()
    assert ("files", NAME) in checks(copy)


def test_a_manifest_that_names_another_digest_is_found(copy):
    data = json.loads((copy / "manifest.json").read_text())
    data["subsets"][0]["digest"] = "0" * 64
    (copy / "manifest.json").write_text(json.dumps(data))
    assert {check for check, _ in checks(copy)} == {"files"}


def test_files_that_no_digest_speaks_of_are_named(copy):
    (copy / "preview").mkdir()
    (copy / "preview" / "sheet.png").write_bytes(b"")  # where `preview` writes
    assert verify(copy).sound
    extra = {f"{NAME}.zarr/pixels/c/9/0/0/0/0": NAME, "policies/other.safetensors": "policies/other.safetensors"}
    for path in extra:
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        (copy / path).write_bytes(b"stray")
    found = verify(copy).findings
    assert {(finding.check, finding.subset) for finding in found} == {("files", place) for place in extra.values()}
    assert all("not part of the release" in finding.message for finding in found)


def test_equal_actions_alone_are_no_duplicate(copy):
    def repeat(group):
        group["action"][2] = group["action"][0]

    rewrite(copy, NAME, repeat)
    assert ("duplicates", NAME) not in checks(copy)
