"""Hostile files are refused in a line or do no harm: no program runs, nothing is written outside, memory is bounded.

A few dozen of each kind here; `HOSTILE=500 pytest tests/test_hostile_inputs.py` takes five hundred.
"""

from __future__ import annotations

import os

import pytest

from tests.faults.hostile import KINDS, Taker, run_kind


@pytest.fixture(scope="module")
def taker():
    with Taker() as taker:
        yield taker


@pytest.mark.slow_cases("manifest")
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_files_are_refused_in_a_line_or_do_no_harm(taker, kind):
    wrong = run_kind(taker, kind, int(os.environ.get("HOSTILE", "25")))
    assert not wrong, "\n\n".join(wrong.values())
