"""The vocabulary: names and their parts, there and back."""

from __future__ import annotations

import pytest

from dmcvb_gen import names
from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.names import DistractorSetting, MazeName, SubsetName
from dmcvb_gen.tasks import get_task, task_ids


def test_every_task_says_the_family_that_its_id_says():
    for task_id in task_ids():
        assert get_task(task_id).family == names.family_of(task_id)
    assert {get_task(task_id).family for task_id in task_ids()} == set(names.FAMILIES)


@pytest.mark.parametrize("task_id", ["ant-maze-empty7x7", "ant-maze-my_maze:****/*..*/****@geodesic", "ant-maze-a@b"])
def test_maze_names_go_there_and_back(task_id):
    assert str(MazeName.parse(task_id)) == task_id


def test_other_tasks_are_no_mazes():
    assert MazeName.parse("walker-walk") is None and MazeName.parse("ant-maze-") is None
    assert names.family_of("walker-walk") == names.LOCOMOTION


def test_subset_names_go_there_and_back():
    name = names.subset_name("ant-maze-mine:***@geodesic", "expert", "hidden")
    assert name == "ant-maze-mine-geodesic/expert/hidden"
    assert SubsetName.parse(name) == SubsetName("ant-maze-mine-geodesic", "expert", "hidden")
    with pytest.raises(UnknownNameError, match="<task>/<level>/<setting>"):
        SubsetName.parse("walker-walk/expert")


def test_settings_have_one_name_and_only_those_of_their_family():
    assert names.normalize_setting("walker-walk", "dynamic_medium") == "dynamic"
    assert names.normalize_setting("ant-maze-empty7x7", "hidden") == "hidden"
    assert names.distractor_of("walker-walk", "static_hard") == DistractorSetting("static", "hard")
    assert names.distractor_of("ant-maze-empty7x7", "hidden") == DistractorSetting()
    for task, setting in (("walker-walk", "hidden"), ("ant-maze-empty7x7", "dynamic"), ("walker-walk", "static_huge")):
        with pytest.raises(UnknownNameError):
            names.normalize_setting(task, setting)


def test_goals_are_hidden_and_cameras_move_where_the_setting_says():
    assert [names.hides_goal(mode) for mode in names.GOAL_MODES] == [False, True, True]
    assert not names.hides_goal("dynamic")
    assert [names.setting_moves(s) for s in ("none", "static_hard", "dynamic_easy", "fixed")] == [
        False,
        False,
        True,
        True,
    ]


def test_patterns_select_and_unknown_ones_are_refused():
    known = ["walker-walk/expert/none", "walker-walk/expert/static", "cheetah-run/random/none"]
    assert names.select(known, ["walker-walk/*/static"]) == known[1:2]
    assert names.select(known, ["walker-walk"]) == known[:2] and names.select(known, []) == known
    with pytest.raises(UnknownNameError, match="walker-walk/expert/none"):
        names.select(known, ["walker-walk/*/dynamic"])


@pytest.mark.parametrize("count,text", [(0, "0 shards"), (1, "1 shard"), (2, "2 shards"), (1200, "1,200 shards")])
def test_counted(count, text):
    assert names.pluralize(count, "shards") == text
