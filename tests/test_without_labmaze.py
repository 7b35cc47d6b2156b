"""Where labmaze has no wheel (Python 3.13), mazes are refused in one line and everything else works."""

from __future__ import annotations

import subprocess
import sys

import pytest

BLOCKED = (
    "import sys; sys.modules['labmaze'] = None;"
    "from dmcvb_gen.cli import main; main(sys.argv[1:], prog_name='dmcvb-gen')"
)


def run(*arguments):
    return subprocess.run([sys.executable, "-c", BLOCKED, *map(str, arguments)], capture_output=True, text=True)


@pytest.mark.slow
def test_mazes_are_refused_in_one_line_and_the_walker_walks(tmp_path):
    short = ["--level", "random", "--episodes", 1, "--max-steps", 3, "--size", 8]
    refused = run("rollout", "ant-maze-empty7x7", *short, "--out", tmp_path / "maze")
    assert refused.returncode == 2, refused.stderr
    [line] = [line for line in refused.stderr.splitlines() if "error" in line]
    assert "labmaze" in line and "3.11 and 3.12" in line and "Traceback" not in refused.stderr
    made = run("rollout", "walker-walk", *short, "--distractor", "dynamic", "--out", tmp_path / "walker")
    assert made.returncode == 0, made.stderr
    assert run("list").returncode == 0 and run("verify", tmp_path / "walker").returncode == 0
