"""Python is a door as good as the command line: every command of data is a function of the same name."""

from __future__ import annotations

import inspect

import click
import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.cli import COMMANDS, main
from dmcvb_gen.dataset.gate import Release
from tests.conftest import run

FUNCTIONS = ("rollout", "paint", "repaint", "regenerate", "verify", "publish", "fetch", "export", "validate")
FUNCTIONS += ("train_behaviour", "evaluate_behaviour")
COMMANDS_ALONE = {"as_json", "dry_run", "strict", "own", "list_settings"}
"""Options that say how something is printed, only print, begin and end a release of many machines, or belong to another
one."""


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_command_has_the_options_of_its_function(name):
    command = main.get_command(None, name.replace("_", "-"))
    parameters = dict(inspect.signature(getattr(dmcvb_gen, name)).parameters)
    assert command.name in COMMANDS and name in dmcvb_gen.__all__
    options = {parameter.name: parameter for parameter in command.params if parameter.name not in COMMANDS_ALONE}
    assert options.keys() == parameters.keys() - {"progress", "notify", "on_score"}
    words = []
    for option in options.values():
        assert option.required == (parameters[option.name].default is inspect.Parameter.empty)
        assert isinstance(option, click.Argument) or option.help.strip()
        if option.required:
            words += ["x"] if isinstance(option, click.Argument) else [option.opts[0], "x"]
    parsed = command.make_context(name, words).params
    for option in options.values():
        default = "x" if option.required else parameters[option.name].default
        assert parsed[option.name] == default or not (parsed[option.name] or default), option.name


def test_the_command_line_makes_the_same_bytes(tmp_path):
    words = "rollout walker-walk --level expert --distractor dynamic --episodes 1 --max-steps 5 --size 16 --out"
    run(*words.split(), tmp_path / "cli")
    given = dict(levels="expert", distractors="dynamic", episodes=1, max_steps=5, size=16, progress=False)
    made = dmcvb_gen.rollout("walker-walk", out=tmp_path / "python", **given)
    assert made.digest == Release.open(tmp_path / "cli").digest
    assert dmcvb_gen.rollout(out=tmp_path / "python", progress=False).digest == made.digest


def test_arguments_may_be_paths_numpys_numbers_and_iterators(tmp_path):
    few = dict(episodes=np.int64(1), max_steps=np.int32(2), size=np.uint8(16), progress=False)
    few |= dict(episode_range=[np.int64(0), np.uint8(1)])
    layout = tmp_path / "ring.txt"
    layout.write_text("*****\n*   *\n* * *\n*   *\n*****\n")
    made = dmcvb_gen.rollout(layout, levels=iter(["random"]), out=tmp_path / "maze", **few)
    assert list(made) == ["ant-maze-ring/random/visible"]
    made = dmcvb_gen.rollout(iter(["walker-walk"]), levels="random", out=tmp_path / "walker", **few)
    assert made["walker-walk/random/none"].record.size == 16
    rows = dmcvb_gen.evaluate_behaviour("walker-walk", levels=(level for level in ["random"]), episodes=2)
    assert [row["level"] for row in rows] == ["random"]
