"""The command line: what it prints, what it keeps when it is stopped, and what it says unasked."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys

import numpy as np
import pytest
from PIL import Image

from dmcvb_gen.cli import main
from dmcvb_gen.cli.common import INTERRUPTED
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import load_policy, save_policy
from dmcvb_gen.training.settings import ALGORITHMS, settings_class
from tests.conftest import invoke, python, told
from tests.distractors.test_backgrounds import write_video

SMALL = ["rollout", "walker-walk", "--size", "16"]
TINY = [*SMALL, "--max-steps", "4", "--episodes", "2"]


def said(*words, code=0):
    return invoke(*words, code=code).output


@pytest.mark.slow
def test_rollout_info_preview_verify_one_after_the_other(tmp_path):
    out = tmp_path / "demo"
    asked = [*SMALL, "--episodes", "1", "--level", "expert", "--distractor", "dynamic", "--out", out]
    facts = told(*asked)
    assert facts["complete"] and facts["steps"] == 500
    [subset] = told("info", out)["subsets"]
    assert subset["name"] == "walker-walk/expert/dynamic" and subset["paper"]["mean"] == 957.8
    assert subset["returns"]["mean"] == pytest.approx(float(Release.open(out)["walker-walk/expert/dynamic"].returns[0]))
    assert "DMC-VB paper" in said("info", out) and "*" not in said("info", out)
    sheet, video = map(Image.open, told("preview", out, "--episodes", "1"))
    assert sheet.size[0] == 10 * 16 * 2 and video.n_frames == 200 and min(video.size) >= 512
    assert told("verify", out)["sound"]
    again = told(*asked)
    assert again["steps"] == 0 and again["digest"] == facts["digest"]


def test_dry_run_shows_the_plan_and_writes_nothing(tmp_path):
    asked = [*TINY, "--level", "random", "--out", tmp_path / "x"]
    assert "1 shard to make" in said(*asked, "--dry-run") and not (tmp_path / "x").exists()
    facts = told(*asked, "--dry-run")
    assert facts["frames"] == 2 * 5 and facts["shards"] == 1 and facts["raw_bytes"] > 2 * 5 * 16 * 16 * 3
    said(*asked)
    [row] = [line for line in said(*asked, "--dry-run").splitlines() if line.startswith("walker-walk/random")]
    assert row.split()[1:4] == ["2", "0", "0"]


def test_list_says_what_is_here():
    facts = told("list")
    walker = next(task for task in facts["tasks"] if task["id"] == "walker-walk")
    assert walker["behaviours"] == ["expert", "medium", "mixed"] and facts["renderers"]["native"] is None


@pytest.mark.slow
def test_mixed_takes_its_policies_in_turn(tmp_path):
    said("rollout", "walker-walk", "--level", "mixed", "--episodes", "9", "--size", "8", "--out", tmp_path / "m")
    subset = Release.open(tmp_path / "m")["walker-walk/mixed/none"]
    assert list(subset.read("behaviour")) == [0, 1, 2, 3, 4, 5, 6, 7, 0]
    assert subset.returns[7] > subset.returns[0] + 100
    assert [policy.name for policy in subset.record.policies] == [f"mixed_{k}" for k in range(8)]


def test_a_missing_gl_library_names_the_cure(monkeypatch, tmp_path):
    from dmcvb_gen.rendering import opengl

    opengl._started.cache_clear()
    monkeypatch.setattr(opengl.ctypes.util, "find_library", lambda name: None)
    assert "libegl1" in said(*TINY, "--renderer", "opengl", "--out", tmp_path / "x", code=2)
    opengl._started.cache_clear()


# -- stopped --------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["info", "fetch"])
def test_a_stop_that_foreign_code_turns_into_its_own_error_is_no_traceback(monkeypatch, command, number):
    def foreign(context):
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt:
            raise ValueError("argument 1: KeyboardInterrupt") from None  # as ctypes does

    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # a command that is stopped silences it
    monkeypatch.setattr(main.get_command(None, command), "invoke", foreign)
    monkeypatch.setattr(main.get_command(None, command), "params", [])
    words = said(command, code=INTERRUPTED)
    assert "Interrupted." in words and ("rerun the same command to go on" in words) == (command == "fetch")


HALF_BEGUN = """
import asyncio, os, signal
from dmcvb_gen.cli import main
from dmcvb_gen.release import verify

async def never(): ...

def interrupted(*_, **__):
    loop, coroutine = asyncio.BaseEventLoop.__new__(asyncio.SelectorEventLoop), never()
    os.kill(os.getpid(), signal.SIGINT)

verify.verify_folder = interrupted
main(["verify", "."])
"""


def test_nothing_that_was_half_begun_prints_a_traceback_when_a_command_is_stopped():
    ended = python(HALF_BEGUN, code=INTERRUPTED)
    assert (ended.stdout, ended.stderr.strip()) == ("", "Interrupted.")


LOST = """
import os, signal, time
from dmcvb_gen.cli import look, main

