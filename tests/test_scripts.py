"""The programs in scripts/ run: what they measure has changed under them more than once."""

from __future__ import annotations

import csv
import importlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import dmcvb_gen
from dmcvb_gen.benchmarks.profiles import PROFILES

SCRIPTS = Path(__file__).parents[1] / "scripts"


def run(name: str, *arguments: str) -> str:
    done = subprocess.run([sys.executable, SCRIPTS / name, *arguments], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture
def learning_curve(monkeypatch, capsys):
    """The program in this process, which has imported torch: (arguments) -> what it printed."""
    threads = torch.get_num_threads()
    monkeypatch.syspath_prepend(SCRIPTS)  # processes that score beside a training find it there, too

    def call(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["learning_curve.py", *arguments])
        importlib.import_module("learning_curve").main()
        return capsys.readouterr().out

    yield call
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_both_precisions_are_timed(monkeypatch):
    monkeypatch.setenv("TORCHDYNAMO_DISABLE", "1")  # compiling takes a minute, and what it makes is tested elsewhere
    assert "auto takes" in run("bench_training.py", "--precisions", "--updates", "3")


@pytest.fixture
def refused(learning_curve, capsys):
    """What the program says about wrong arguments."""

    def call(*arguments: str) -> str:
        with pytest.raises(SystemExit) as end:
            learning_curve(*arguments)
        assert end.value.code == 2
        return capsys.readouterr().err

    return call


@pytest.mark.parametrize(
    "arguments, told",
    [
        (("--agent", "foo"), "unknown agent 'foo'"),
        (("--scores", "0"), "--scores is 0; give 1 or more"),
        (("--beside", "-1"), "--beside is -1"),
        (("--scale", "0"), "--scale is 0.0"),
        (("--set", "episodes=2"), "fields are pixel_steps"),
        (("--set", "frozen_steps=2"), "fields are pixel_steps"),
        (("--set", "readout_steps=2"), "fields are pixel_steps"),
    ],
)
def test_what_a_learning_curve_cannot_use_is_refused_before_it_begins(
    arguments, told, small_release, tmp_path, refused
):
    command = (str(small_release), "--subset", "walker-walk/random/none", "--folder", str(tmp_path / "curve"))
    assert told in refused(*command, *arguments) and not (tmp_path / "curve").exists()


def begin(*_, **options):
    raise RuntimeError("it begins")


def test_a_learning_curve_does_not_go_on_with_other_data_or_budgets(small_release, tmp_path, monkeypatch, refused):
    monkeypatch.syspath_prepend(SCRIPTS)
    program = importlib.import_module("learning_curve")
    monkeypatch.setattr(program, "load_data", begin)
    folder = tmp_path / "curve"
    command = (str(small_release), "--subset", "walker-walk/random/none", "--profile", "smoke", "--folder", str(folder))

    def goes_on():
        monkeypatch.setattr(sys, "argv", ["learning_curve.py", *command])
        with pytest.raises(RuntimeError, match="it begins"):
            program.main()

    goes_on()
    goes_on()
    kept = json.loads((folder / "options.json").read_text())
    for change, told in (
        ({"digest": "of other data"}, "other data"),
        ({"values": kept["values"] | {"rate": 9}}, "values"),
    ):
        (folder / "options.json").write_text(json.dumps(kept | change))
        assert told in refused(*command)
    earlier = {name: value for name, value in kept.items() if name not in ("digest", "values")}
    (folder / "options.json").write_text(json.dumps(earlier))
    goes_on()
    assert "options (seed)" in refused(*command, "--seed", "1")


def test_networks_are_set_side_by_side_on_a_release_without_images(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    program, seen = importlib.import_module("bench_profiles"), []
    for task in ("walker-walk", "ant-maze-empty7x7"):
        made = {"episodes": 2, "max_steps": 5, "size": 16, "pixels": False, "progress": False}
        release = dmcvb_gen.rollout(task, out=tmp_path / task, levels=["random"], **made)
        monkeypatch.setattr(program, "steps_in", lambda *arguments: seen.append(arguments[2]) or 1)
        monkeypatch.setattr(program, "train", lambda *_: None)
        monkeypatch.setattr(program, "Evaluator", lambda *_, **options: Still())
        monkeypatch.setattr(
            sys, "argv", ["bench", str(tmp_path / task), "--subset", next(iter(release)), "--only", "quick"]
        )
        program.main()
    assert [data.sizes.picture for data in seen] == [16, 16]


class Still:
    """An evaluation that costs nothing."""

    mean, stderr, success = 1.0, 0.0, None

    def __call__(self, policy):
        return self

    def close(self):
        pass


@pytest.mark.slow
def test_a_learning_curve_paints_the_images_that_a_release_lacks(tmp_path, learning_curve):
    for task in ("walker-walk", "ant-maze-empty7x7"):
        made = {"episodes": 2, "max_steps": 20, "size": 16, "pixels": False, "progress": False}
        release = dmcvb_gen.rollout(task, out=tmp_path / task, levels=["random"], **made)
        command = (str(tmp_path / task), "--subset", next(iter(release)), "--profile", "smoke")
        printed = learning_curve(
            *command, "--scores", "1", "--threads", "2", "--folder", str(tmp_path / "curve" / task)
        )
        assert len(printed.splitlines()) == 1


@pytest.mark.slow
def test_a_learning_curve_of_each_family_ends_as_a_table_and_a_picture(tmp_path, learning_curve, refused):
    for task in ("walker-walk", "ant-maze-empty7x7"):
        made = {"episodes": 2, "max_steps": 20, "size": 16, "progress": False}
        release = dmcvb_gen.rollout(task, out=tmp_path / task, levels=["random"], **made)
        options = ("--profile", "smoke", "--scale", "2", "--scores", "3", "--folder", str(tmp_path / "curve" / task))
        command = (str(tmp_path / task), "--subset", next(iter(release)), *options)
        printed = learning_curve(*command)
        assert [line.split()[0] for line in printed.splitlines()] == ["2", "4", "6"]
        rows = (tmp_path / "curve" / task / "curve.csv").read_text().splitlines()
        assert len(rows) == 4 and (tmp_path / "curve" / task / "curve.png").exists()
        wrong = refused(str(tmp_path / task), "--subset", "none", *options[:-1], str(tmp_path / "wrong"))
        assert f"unknown subset 'none'. Known: {next(iter(release))}" in wrong
        assert not (tmp_path / "wrong").exists()
        assert "choose another --folder" in refused(*command, "--seed", "1")
        for pair in ("muon=2", "rate=true", "rates=2", "rate"):
            assert f"--set {pair}: give FIELD=VALUE" in refused(*command, "--set", pair)


@pytest.mark.slow
def test_a_learning_curve_of_states_ends_where_validate_ends(tmp_path, learning_curve, monkeypatch):
    monkeypatch.setitem(PROFILES, "smoke", replace(PROFILES["smoke"], episodes=30))
    for task in ("walker-walk", "ant-maze-empty7x7"):
        made = {"episodes": 3, "max_steps": 20, "pixels": False, "progress": False}
        name = next(iter(dmcvb_gen.rollout(task, out=tmp_path / task, levels=["random"], **made)))
        curve, alone = tmp_path / "curve" / task, {"workers": 1, "threads": 1, "progress": False}
        options = ("--subset", name, "--agent", "state-bc", "--profile", "smoke", "--scores", "1")
        learning_curve(str(tmp_path / task), *options, "--folder", str(curve))
        with open(curve / "curve.csv", newline="") as file:
            (last,) = csv.DictReader(file)
        report = dmcvb_gen.validate(tmp_path / task, agents=["state-bc"], only=[name], out=tmp_path / "report", **alone)
        ((_, result),) = report.results
        assert float(last["return"]) == result["score"]["mean"] and float(last["error"]) == result["score"]["stderr"]
        assert float(last["test_loss"]) == result["curve"][-1]["test_loss"]


@pytest.mark.slow
def test_scores_beside_a_training_are_those_in_turn(tmp_path, learning_curve):
    for task in ("walker-walk", "ant-maze-empty7x7"):
        made = {"episodes": 2, "max_steps": 20, "size": 16, "progress": False}
        release = dmcvb_gen.rollout(task, out=tmp_path / task, levels=["random"], **made)
        options = (str(tmp_path / task), "--subset", next(iter(release)), "--profile", "smoke", "--scores", "3")
        curves = {}
        for name, few in {"turn": (), "beside": ("--beside", "1")}.items():
            folder = tmp_path / name / task
            printed = learning_curve(*options, *few, "--folder", str(folder))
            with open(folder / "curve.csv", newline="") as file:
                rows = list(csv.DictReader(file))
            assert sorted(line.split()[0] for line in printed.splitlines()) == ["1", "2", "3"]
            curves[name] = [(row["step"], row["return"], row["error"]) for row in rows]
        assert curves["turn"] == curves["beside"] and len(curves["turn"]) == 3
    (folder / "scores" / "2.json").unlink()  # of a run that was killed before this score was there
    again = learning_curve(*options, *few, "--folder", str(folder))
    assert again.count("2 of 3 steps") == 2  # that one, and the training's own


@pytest.mark.slow
def test_a_painted_sample_of_a_shipped_release_has_the_same_digests_twice():
    printed = run("paint_sample.py", "dmcvb-v1-locomotion", "--share", "0.0001")
    assert "painted twice, 0 shards differ" in printed
    painted = subprocess.run(
        [sys.executable, SCRIPTS / "paint_sample.py", "quickstart"], capture_output=True, text=True
    )
    assert painted.returncode == 1 and "regenerate --check" in painted.stderr
