"""One small release of each family through every command, from rollout to agents that train on it."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from dmcvb_gen.dataset import Release
from dmcvb_gen.dataset.pictures import shown
from tests.conftest import run, told

SIZE = 16
FAMILIES = {
    "locomotion": ("walker-walk", "--distractor", ("none", "dynamic")),
    "mazes": ("ant-maze-easy7x7b", "--goal", ("visible", "hidden", "fixed2")),
}


@pytest.fixture(scope="module", params=FAMILIES)
def made(request, tmp_path_factory):
    """(task, settings, folder) of a release of an expert's two short episodes a setting."""
    task, option, asked = FAMILIES[request.param]
    folder = tmp_path_factory.mktemp(request.param) / "r"
    short = ["--level", "expert", "--episodes", 2, "--max-steps", 6, "--size", SIZE]
    run("rollout", task, *[word for setting in asked for word in (option, setting)], *short, "--out", folder)
    return task, [setting.removesuffix("2") for setting in asked], folder


@pytest.mark.slow_cases("mazes")
def test_it_is_described_sound_and_made_again(made):
    _, settings, folder = made
    facts = told("info", folder)
    assert facts["complete"] and len(facts["subsets"]) == len(settings)
    assert told("verify", folder)["sound"]
    assert "same digest" in run("regenerate", folder, "--check")


@pytest.mark.slow_cases("locomotion", "mazes")
def test_it_is_shown(made, tmp_path):
    run("preview", made[2], "--out", tmp_path / "preview")
    assert any(path.stat().st_size > 1000 for path in (tmp_path / "preview").rglob("*.png"))
    shutil.copytree(made[2], tmp_path / "carded")
    run("card", tmp_path / "carded")
    run("card", tmp_path / "carded", "--check")


@pytest.mark.slow_cases("mazes")
def test_it_travels_light_and_is_painted_on_arrival(made, tmp_path):
    folder = made[2]
    run("publish", folder, f"file://{tmp_path}/there", "--no-pixels")
    run("fetch", f"file://{tmp_path}/there", "--out", tmp_path / "here", "--paint")
    there, here = (Release.open(path) for path in (folder, tmp_path / "here"))
    assert here.digest == there.digest and not any(subset.unpainted.any() for subset in here.subsets.values())


@pytest.mark.slow_cases("mazes")
def test_it_is_repainted_in_another_style_and_size(made, tmp_path):
    folder = made[2]
    run("repaint", folder, "--size", 24, "--split", "val", "--out", tmp_path / "val")
    assert told("verify", tmp_path / "val")["sound"]
    new, old = Release.open(tmp_path / "val"), Release.open(folder)
    for name, subset in new.subsets.items():
        np.testing.assert_array_equal(subset.read("physics"), old[name].read("physics"))
        arrays = shown(subset).arrays
        means, before = ([one.read(a, [0]).mean((0, 1, 2, 3)) for a in arrays] for one in (subset, old[name]))
        moved = np.abs(np.subtract(means, before)).max()
        # Other videos and styles, by at least 13 grey levels; none has neither, another size alone moves it by one.
        assert (moved > 4) == (not name.endswith("/none")), name


@pytest.mark.slow_cases("locomotion", "mazes")
def test_agents_train_on_it_and_are_scored(made, tmp_path):
    task, settings, folder = made
    benchmarks = {"b1", "b3"} if "fixed" in settings else {"b1"}
    asked = [word for name in sorted(benchmarks) for word in ("--benchmark", name)]
    command = ["validate", folder, *asked, "--agents", "bc,state-bc", "--threads", 1, "--out", tmp_path / "report"]
    run(*command, "--only", f"{task}/expert/*")
    facts = json.loads((tmp_path / "report/report.json").read_text())
    assert not facts["failed"] and {result["cell"]["benchmark"] for result in facts["results"]} == benchmarks
