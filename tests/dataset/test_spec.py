"""Typed identities of subsets: names and their parts, there and back."""

from __future__ import annotations

import pytest

from dmcvb_gen import spec
from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.spec import GoalMode, Level, MazeName, SubsetSpec


@pytest.mark.parametrize("task_id", ["ant-maze-empty7x7", "ant-maze-my_maze:****/*..*/****"])
def test_maze_names_go_there_and_back(task_id):
    assert str(MazeName.parse(task_id)) == task_id
    assert MazeName.parse("walker-walk") is None and MazeName.parse("ant-maze-") is None


@pytest.mark.parametrize(
    "parts,name",
    [
        (("walker-walk", "expert", "dynamic_medium"), "walker-walk/expert/dynamic"),
        (("walker-walk", "mixed", "static_hard"), "walker-walk/mixed/static_hard"),
        (("ant-maze-mine:***", "expert", "hidden"), "ant-maze-mine/expert/hidden"),
    ],
)
def test_subsets_have_one_name(parts, name):
    assert SubsetSpec.parse(*parts).name == name


def test_goals_are_hidden_and_cameras_move_if_the_setting_says_so():
    mazes = [SubsetSpec("ant-maze-empty7x7", Level.EXPERT, goal=mode) for mode in GoalMode]
    assert [maze.hides_goal for maze in mazes] == [False, True, True] and all(maze.camera_moves for maze in mazes)
    walkers = [SubsetSpec.parse("walker-walk", "expert", s) for s in ("none", "static_hard", "dynamic_easy")]
    assert [walker.camera_moves for walker in walkers] == [False, False, True]
    assert not any(walker.hides_goal for walker in walkers)


def test_patterns_select_and_unknown_ones_are_refused():
    known = ["walker-walk/expert/none", "walker-walk/expert/static", "cheetah-run/random/none"]
    assert spec.select(known, ["walker-walk/*/static"]) == known[1:2]
    assert spec.select(known, ["walker-walk"]) == known[:2] and spec.select(known, []) == known
    with pytest.raises(UnknownNameError, match="walker-walk/expert/none"):
        spec.select(known, ["walker-walk/*/dynamic"])
