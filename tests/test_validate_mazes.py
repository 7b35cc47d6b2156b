"""validate: a whole small maze release (goals visible, hidden, fixed) through checks, B1 and B3, and its page."""

from __future__ import annotations

import numpy as np
import pytest

from dmcvb_gen.benchmarks.checks import check_labels, check_structure
from dmcvb_gen.rollout.recipe import make_recipe
from dmcvb_gen.store import open_release
from tests.conftest import roll_out

TINY = "ant-maze-tiny:****/*..*/****"
NAME = "ant-maze-tiny/random"


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Random actions, an episode with the goal visible, one with it hidden, one of each of two fixed goals."""
    pattern = {"tasks": TINY, "levels": "random", "settings": ["visible", "hidden", "fixed"], "episodes": 1}
    pattern |= {"fixed_goals": 2, "episodes_per_goal": 1}
    recipe = {"name": "tiny-maze", "size": 16, "renderer": {"backend": "warp", "samples": 1}, "subsets": [pattern]}
    folder = tmp_path_factory.mktemp("validate-maze") / "tiny"
    roll_out(make_recipe(recipe), folder)
    return folder


def test_a_maze_release_is_sound(release):
    structure = check_structure(open_release(release))
    assert structure.sound, structure.findings
    assert structure.checked["subsets"] == 3


def test_a_look_that_is_no_look_of_the_maze_is_found(release):
    subset = open_release(release)[f"{NAME}/visible"]
    assert not list(check_labels(subset))
    whole = subset.episode

    def wrong(episode, arrays=None):
        values = whole(episode, arrays)
        return values | {"exogenous/style": np.full_like(values["exogenous/style"], 99)}

    subset.episode = wrong
    assert {(finding.check, finding.step) for finding in check_labels(subset)} == {("labels", 0)}
