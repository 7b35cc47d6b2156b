"""Progress: a bar on a terminal and rare lines in a log, that know how much is to come; for both families."""

import re
from unittest.mock import Mock

import pytest

from dmcvb_gen import progress
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.plan import make_plan, start
from tests.conftest import invoke, run, small_recipe

LINE = re.compile(r"^(.+: )? *\d+%\| (?P<done>\S+)/(?P<all>\S+) \[[\d:]+<[\d:?]+, .+/ ?\S+(, .+)?\]$")
TASKS = ("walker-walk", "ant-maze-empty7x7")


def commands(task, folder):
    """Command lines that show a bar, in an order in which they can be run."""
    release = folder / "made"
    yield "rollout", task, "--episodes", "3", "--max-steps", "5", "--out", release
    yield "rollout", task, "--episodes", "2", "--max-steps", "5", "--out", folder / "bare", "--no-pixels"
    yield "paint", folder / "bare"
    yield "verify", release
    yield "validate", release, "--checks-only", "--out", folder / "report"
    yield "regenerate", release, "--check"
    yield "repaint", release, "--size", "32", "--out", folder / "repainted"
    yield "publish", release, f"file:{folder / 'published'}"
    yield "verify", f"file:{folder / 'published'}"
    yield "fetch", f"file:{folder / 'published'}", "--out", folder / "fetched"
    yield "export", release, "--to", "npz", "--out", folder / "exported"


@pytest.mark.slow_cases("ant-maze-empty7x7", "walker-walk")
@pytest.mark.parametrize("task", TASKS)
def test_a_log_gets_lines_that_end_at_what_they_expected(tmp_path, monkeypatch, task):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0)
    for words in commands(task, tmp_path):
        told = invoke(*words, code=0).stderr
        unknown = re.compile(r"\| 0(\.00)?/\? ")  # of a bar that was not told yet, before anything is done
        shown = [line for line in told.splitlines() if ("%|" in line or "/?" in line) and not unknown.search(line)]
        lines = [LINE.match(line) for line in shown]
        assert lines and all(lines) and "\r" not in told, (words, told)
        bars = {line[1]: line for line in lines if line[1] in ("fetched: ", "painted: ")}  # side by side
        for last in bars.values() or lines[-1:]:
            assert last["done"] == last["all"] and last["done"].strip("0."), (words, told)
        if words[0] == "rollout":
            unit = "steps/s" if "--no-pixels" in words else "frames/s"
            assert all(unit in line for line in shown), told


@pytest.mark.slow_cases("ant-maze-empty7x7", "walker-walk")
@pytest.mark.parametrize("task", TASKS)
def test_images_and_scores_are_told_while_cells_train(tmp_path, monkeypatch, task):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0)
    run("rollout", task, "--episodes", 4, "--max-steps", 12, "--no-pixels", "--out", tmp_path / "made")
    asked = ["--profile", "smoke", "--agents", "bc,state-bc", "--train-unsound", "--out", tmp_path / "report"]
    told = invoke("validate", tmp_path / "made", *asked).output.splitlines()
    scores = [place for place, line in enumerate(told) if re.match(r"\S+/expert/\S+ .* \[smoke\]", line)]
    training = [place for place, line in enumerate(told) if re.match(r".*bc.*%\|", line)]
    assert len(scores) == 2 and scores[0] < max(training), told
    assert any(line.startswith(f"images of {task}/") and ", 100%: " in line for line in told), told


def test_episodes_that_end_early_are_expected_to_go_on_doing_so(tmp_path):
    """Experts are at the goal long before the time limit."""
    told = Mock()
    recipe = small_recipe(tasks="ant-maze-empty7x7", levels="expert", settings="visible", episodes_per_shard=1)
    plan = make_plan(recipe, tmp_path / "early")
    start(plan)
    list(run_works(plan.works, 1, told))
    subset = Release.open(tmp_path / "early")["ant-maze-empty7x7/expert/visible"]
    expected = [call.args[0] for call in told.expect.call_args_list]
    frames = sum(call.args[0] for call in told.call_args_list)
    views = len(subset.record.views)
    assert frames == expected[-1] == views * (subset.steps + 3) < expected[0] == views * 3 * 601
    first = subset.read("length", [0])[0] + 1
    assert expected[1] == pytest.approx(3 * views * first, abs=3)
