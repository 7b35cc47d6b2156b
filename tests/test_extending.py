"""The examples of docs/extending.md: each registers one thing of the user's own, and a public command uses it."""

import importlib
import json
import os
import re
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.modalities import all_modalities
from dmcvb_gen.registry import Registry
from dmcvb_gen.release.verify import verify
from tests.conftest import MAIN, invoke, python, run

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples" / "extending"
SHORT = ["--level", "random", "--episodes", "2", "--max-steps", "3", "--size", "16", "--workers", "1"]


def load(name: str):
    """Import an example as users import a module of their own."""
    return importlib.import_module(f"docs.examples.extending.{name}")


def test_a_distractor_of_your_own_paints_a_release_that_verifies(tmp_path, monkeypatch):
    monkeypatch.setenv("DMCVB_GEN_DISTRACTORS", "")
    name = load("distractor").__name__
    run("rollout", "walker-walk", "--distractor", f"{name}:Grey_hard", *SHORT, "--out", tmp_path / "r")
    run("verify", tmp_path / "r")
    subset = Release.open(tmp_path / "r")["walker-walk/random/grey_hard"]
    colors = subset.read("exogenous/material_rgb")
    assert (colors == colors[:, :1, :1, :1]).all() and (np.abs(colors - 0.5) <= 0.3).all()
    assert len(np.unique(colors)) == 2  # one grey an episode
    assert (subset.read("exogenous/background_video") == -1).all()  # what it does not give is the task's own
    run("card", tmp_path / "r")
    assert "a distractor of its author's own" in (tmp_path / "r" / "README.md").read_text()
    monkeypatch.setenv("DMCVB_GEN_DISTRACTORS", "")
    run("card", tmp_path / "r", "--check")
    run("view", tmp_path / "r", "--out", tmp_path / "page.html")
    with monkeypatch.context() as context:
        context.setenv("DMCVB_GEN_DISTRACTORS", f"{name}:Grey")
        context.setattr("dmcvb_gen.generate.resolve.code_of_distractor", lambda setting: ["another"])
        assert "grey_hard is not that which made these data" in str(verify(tmp_path / "r").unchecked[0])
    for gone, told in (("", "unknown distractor 'grey'"), ("gone_file:Grey", "cannot find distractor gone_file:Grey")):
        monkeypatch.setenv("DMCVB_GEN_DISTRACTORS", gone)
        output = invoke("verify", tmp_path / "r", code=3).output
        assert "NOT CHECKED" in output and told in output, output


@pytest.mark.slow_cases("small_mazes", "small_release")
@pytest.mark.parametrize("family", ["small_release", "small_mazes"])
def test_a_modality_of_your_own_is_stored_exported_and_observed(family, request, tmp_path, monkeypatch):
    load("modality")
    run("repaint", request.getfixturevalue(family), "--only", "*/random/*", "--label", "near", "--out", tmp_path / "r")
    run("verify", tmp_path / "r")
    subset = next(iter(Release.open(tmp_path / "r").subsets.values()))
    name = next(array for array in subset.arrays if array.split("/")[0] == "near")
    near = subset.episode(0, [name])[name]
    assert near.dtype == np.uint8 and set(np.unique(near)) <= {0, 1}
    with monkeypatch.context() as context:
        context.delitem(all_modalities(), "near")
        assert "near" in str(verify(tmp_path / "r").unchecked[0])
    run("export", tmp_path / "r", "--to", "lerobot", "--out", tmp_path / "x")
    assert any("observation.images.near" in path.read_text() for path in (tmp_path / "x").rglob("info.json"))
    name = "walker-walk-none" if family == "small_release" else "ant-maze-empty7x7-visible"
    env = gymnasium.make(f"dmcvb_gen/{name}-v0", size=16, modalities=["near"])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation) and set(np.unique(observation["near"])) <= {0, 1}
    env.close()


@pytest.mark.slow_cases("small_mazes-*/visible", "small_release-*/none")
@pytest.mark.parametrize("family, only", [("small_release", "*/none"), ("small_mazes", "*/visible")])
def test_an_agent_of_your_own_is_trained_beside_the_papers_in_every_form(family, only, request, tmp_path):
    """Its file is named in the environment, so the processes that train it import it, too."""
    agents = ["linear-bc", "state-linear-bc", "id+linear-bc:power=1"]
    words = ["--profile", "smoke", "--workers", "2", "--out", tmp_path, "--agents", ",".join(agents), "--only", only]
    environment = os.environ | {"DMCVB_GEN_PLUGINS": "agent", "PYTHONPATH": os.pathsep.join(sys.path)}
    python(MAIN, "validate", request.getfixturevalue(family), *words, cwd=EXAMPLES, env=environment)
    report = json.loads((tmp_path / "report.json").read_text())
    assert {result["cell"]["agent"] for result in report["results"]} == set(agents) and not report["failed"]
    assert all(result["curve"][-1]["loss"] > 0 for result in report["results"])


@pytest.mark.parametrize("text, told", [(None, "cannot find DMCVB_GEN_PLUGINS mine"), ("1 / 0", "(ZeroDivisionError")])
def test_a_plugin_that_cannot_be_imported_is_told_in_one_line(text, told, tmp_path, monkeypatch):
    monkeypatch.setenv("DMCVB_GEN_PLUGINS", "mine")
    monkeypatch.chdir(tmp_path)
    if text:
        (tmp_path / "mine.py").write_text(text)
    with pytest.raises(DmcvbError, match=re.escape(told)):
        Registry("agent", "dmcvb_gen.agents", "none").all()


@pytest.mark.slow_cases("small_mazes", "small_release")
@pytest.mark.parametrize("family", ["small_release", "small_mazes"])
def test_a_benchmark_of_your_own_has_its_table_in_the_report(family, request, tmp_path):
    load("benchmark")
    words = ["--profile", "smoke", "--workers", 1, "--benchmark", "growth", "--out", tmp_path / "report"]
    run("validate", request.getfixturevalue(family), *words)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert {result["labels"]["policy"].split()[-1] for result in report["results"]} >= {"random"}
    assert {result["reference"] for result in report["results"]} == {"the same agent on all episodes"}
    assert "Growth: scores over shares of the data" in (tmp_path / "report" / "report.html").read_text()
