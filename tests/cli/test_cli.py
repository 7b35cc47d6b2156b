"""The command line: what it prints, and how it says no."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
from click.testing import CliRunner
from PIL import Image

from dmcvb_gen.cli import RESUMING, main
from dmcvb_gen.cli.common import INTERRUPTED
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import load_policy, save_policy

SMALL = ["rollout", "walker-walk", "--episodes", "1", "--size", "16"]


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.mark.slow
def test_rollout_info_preview_verify_one_after_the_other(tmp_path):
    out = tmp_path / "demo"
    made = run(*SMALL, "--level", "expert", "--distractor", "dynamic", "--out", out, "--json")
    assert made.exit_code == 0, made.output
    facts = json.loads(made.output)
    assert facts["complete"] and facts["steps"] == 500
    info = json.loads(run("info", out, "--json").output)
    [subset] = info["subsets"]
    assert subset["name"] == "walker-walk/expert/dynamic" and subset["paper"]["mean"] == 957.8
    assert subset["returns"]["mean"] == pytest.approx(float(Release.open(out)["walker-walk/expert/dynamic"].returns[0]))
    assert "DMC-VB paper" in run("info", out).output
    files = json.loads(run("preview", out, "--episodes", "1", "--json").output)
    assert Image.open(files[0]).size[0] == 10 * 16 * 2
    assert (tmp_path / "demo/preview/preview.mp4").stat().st_size > 1000
    asked = ["--video", "webp", "--frames", "12", "--scale", "1", "--out", tmp_path / "webp"]
    assert run("preview", out, *asked).exit_code == 0
    moving = Image.open(tmp_path / "webp/preview.webp")
    assert moving.n_frames == 12 and moving.size == (16, 16 + 14)
    verified = run("verify", out, "--json")
    assert verified.exit_code == 0 and json.loads(verified.output)["sound"]
    again = json.loads(run(*SMALL, "--level", "expert", "--distractor", "dynamic", "--out", out, "--json").output)
    assert again["steps"] == 0 and again["digest"] == facts["digest"]


def test_the_same_command_with_other_options_is_refused(tmp_path):
    assert run(*SMALL, "--out", tmp_path / "demo").exit_code == 0
    result = run(*SMALL, "--seed", "1", "--out", tmp_path / "demo")
    assert result.exit_code == 2 and "seed 0, asked for 1" in result.output


def test_dry_run_shows_the_plan_and_writes_nothing(tmp_path):
    result = run(*SMALL, "--distractor", "none", "--out", tmp_path / "x", "--dry-run")
    assert result.exit_code == 0 and "1 shard to make" in result.output and not (tmp_path / "x").exists()
    facts = json.loads(run(*SMALL, "--out", tmp_path / "x", "--dry-run", "--json").output)
    assert facts["frames"] == 501 and facts["shards"] == 1 and facts["raw_bytes"] > 501 * 16 * 16 * 3


def test_a_dry_run_of_a_release_that_is_there_says_so(tmp_path):
    made = [*SMALL, "--max-steps", "3", "--out", tmp_path / "x"]
    assert run(*made).exit_code == 0
    [row] = [line for line in run(*made, "--dry-run").output.splitlines() if line.startswith("walker-walk/expert")]
    assert row.split()[1:4] == ["1", "0", "0"]


def test_list_says_what_is_here():
    facts = json.loads(run("list", "--json").output)
    walker = next(task for task in facts["tasks"] if task["id"] == "walker-walk")
    assert walker["behaviours"] == ["expert", "medium", "mixed"] and facts["renderers"]["native"] is None
    assert "walker-walk" in run("list").output


@pytest.mark.slow
def test_mixed_takes_its_policies_in_turn(tmp_path):
    asked = ["--level", "mixed", "--episodes", "9", "--size", "8"]
    result = run("rollout", "walker-walk", *asked, "--out", tmp_path / "m")
    assert result.exit_code == 0, result.output
    subset = Release.open(tmp_path / "m")["walker-walk/mixed/none"]
    assert list(subset.read("behaviour")) == [0, 1, 2, 3, 4, 5, 6, 7, 0]
    assert subset.returns[7] > subset.returns[0] + 100
    assert [policy.name for policy in subset.record.policies] == [f"mixed_{k}" for k in range(8)]


def broken_policy(tmp_path, kind):
    source = bundled_policies("walker-walk", "expert")[0]
    path = tmp_path / "policy.safetensors"
    if kind == "truncated":
        path.write_bytes(source.read_bytes()[:5000])
    elif kind == "nan":
        policy = load_policy(source)
        weights = {name: value.copy() for name, value in policy.weights.items()}
        weights["mean.weight"][0, 0] = float("nan")
        save_policy(path, policy.header, weights)
    else:
        path.write_bytes(source.read_bytes())
    return path


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["rollout", "walker-fly"], "walker-walk"),
        (["rollout", "walker-walk", "--level", "master"], "expert"),
        (["rollout", "walker-walk", "--distractor", "fog"], "dynamic"),
        (["rollout", "walker-walk", "--size", "0"], "8 to 1024"),
        (["rollout", "walker-walk", "--renderer", "povray"], "opengl"),
        (["rollout", "walker-walk", "--distractor", "static", "--backgrounds", "EMPTY"], "holds no videos"),
        (["rollout", "walker-walk", "--distractor", "static", "--backgrounds", "BROKEN"], "bad.mp4"),
        (["rollout", "walker-walk", "--level", "expert", "--behaviour", "TRUNCATED"], "not a whole policy file"),
        (["rollout", "walker-walk", "--level", "expert", "--behaviour", "NAN"], "not finite"),
        (["rollout", "cheetah-run", "--level", "expert", "--behaviour", "WALKER"], "not for cheetah-run"),
        (["rollout", "walker-walk", "--goal", "hidden"], "--goal is for mazes"),
        (["rollout", "ant-maze-empty7x7", "--goal", "fixed0x"], "unknown goal"),
        (["rollout", "--recipe", "no-such-recipe"], "dmcvb-mini"),
        (["rollout"], "TASK"),
        (["rollout", "walker-walk", "--range", "5:2"], "A < B"),
        (["info", "EMPTY"], "holds no release"),
        (["--fast"], "`dmcvb-gen --help` lists the options"),
        (["rollout", "--zzz"], "`dmcvb-gen rollout --help` lists the options"),
        (["info"], "see `dmcvb-gen info --help`"),
        (["diff", "a", "b", "c"], "see `dmcvb-gen diff --help`"),
        (["rollout", "walker-walk", "--seed"], "--seed"),
    ],
)
def test_bad_input_ends_with_2_one_line_and_nothing_written(tmp_path, arguments, words):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "bad.mp4").write_bytes(b"nothing like a video" * 20)
    places = {"EMPTY": tmp_path / "empty", "BROKEN": tmp_path / "bad"}
    for name, kind in (("TRUNCATED", "truncated"), ("NAN", "nan"), ("WALKER", "whole")):
        if name in arguments:
            places[name] = broken_policy(tmp_path, kind)
    arguments = [places.get(argument, argument) for argument in arguments]
    if arguments[0] == "rollout":
        arguments += ["--out", tmp_path / "out"]
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert words in result.output and "Traceback" not in result.output and not (tmp_path / "out").exists()
    assert result.output.startswith("error:") and result.output.count("\n") == 1


def test_an_out_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("x")
    result = run(*SMALL, "--out", tmp_path / "file" / "release")
    assert result.exit_code == 2 and "choose another place" in result.output


def test_a_missing_gl_library_names_the_cure(monkeypatch, tmp_path):
    from dmcvb_gen.rendering import opengl

    opengl._started.cache_clear()
    monkeypatch.setattr(opengl.ctypes.util, "find_library", lambda name: None)
    result = run(*SMALL, "--renderer", "opengl", "--out", tmp_path / "x")
    opengl._started.cache_clear()
    assert result.exit_code == 2 and "libegl1" in result.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_that_foreign_code_turns_into_its_own_error_is_no_traceback(tmp_path, monkeypatch, number):
    def foreign(*_):
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt:
            raise ValueError("argument 1: KeyboardInterrupt") from None  # as ctypes does

    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # a command that is stopped silences it
    monkeypatch.setattr("dmcvb_gen.generate.info.describe_release", foreign)
    result = run("info", tmp_path)
    assert result.exit_code == INTERRUPTED and isinstance(result.exception, SystemExit)
    assert "Interrupted" in result.output


@pytest.mark.parametrize("foreign", [True, False])
@pytest.mark.parametrize("command", sorted(RESUMING - {"cluster"}))
def test_a_command_that_resumes_says_so_when_it_is_stopped(monkeypatch, command, foreign):
    def stopped(context):
        if not foreign:
            raise KeyboardInterrupt
        os.kill(os.getpid(), signal.SIGINT)

    def turned_into_an_error(context):
        try:
            stopped(context)
        except KeyboardInterrupt:
            raise ValueError("argument 1: KeyboardInterrupt") from None

    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr(main.get_command(None, command), "invoke", turned_into_an_error if foreign else stopped)
    monkeypatch.setattr(main.get_command(None, command), "params", [])
    result = run(command)
    assert result.exit_code == INTERRUPTED and "rerun the same command to go on" in result.output
    assert "Aborted" not in result.output


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
    ended = subprocess.run([sys.executable, "-c", HALF_BEGUN], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr.strip()) == (INTERRUPTED, "", "Interrupted.")


PROCESSES = """
import sys
started = []
sys.addaudithook(lambda event, facts: event == "subprocess.Popen" and started.append(str(facts[1])))
from dmcvb_gen.cli import main
try:
    main(["rollout", "walker-walk", "--episodes", "1", "--max-steps", "2", "--out", sys.argv[1]])
finally:
    print(sum("glfw" in words for words in started), "glfw" in sys.modules, file=sys.stderr)
"""


@pytest.mark.slow
def test_glfw_looks_for_its_library_without_a_process_that_ctrl_c_would_make_print(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYGLFW_LIBRARY")}
    command = [sys.executable, "-c", PROCESSES, str(tmp_path / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.split()[-2:] == ["0", "True"]
