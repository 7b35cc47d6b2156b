"""What LeRobot's layout promises, read with `datasets` and pyarrow (LeRobot itself: by script)."""

import json

import datasets
import numpy as np
import pandas
import pyarrow.parquet as pq
import pytest

from dmcvb_gen.release.export import export
from tests.conftest import roll_out, short_recipe


def test_an_episode_is_a_row_group_and_statistics_have_quantiles(stored, tmp_path):
    one = stored["ant-maze-tiny/random/hidden"]
    [folder] = export(str(one.folder), "lerobot", tmp_path, [one.name])
    episodes = [one.episode(index) for index in range(2)]
    file = pq.ParquetFile(folder / "data/chunk-000/file-000.parquet")
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [e[0] for e in episodes]
    for group, (length, values, terminated) in enumerate(episodes):
        frames = file.read_row_group(group)
        np.testing.assert_array_equal(np.float32(frames["observation.state"].to_pylist()), values["state"][:length])
        assert frames["next.success"].to_pylist() == [False] * (length - 1) + [terminated]
    info = json.loads((folder / "meta/info.json").read_text())
    state = info["features"]["observation.state"]
    assert len(state["names"]) == state["shape"][0] == 167 and state["names"][1] == "target_position.0"
    assert len(info["features"]["action"]["names"]) == 8 and info["video_path"] is None
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    ends = np.cumsum([length for length, _, _ in episodes])
    assert [row["dataset_to_index"] for row in rows] == ends.tolist() and rows[1]["dataset_from_index"] == ends[0]
    tasks = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.loc["ant-maze-tiny:****/*..*/**** (random)"].task_index == 0
    actions = np.concatenate([values["action"] for _, values, _ in episodes])
    total = json.loads((folder / "meta/stats.json").read_text())
    np.testing.assert_allclose(total["action"]["std"], actions.std(axis=0), rtol=1e-4)
    for (length, values, _), row in zip(episodes, rows, strict=True):
        found = row["stats/action/q10"]
        np.testing.assert_allclose(found, np.quantile(values["action"].astype(np.float64), 0.1, axis=0), rtol=1e-6)
        top = values["pixels"][:length, 0].reshape(-1, 3) / 255
        np.testing.assert_allclose(np.ravel(row["stats/observation.images.top/q99"]), np.quantile(top, 0.99, axis=0))
    assert {"q01", "q10", "q50", "q90", "q99"} <= set(total["action"])


def lerobots_features(info):
    """The columns that LeRobot asks `datasets` for: one number is a scalar, several are a sequence."""
    found = {}
    for name, feature in info["features"].items():
        value = datasets.Value(feature["dtype"]) if feature["dtype"] != "image" else datasets.Image()
        many = feature["dtype"] != "image" and feature["shape"] != [1]
        found[name] = datasets.Sequence(value, length=feature["shape"][0]) if many else value
    return datasets.Features(found)


@pytest.mark.parametrize("task", ["pendulum-swingup", "swimmer-swimmer6"])
def test_one_action_and_broken_rates_fit_lerobots_own_checks(task, tmp_path):
    """A pendulum has one action; a swimmer takes 16.67 steps a second, and LeRobot's rates are whole numbers."""
    roll_out(short_recipe(tasks=task, settings="none", episodes=2, max_steps=30), tmp_path / "r")
    [folder] = export(str(tmp_path / "r"), "lerobot", tmp_path / "out")
    info = json.loads((folder / "meta/info.json").read_text())
    path = str(folder / "data/chunk-000/file-000.parquet")
    table = datasets.Dataset.from_parquet(path, features=lerobots_features(info), cache_dir=str(tmp_path / "cache"))
    assert np.shape(table["action"][:]) == ((60,) if task.startswith("pendulum") else (60, 5))
    np.testing.assert_allclose(np.diff(table["timestamp"][:30]), 1 / info["fps"], atol=1e-5)  # LeRobot allows 1e-4
    assert ("16.67 steps a second" in (folder / "README.md").read_text()) == task.startswith("swimmer")
