"""A maze of one's own: docs/mazes.md takes a sketch to a verified release, and bad sketches are one line."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.training import selection

HALL = "****\n*  *\n****\n"
SHORT = "--steps 448 --evaluate-every 64 --set ramp=200 --set simulations=16 --set width=64"
"""Enough to find the goal in a hall of two cells now and then."""


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def documented_commands() -> list[list[str]]:
    """The commands of docs/mazes.md that make a release of ring.txt."""
    page = (Path(__file__).parents[2] / "docs" / "mazes.md").read_text()
    block = next(
        code for code in re.findall(r"```text\n(.*?)```", page, re.DOTALL) if "train-behaviour --layout" in code
    )
    return [shlex.split(line)[1:] for line in block.splitlines()]


@pytest.fixture
def quick_selection(monkeypatch):
    """Convergence, medium to a tenth and 100 episodes a checkpoint take minutes; the commands' way is the same."""
    select = selection.select_checkpoints
    monkeypatch.setattr(selection, "converge", lambda *curve: selection.Convergence(-80.0, 0.0, True))
    monkeypatch.setattr(selection, "select_checkpoints", lambda folder, progress: select(folder, 5, progress=progress))
    monkeypatch.setattr(selection, "MEDIUM_TOLERANCE", 0.6)


@pytest.mark.full
def test_the_documented_commands_take_a_sketch_to_a_verified_release(in_folder, quick_selection):
    (in_folder / "ring.txt").write_text(HALL)
    commands = documented_commands()
    assert len(commands) <= 6
    for command in commands:
        short = {"train-behaviour": SHORT, "rollout": "--size 16 --max-steps 50"}.get(command[0], "").split()
        done = CliRunner().invoke(main, [*command, *short])
        assert done.exit_code == 0, (command, done.output)
        assert "***" not in done.output  # messages have the maze's name, not its rows
    release = dmcvb_gen.open(str(in_folder / "ring"))
    assert sorted(name.split("/")[1] for name in release) == ["expert", "medium"]
    assert [release[name].array("length").shape for name in release] == [(20,), (20,)]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("*****\n* * *\n*****\n", "floor that cannot be reached"),
        ("\n".join(["*" * 18, *["*" + " " * 16 + "*"] * 16, "*" * 18]), "18 x 18 cells.* 15 x 15"),
        ("****\n*   \n****\n", "hole in its outer wall"),
    ],
)
def test_a_maze_that_cannot_be_learned_is_one_line(in_folder, rows, message):
    (in_folder / "bad.txt").write_text(rows)
    done = CliRunner().invoke(main, ["train-behaviour", "--layout", "bad.txt"])
    assert done.exit_code == 2 and re.search(message, done.output) and done.output.count("\n") == 1
    assert not os.path.exists("runs")


def test_a_task_and_a_layout_are_one_too_many(in_folder):
    (in_folder / "hall.txt").write_text(HALL)
    for arguments in ([], ["walker-walk", "--layout", "hall.txt"]):
        done = CliRunner().invoke(main, ["train-behaviour", *arguments])
        assert done.exit_code == 2 and "give a TASK, or the file of a maze with --layout" in done.output
