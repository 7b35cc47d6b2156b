"""train-behaviour --list-settings."""

from __future__ import annotations

import dataclasses
import json

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.training.settings import ALGORITHMS, settings_class


def ask(*words: str):
    return CliRunner().invoke(main, ["train-behaviour", *words, "--list-settings"])


@pytest.mark.parametrize("algorithm", [*ALGORITHMS, "sb3:SAC", "sb3:PPO", "sb3:TQC"])
@pytest.mark.parametrize("task", ["walker-walk", "humanoid-walk", "ant-maze-empty7x7"])
def test_every_setting_of_every_algorithm_has_a_meaning(algorithm, task):
    found = json.loads(ask(task, "--algo", algorithm, "--json").stdout)
    assert list(found) == [field.name for field in dataclasses.fields(settings_class(algorithm))]
    for name, setting in found.items():
        assert setting["meaning"].endswith("."), name
        assert setting["meaning"][0].isupper(), name


def test_values_are_the_tasks_and_those_given():
    walker = json.loads(ask("walker-walk", "--json").stdout)
    maze = json.loads(ask("ant-maze-empty7x7", "--json", "--set", "critics=3").stdout)
    assert (walker["learning_rate"]["value"], walker["simulations"]["value"]) == (0.001, 8)
    assert (maze["simulations"]["value"], maze["critics"]["value"]) == (16, 3)
    assert "simulations=16" in ask("ant-maze-empty7x7").stdout


def test_a_maze_of_ones_own_is_learned_by_guided(tmp_path):
    (tmp_path / "ring.txt").write_text("****\n*  *\n****\n")
    assert "half_life=12500" in ask("--layout", str(tmp_path / "ring.txt")).stdout
