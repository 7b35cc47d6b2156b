"""The examples of the documents learn from their data, and their policies are scored."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import run

EXAMPLES = sorted((Path(__file__).parents[2] / "docs/examples").glob("*.py"))
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
def test_an_example_learns_its_data_and_is_scored(example, releases):
    clones = example.stem.startswith("bc_")
    for name in SUBSETS:
        asked = [sys.executable, str(example), releases[name], name]
        done = subprocess.run(asked if clones else [*asked, "4", "5"], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        if clones:
            first, last = map(float, re.search(r"loss ([\d.]+) -> ([\d.]+)", done.stdout).groups())
            assert last < 0.5 * first, done.stdout
        assert re.search(r"return -?[\d.]+ \+- [\d.]+ over 4 (fresh )?episodes", done.stdout), done.stdout
