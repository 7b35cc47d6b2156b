"""Hostile files are refused in a line or do no harm: no program runs, nothing is written outside, memory is bounded.

A few dozen of each kind here; `HOSTILE=500 pytest tests/test_hostile_inputs.py` takes five hundred.
"""

import os
import sys

import pytest

from tests.faults.hostile import KINDS, run_kind


@pytest.mark.slow_cases("recipe")
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_files_are_refused_in_a_line_or_do_no_harm(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    wrong = run_kind(KINDS[kind], int(os.environ.get("HOSTILE", "25")), tmp_path / "case")
    assert not wrong, "\n\n".join(wrong.values())
