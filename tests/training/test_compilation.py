"""A training runs uncompiled, and says so in one line, if torch.compile cannot work."""

import logging
import os
from unittest.mock import Mock

import pytest
import torch
from torch._dynamo.exc import BackendCompilerFailed

from dmcvb_gen import compilation
from dmcvb_gen.compilation import compiled, compiler
from tests.conftest import MAIN, python

LINE = "Training runs without torch.compile, which is slower"
SMALL = [f"--set={pair}" for pair in ("warmup_steps=8", "simulations=4", "batch_size=8", "critic_hidden=[8]")]


@pytest.fixture(autouse=True)
def told_anew():
    compilation._tell.cache_clear()


def test_functions_stay_as_they_are_without_a_compiler(monkeypatch, caplog):
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert compiler() is None
    with caplog.at_level(logging.WARNING):
        assert compiled(abs) is abs and compiled(len) is len
    assert [record.message for record in caplog.records] == [f"{LINE}: there is no C++ compiler."]


def test_what_cannot_be_compiled_is_called_as_it_is(monkeypatch, caplog):
    def backend(): ...

    monkeypatch.setattr(compilation, "compiler", lambda: "/usr/bin/g++")
    error = BackendCompilerFailed(backend, RuntimeError("no headers"), None)
    monkeypatch.setattr(torch, "compile", lambda function: Mock(side_effect=error))
    with caplog.at_level(logging.WARNING):
        function = compiled(lambda x: x + 1)
        assert function(1) == 2 and function(2) == 3
    [record] = caplog.records
    assert record.message.startswith(f"{LINE}: compiling failed: ") and "\n" not in record.message


def test_a_functions_own_errors_are_not_hidden(monkeypatch):
    monkeypatch.setattr(compilation, "compiler", lambda: "/usr/bin/g++")
    monkeypatch.setattr(torch, "compile", lambda function: Mock(side_effect=ValueError("its own")))
    with pytest.raises(ValueError, match="its own"):
        compiled(lambda x: x)(1)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["sac", "validate"])
def test_what_trains_without_a_compiler_says_so_in_one_line_and_trains(command, small_release, tmp_path):
    if command == "validate":
        words = ["validate", small_release, "--compile", "--agents", "state-bc", "--only", "*/*/none", "--workers", 1]
    else:
        words = ["train-behaviour", "walker-walk", "--algo", command, "--steps", 32, *SMALL, "--set", "compile=true"]
    done = python(MAIN, *words, "--out", tmp_path / "out", env=os.environ | {"CXX": "no-such-compiler"})
    assert done.stderr.count(LINE) == 1 and "Traceback" not in done.stderr
    assert command == "validate" or list((tmp_path / "out" / "checkpoints").glob("*.safetensors"))