class Last:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

def work(**options):
    Last()
    for _ in range(500):
        time.sleep(0.02)

look.list_command.callback = work
main(["list"])
"""


def test_ctrl_c_that_a_destructor_swallows_still_ends_the_command():
    assert python(LOST, code=130).stderr.strip() == "Interrupted."


# -- what silence would cost ----------------------------------------------------------------------


def test_a_level_has_one_behaviour_in_a_release(tmp_path):
    expert = [*TINY, "--level", "expert", "--out", tmp_path / "a"]
    said(*expert)
    medium, other = bundled_policies("walker-walk", "medium")[0], tmp_path / "other.safetensors"
    assert "is a policy of level medium, not expert" in said(*expert, "--behaviour", medium, code=2)
    policy = load_policy(medium)
    save_policy(other, policy.header.model_copy(update={"level": None}), policy.weights)
    refused = said(*expert, "--distractor", "static", "--behaviour", other, code=2)
    assert "walker-walk/expert/trajectories has policies" in refused and "choose another --out" in refused
    assert "DMC-VB paper" not in said("info", tmp_path / "a")  # whose episodes are longer


def test_a_release_without_images_says_how_to_get_them(tmp_path):
    for name, words in (("light", ["--no-pixels"]), ("painted", [])):
        said(*TINY, "--level", "random", *words, "--out", tmp_path / name)
    cure = f"dmcvb-gen paint {tmp_path / 'light'}"
    assert f"No images are stored; add them: {cure}" in said("info", tmp_path / "light")
    assert "No images" not in said("info", tmp_path / "painted") and cure in said("preview", tmp_path / "light", code=2)


@pytest.mark.parametrize("count", [1, 3])
def test_videos_that_are_kept_for_evaluation_are_counted(tmp_path, count):
    for index in range(count):
        write_video(tmp_path / "videos" / f"{index}.gif", np.full((3, 32, 32, 3), 60 * index, np.uint8))
    words = ["--level", "random", "--distractor", "dynamic", "--backgrounds", tmp_path / "videos"]
    note = said(*TINY, *words, "--out", tmp_path / "out")
    assert ("2 of 3 videos" in note and "--split val" in note) == (count == 3)


@pytest.mark.slow
def test_a_selection_that_picks_nothing_says_why_wherever_one_looks(tmp_path):
    settings = [f"--set={pair}" for pair in ("warmup_steps=100", "compile=false", "batch_size=16")]
    folder = tmp_path / "run"
    said("train-behaviour", "cheetah-run", "--steps", 120, "--evaluate-every", 120, *settings, "--out", folder)
    assert told("select-checkpoints", folder, "--episodes", 2, code=1)["convergence"]["error"] is None
    shown = said("select-checkpoints", folder, "--episodes", 2, code=1)
    assert "nan" not in shown and f"{folder}/selected" not in shown and "selection.json" in shown
    for words in (["evaluate-behaviour", "cheetah-run"], ["rollout", "cheetah-run", "--level", "expert"]):
        refused = said(*words, "--behaviour", folder, code=2)
        assert "at least 2 are needed" in refused and "select-checkpoints" not in refused


@pytest.mark.slow
def test_checks_alone_name_no_profile_and_only_leaves_nothing_to_miss(small_release, tmp_path):
    only = ["--only", "walker-walk/random/none", "--out", tmp_path / "v"]
    assert "not in the release" not in said("validate", small_release, "--checks-only", *only)
    text = (tmp_path / "v" / "report.html").read_text()
    assert "smoke" not in text and "no agent was trained" in text


@pytest.mark.parametrize("algorithm", [*ALGORITHMS, "sb3:PPO", "sb3:TQC"])
def test_every_setting_of_an_algorithm_has_a_meaning(algorithm):
    found = told("train-behaviour", "walker-walk", "--algo", algorithm, "--list-settings")
    assert list(found) == [field.name for field in dataclasses.fields(settings_class(algorithm))]
    assert all(setting["meaning"].endswith(".") and setting["meaning"][0].isupper() for setting in found.values())


def test_listed_values_are_the_tasks_and_those_given(tmp_path):
    walker = told("train-behaviour", "walker-walk", "--list-settings")
    maze = told("train-behaviour", "ant-maze-empty7x7", "--list-settings", "--set", "critics=3")
    assert (walker["learning_rate"]["value"], walker["simulations"]["value"]) == (0.001, 8)
    assert (maze["simulations"]["value"], maze["critics"]["value"]) == (16, 3)
    (tmp_path / "ring.txt").write_text("****\n*  *\n****\n")  # a maze of one's own is learned by `guided`
    assert "half_life=12500" in said("train-behaviour", tmp_path / "ring.txt", "--list-settings")
