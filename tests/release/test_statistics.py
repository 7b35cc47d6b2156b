"""Statistics of a release's states and levels, beside the same computed by hand, for both families."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.release.statistics import _root_columns, level_statistics, state_statistics, states_json
from dmcvb_gen.tasks import get_task


@pytest.mark.parametrize("fixture", ["small_release", "small_mazes"])
def test_every_number_of_the_states(fixture, request):
    release = Release.open(request.getfixturevalue(fixture))
    [states] = state_statistics(release)
    subset = next(iter(release.subsets.values()))
    rows = np.concatenate([subset.episode(int(e))["state"] for e in subset.episodes]).astype(float)
    assert states.steps == len(rows) and states.task == subset.task
    np.testing.assert_allclose(states.mean, rows.mean(axis=0))
    np.testing.assert_allclose(states.std, rows.std(axis=0), atol=1e-12)
    told = json.loads(states_json(release))[subset.task]["fields"]
    for name, place in get_task(subset.task).state_slices.items():
        np.testing.assert_allclose(told[name]["mean"], rows.mean(axis=0)[place], rtol=1e-4)


ROOTS = {
    "point_mass-easy": [0, 1],
    "swimmer-swimmer6": [0, 1],
    "manipulator-bring_ball": None,
    "walker-walk": [1],
    "fish-upright": [0, 1],
}
"""Task -> its root's columns of qpos along x and y."""


@pytest.mark.parametrize(("task_id", "columns"), ROOTS.items())
def test_the_root_moves_along_x_and_y(task_id, columns):
    found = _root_columns(get_task(task_id).model)
    assert (found and found[0].tolist()) == columns


def test_how_levels_move(small_release, small_mazes):
    [walker] = level_statistics(Release.open(small_release))
    assert (walker.task, walker.level, walker.success) == ("walker-walk", "random", None)
    subset = next(iter(Release.open(small_release).subsets.values()))
    task = get_task("walker-walk")
    heights = [subset.episode(int(e))["state"][:, task.state_slices["height"]] for e in subset.episodes]
    assert walker.height == pytest.approx(float(np.concatenate(heights).mean()))
    # rootz, rootx, rooty come first in the walker's qpos; time comes before them.
    moved = [np.diff(subset.episode(int(e))["physics"][:, 2]) for e in subset.episodes]
    assert walker.speed == pytest.approx(float(np.abs(np.concatenate(moved)).mean() / 0.05), rel=1e-6)

    [ant] = level_statistics(Release.open(small_mazes))
    mazes = Release.open(small_mazes)
    visible = next(iter(mazes.subsets.values()))
    place = get_task(visible.task).state_slices["walker_position"]
    walked = [np.diff(visible.episode(int(e))["state"][:, place][:, :2], axis=0) for e in visible.episodes]
    by_torso = float(np.linalg.norm(np.concatenate(walked), axis=1).mean() / 0.05)
    assert ant.speed == pytest.approx(by_torso, rel=0.5) and ant.success == visible.read("terminated").mean()
