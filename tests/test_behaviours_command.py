"""The command in a policy's header trains that run again."""

from __future__ import annotations

import shlex

import click
import pytest

from dmcvb_gen.behaviours.defaults import parse_settings
from dmcvb_gen.behaviours.training import RunConfig, command_of
from dmcvb_gen.cli.behaviours import train_behaviour


@pytest.mark.parametrize("init_from", [None, "runs/my stand run"])
def test_the_command_of_a_run_parses_back_to_its_configuration(init_from):
    settings = {"learning_rate": 0.0005, "critic_hidden": [256, 256], "compile": False}
    config = RunConfig("humanoid-walk", "sac", 1000, 3, settings, evaluate_every=700, init_from=init_from)
    words = shlex.split(command_of(config))
    assert words[:2] == ["dmcvb-gen", "train-behaviour"]
    with click.Context(train_behaviour) as context:
        train_behaviour.parse_args(context, words[2:])
    given = context.params
    assert (given["task"], given["algo"], given["steps"], given["seed"]) == ("humanoid-walk", "sac", 1000, 3)
    assert (given["evaluate_every"], given["init_from"]) == (700, init_from)
    assert parse_settings(given["pairs"], None, "sac") == settings
