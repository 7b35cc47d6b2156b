"""What people see in a terminal of 80 columns, in a pipe, and in --help."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import COMMANDS, main

PARTS = ("begin", "part", "finish")


def screen(arguments, columns=80):
    """The lines that a command prints on a terminal of some columns."""
    run = CliRunner(env={"COLUMNS": str(columns), "NO_COLOR": "1"}).invoke(main, list(map(str, arguments)))
    assert run.exit_code == 0, run.output
    assert "\x1b" not in run.stdout, "colors, although NO_COLOR is set"
    return run.stdout.splitlines()


@pytest.mark.slow
def test_tables_fit_80_columns_and_cut_no_word(small_release, small_mazes, tmp_path):
    evaluate = ["evaluate-behaviour", "walker-walk", "ant-maze-medium7x7a", "--level", "random", "--episodes", 2]
    plan = ("--level", "random", "--episodes", 1, "--max-steps", 4, "--size", 16, "--dry-run", "--out", tmp_path / "r")
    words = {
        ("list",): ["ant-maze-medium7x7a", "bundled behaviours", "dmcvb-mini"],
        ("info", small_release): ["walker-walk/random/dynamic", "episodes", "mean"],
        ("info", small_mazes): ["ant-maze-tiny/random/visible", "episodes", "mean"],
        tuple(evaluate): ["ant-maze-medium7x7a", "success", "to goal m/s", "DMC-VB paper"],
        ("rollout", "walker-walk", "--distractor", "static", *plan): ["walker-walk/random/", "to make"],
        ("rollout", "ant-maze-medium7x7a", *plan): ["ant-maze-medium7x7a/random/", "to make"],
    }
    for arguments, expected in words.items():
        lines = screen(arguments)
        wide = [line for line in lines if len(line) > 80 and str(tmp_path) not in line]
        assert not wide, (arguments, wide)
        for word in expected:
            assert any(word in line for line in lines), (arguments, word, lines)


def test_a_group_without_a_command_prints_its_help():
    said = CliRunner().invoke(main, ["cluster"])
    assert said.exit_code == 2 and said.output.startswith("Usage: ") and "finish  Write the manifest" in said.output


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS), *(["cluster", name] for name in PARTS)])
def test_help_fits_80_columns_and_has_an_example(command):
    lines = screen([*command, "--help"])
    assert not [line for line in lines if len(line) > 80]
    if not command:
        assert all(f"  {name} " in "\n".join(lines) for name in COMMANDS)
    if command == ["rollout"]:
        assert "  --recipe FILE|NAME " in "\n".join(lines)
    if len(command) == 1 and command != ["list"]:
        assert any(line.strip().startswith(f"dmcvb-gen {command[0]}") for line in lines)
