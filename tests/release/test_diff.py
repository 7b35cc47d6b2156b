"""`diff` names what is different in two releases, folders or URLs, and nothing else."""

from __future__ import annotations

import json

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.release.diff import diff
from dmcvb_gen.release.fetch import fetch
from tests.conftest import invoke, maze_recipe, roll_out

NAME, MAZE = "walker-walk/random/none", "ant-maze-tiny/random/visible"


def test_equal_releases_have_no_difference(small_release, maze_release):
    for folder in (small_release, maze_release):
        assert "no difference" in invoke("diff", folder, f"file://{folder}", code=0).output


def test_what_differs_is_named(maze_release, small_release, tmp_path):
    roll_out(maze_recipe(episodes=1).model_copy(update={"seed": 5}), tmp_path / "other")
    found = {str(difference) for difference in diff(maze_release, tmp_path / "other")}
    assert {f"{MAZE}: episodes: 2 and 1", f"{MAZE}: local episodes: 2 and 1"} <= found
    assert f"{MAZE}/trajectories: made in another way: seed" in found
    assert f"{MAZE}/trajectories: physics has other bytes in the episodes 0:1" in found
    assert f"{MAZE}/pixels_top: pixels/top has other bytes in the episodes 0:1" in found
    found = [str(difference) for difference in diff(small_release, maze_release)]
    assert f"{NAME}: only in the first" in found and f"{MAZE}: only in the second" in found


def test_a_part_lacks_episodes_alone(small_release, tmp_path):
    fetch(f"file:{small_release}", tmp_path / "part", [NAME], (0, 1))
    found = json.loads(invoke("diff", small_release, tmp_path / "part", "--json", code=1).output)
    here = {record.name: 2 if record.name == NAME else 0 for record in Release.open(small_release).manifest.subsets}
    said = [{"subset": name, "message": f"local episodes: 3 and {count}"} for name, count in here.items()]
    assert found == {"differences": said}


def test_an_array_that_only_one_has_is_not_called_different(small_release, tmp_path):
    repaint(Repainting(small_release, tmp_path / "r", size=16, labels=["depth"]))
    found = {str(difference) for difference in diff(tmp_path / "r", small_release)}
    assert f"{NAME}/depth: only in the first" in found and not any("other bytes" in one for one in found)
