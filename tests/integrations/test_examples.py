"""The examples of the documents learn, and the loaders that they name take a `StepSource` as it is."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import grain
import numpy as np
import pytest

import dmcvb_gen
from tests.conftest import run

EXAMPLES = sorted((Path(__file__).parents[2] / "docs/examples").glob("bc_*.py"))
SUBSETS = {
    "walker-walk/expert/dynamic": ["walker-walk", "--distractor", "dynamic"],
    "ant-maze-empty7x7/expert/hidden": ["ant-maze-empty7x7", "--goal", "hidden"],
}


@pytest.fixture(scope="module")
def releases(tmp_path_factory):
    """Name of a subset -> the folder of its release, of two short episodes."""
    folder = tmp_path_factory.mktemp("examples")
    small = ["--level", "expert", "--episodes", 2, "--max-steps", 20, "--size", 16]
    for name, asked in SUBSETS.items():
        run("rollout", *asked, *small, "--out", folder / name)
    return {name: str(folder / name) for name in SUBSETS}


@pytest.mark.full
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_learns_its_data(example, releases):
    for name in SUBSETS:
        asked = [sys.executable, str(example), releases[name], name]
        done = subprocess.run(asked, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        first, last = map(float, re.search(r"loss ([\d.]+) -> ([\d.]+)", done.stdout).groups())
        assert last < 0.5 * first, done.stdout
        assert re.search(r"return -?[\d.]+ \+- [\d.]+ over 4 fresh episodes", done.stdout), done.stdout


def test_grain_shuffles_and_batches_a_source(releases):
    for name in SUBSETS:
        source = dmcvb_gen.open(releases[name])[name].source(stack=2)
        table, rows = source.table, source.table.steps
        loader = grain.MapDataset.source(source).shuffle(seed=1).batch(4)
        seen = set()
        for batch in loader:
            for row, (episode, step) in enumerate(zip(batch["episode"], batch["step"], strict=True)):
                place = int(np.flatnonzero((table.episode[rows] == episode) & (table.step[rows] == step))[0])
                seen.add(place)
                for key, value in source[place].items():
                    np.testing.assert_array_equal(batch[key][row], value)
        assert seen == set(range(len(source)))
