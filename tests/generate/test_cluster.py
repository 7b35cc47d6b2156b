"""Releases made on many machines: parts that share nothing but a store, Slurm's script, and a Ray cluster."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate import resolve
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.plan import make_plan, run_plan, start
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.parallel import Ray
from tests.conftest import invoke, roll_out, run, told
from tests.dataset.oracle import contents

WALKER = {"tasks": "walker-walk", "levels": "expert", "settings": ["none", "dynamic"], "episodes": 4}
MAZE = {"tasks": "ant-maze-empty7x7", "levels": "expert", "settings": "hidden", "episodes": 4}


def quick_recipe(*patterns, **changes):
    """Five-step episodes in shards of one, small images."""
    short = [pattern | {"episodes_per_shard": 1, "max_steps": 5} for pattern in patterns or (WALKER, MAZE)]
    fields = {"name": "quick", "seed": 2, "size": 8, "renderer": {"backend": "native"}, "subsets": short}
    return make_recipe(fields | changes)


@pytest.fixture(scope="module")
def recipe_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("recipe") / "quick.json"  # which is YAML, too
    path.write_text(json.dumps(quick_recipe().model_dump(mode="json", exclude_defaults=True)))
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same release, made in one folder by one process."""
    return roll_out(quick_recipe(), tmp_path_factory.mktemp("whole") / "r")


def test_parts_made_anywhere_give_the_files_of_one_rollout(whole, recipe_file, tmp_path):
    place = tmp_path / "r"
    begun = told("cluster", "begin", "--recipe", recipe_file, "--out", place)
    assert begun["shards"] == 8
    for part in ("2/3", "1/3"):
        run("cluster", "part", place, part, "--workers", 1)
    assert "not complete" in invoke("cluster", "finish", place, code=1).output
    found = told("status", place)
    assert (found["done"], found["total"], found["complete"]) == (9, 12, False)
    run("cluster", "part", place, "3/3", "--workers", 1)
    assert "finish the release: dmcvb-gen cluster finish" in run("status", place)
    done = told("cluster", "finish", place)
    assert done["complete"] and done["digest"] == whole.digest
    assert contents(place) == contents(Path(whole.path)) and "complete" in run("status", place)


def test_two_who_make_the_same_shards_end_in_one_release(whole, tmp_path):
    plan = make_plan(quick_recipe(), tmp_path / "r")
    start(plan)
    list(run_works(plan.works[:3]))
    assert run_plan(plan, 1).release.digest == whole.digest  # the first three are made a second time


def test_parts_and_repeated_begins_obey_the_renderer_of_the_begun_release(tmp_path, monkeypatch):
    """Another machine, without OpenGL, would choose otherwise."""
    words = ["walker-walk", "--level", "random", "--episodes", 1, "--max-steps", 3, "--out", tmp_path / "r"]
    asked = []
    monkeypatch.setattr(resolve, "default_renderer", lambda task: asked.append(task.id) or "native")
    begun = told("cluster", "begin", *words)
    assert asked == ["walker-walk"]
    monkeypatch.setattr(resolve, "default_renderer", lambda task: pytest.fail("a part asks for a renderer"))
    for command in (["begin", *words], ["part", tmp_path / "r", "1/1"], ["finish", tmp_path / "r"]):
        run("cluster", *command)
    assert begun["shards"] == 1 and len(list((tmp_path / "r" / "recipes").iterdir())) == 1
    assert [record.renderer["name"] for record in Release.open(tmp_path / "r").manifest.subsets] == ["native"]


FAKE = """#!/bin/bash
echo "$(basename "$0") $*" >> {log}
"""


def test_the_slurm_script_does_parts_and_finishes(tmp_path):
    script = tmp_path / "job.sh"
    script.write_text(run("cluster", "slurm", tmp_path / "r", "--tasks", "3", "--cores", "2"))
    (tmp_path / "bin").mkdir()
    for name in ("dmcvb-gen", "sbatch", "squeue"):
        (tmp_path / "bin" / name).write_text(FAKE.format(log=tmp_path / "log"))
        (tmp_path / "bin" / name).chmod(0o755)
    for task in (1, 2):
        environment = {"PATH": f"{tmp_path}/bin:/usr/bin:/bin", "SLURM_ARRAY_JOB_ID": "7"}
        environment["SLURM_ARRAY_TASK_ID"] = str(task)
        subprocess.run(["bash", str(script)], env=environment, check=True)
    assert (tmp_path / "log").read_text().splitlines() == [
        "squeue --noheader --name=dmcvb-gen-finish-7",
        f"sbatch --dependency=afterok:7 --job-name=dmcvb-gen-finish-7 --requeue "
        f"--wrap=dmcvb-gen cluster finish {tmp_path / 'r'}",
        f"dmcvb-gen cluster part {tmp_path / 'r'} 1/3 --workers 2",
        f"dmcvb-gen cluster part {tmp_path / 'r'} 2/3 --workers 2",
    ]
    assert "submit this with sbatch" in subprocess.run(["bash", str(script)], capture_output=True, text=True).stderr


@pytest.mark.slow
def test_a_ray_cluster_makes_the_same_release_and_lets_own_tasks_run(whole, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    plan = make_plan(quick_recipe(), tmp_path / "r")
    start(plan)
    assert run_plan(plan, Ray()).release.digest == whole.digest
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    words = "tests.tasks.hostile_tasks:plain --level random --episodes 2 --max-steps 3 --size 8 --out own --workers ray"
    command = [sys.executable, "-m", "dmcvb_gen", "rollout", *words.split()]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(Release.open(tmp_path / "own")) == 1
