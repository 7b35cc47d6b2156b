"""Hostile files are refused in a line or do no harm: no program runs, nothing is written outside, memory is bounded.

A few dozen of each kind here; `python -m tests.faults.hostile --examples 500 --seed 7` gives five hundred others.
"""

from __future__ import annotations

import pytest

from tests.faults.hostile import KINDS, Taker, run_kind

EXAMPLES = 25


@pytest.fixture(scope="module")
def taker():
    with Taker() as taker:
        yield taker


@pytest.mark.slow_cases("manifest")
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_files_are_refused_in_a_line_or_do_no_harm(taker, kind):
    outcome = run_kind(taker, kind, EXAMPLES)
    assert not outcome.wrong, "\n\n".join(outcome.wrong.values())
    assert outcome.refused + outcome.accepted > 0
