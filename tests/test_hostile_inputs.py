"""Hostile files are refused in a line or do no harm: no program runs, nothing is written outside, memory is bounded.

A few dozen of each kind here; `python -m tests.faults.hostile --examples 10000` gives ten thousand.
"""

from __future__ import annotations

import json

import pytest

from tests.faults.hostile import KINDS, Taker, run_kind

EXAMPLES = 25


@pytest.fixture(scope="module")
def taker():
    with Taker() as taker:
        yield taker


@pytest.mark.parametrize("kind", KINDS)
def test_hostile_files_are_refused_in_a_line_or_do_no_harm(taker, kind):
    outcome = run_kind(taker, kind, EXAMPLES)
    assert not outcome.wrong, "\n\n".join(outcome.wrong.values())
    assert outcome.refused + outcome.accepted > 0


def test_a_shape_of_a_hundred_thousand_letters_is_soon_refused(taker):
    name = "ant-maze-empty7x7/random/visible.zarr/zarr.json"
    group = json.loads(KINDS["zarr"].base()[name])
    group["consolidated_metadata"]["metadata"]["pixels_top"]["shape"][1] = "x" * 100_000
    answer = taker.take("zarr", {name: json.dumps(group).encode()})
    assert answer["status"] == "refused" and len(answer["text"]) < 600, answer
