"""Releases made on many machines: parts that share nothing but a store, and a Ray cluster."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate import resolve
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.plan import make_plan, run_plan, start
from dmcvb_gen.parallel import Ray
from tests.conftest import MAIN, invoke, python, roll_out, run, small_recipe, told
from tests.dataset.oracle import contents

WALKER = {"tasks": "walker-walk", "levels": "expert", "settings": ["none", "dynamic"], "episodes": 4}
MAZE = {"tasks": "ant-maze-empty7x7", "levels": "expert", "settings": "hidden", "episodes": 4}


def quick_recipe():
    """Five-step episodes in shards of one, small images."""
    short = [pattern | {"episodes_per_shard": 1, "max_steps": 5} for pattern in (WALKER, MAZE)]
    return small_recipe(name="quick", seed=2, size=8, subsets=short)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same release, made in one folder by one process."""
    return roll_out(quick_recipe(), tmp_path_factory.mktemp("whole") / "r")


def test_parts_made_anywhere_give_the_files_of_one_rollout(whole, tmp_path):
    place, recipe_file = tmp_path / "r", tmp_path / "quick.json"  # which is YAML, too
    recipe_file.write_text(json.dumps(quick_recipe().model_dump(mode="json", exclude_defaults=True)))
    begun = told("cluster", "begin", "--recipe", recipe_file, "--out", place)
    assert begun["shards"] == 8
    run("cluster", "part", place, "1/8", "--workers", 1)
    assert "FAIL" not in invoke("verify", place, code=3).output  # of policies that no shard here comes from, either
    for part in ("2/3", "1/3"):
        run("cluster", "part", place, part, "--workers", 1)
    assert "not complete" in invoke("cluster", "finish", place, code=1).output
    run("regenerate", place)
    left = told("rollout", "--out", place, "--dry-run")
    assert left["shards"] == 2 and sum(subset["left"] for subset in left["subsets"]) == 3
    run("cluster", "part", place, "3/3", "--workers", 1)
    assert "not finished: dmcvb-gen cluster finish" in invoke("verify", place, code=3).output
    done = told("cluster", "finish", place)
    assert done["complete"] and done["digest"] == whole.digest
    assert contents(place) == contents(Path(whole.path)) and told("rollout", "--out", place, "--dry-run")["shards"] == 0


def test_images_that_were_asked_for_are_missing_until_they_are_there(tmp_path):
    words = ["walker-walk", "--level", "random", "--episodes", 2, "--episodes-per-shard", 1, "--max-steps", 3]
    words += ["--size", 16, "--out", tmp_path / "r"]
    run("rollout", *words, "--no-pixels")
    assert told("verify", tmp_path / "r")["complete"]
    assert not told("rollout", *words, "--range", "0:1")["complete"]
    assert "shards are missing in 1 subset" in invoke("cluster", "finish", tmp_path / "r", code=1).output
    assert invoke("verify", tmp_path / "r", code=3) and not told("info", tmp_path / "r")["complete"]


def test_two_who_make_the_same_shards_end_in_one_release(whole, tmp_path):
    plan = make_plan(quick_recipe(), tmp_path / "r")
    start(plan)
    list(run_works(plan.works[:3]))
    assert run_plan(plan, 1)[0].digest == whole.digest  # the first three are made a second time


def test_threads_of_one_process_make_releases_side_by_side(whole, tmp_path):
    with ThreadPoolExecutor(3) as pool:
        made = list(pool.map(lambda name: roll_out(quick_recipe(), tmp_path / name), "abc"))
    assert {release.digest for release in made} == {whole.digest}


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


OWN = {"tests.tasks.hostile_tasks:plain": "none", "walker-walk": "docs.examples.extending.distractor:Grey"}


@pytest.mark.parametrize("task", OWN)
def test_parts_notice_that_code_of_ones_own_has_changed(task, tmp_path, monkeypatch):
    words = [task, "--distractor", OWN[task], "--level", "random", "--episodes", 1, "--max-steps", 3]
    run("cluster", "begin", *words, "--out", tmp_path / "r")
    monkeypatch.setattr(resolve, "source_digest", lambda module: "0" * 64)
    refused = invoke("cluster", "part", tmp_path / "r", "1/1", code=2).output
    assert f"the code of {'grey' if OWN[task] != 'none' else task} has changed since" in refused


def test_images_of_a_task_of_ones_own_that_has_changed_are_not_painted(tmp_path, monkeypatch):
    light = tmp_path / "light"
    words = ["tests.tasks.hostile_tasks:plain", "--level", "random", "--episodes", 1, "--max-steps", 3, "--size", 16]
    run("rollout", *words, "--no-pixels", "--out", light)
    monkeypatch.setattr(resolve, "source_digest", lambda module: "0" * 64)
    others = [["repaint", light, "--out", tmp_path / "other"], ["view", light, "--out", tmp_path / "page.html"]]
    for command in (["paint", light], ["paint", light, "--size", 24], ["card", light], *others):
        assert "has changed since the release was begun" in invoke(*command, code=2).output
    with pytest.raises(StoreError, match="has changed"):
        dmcvb_gen.open(light, paint=True)["tests.tasks.hostile_tasks-plain/random/none"].episode(0)
    assert len(Release.open(light).recipes) == 1 and not (tmp_path / "other").exists()


@pytest.mark.slow
def test_a_ray_cluster_makes_the_same_release_and_lets_own_tasks_run(whole, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    plan = make_plan(quick_recipe(), tmp_path / "r")
    start(plan)
    assert run_plan(plan, Ray())[0].digest == whole.digest
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    words = "tests.tasks.hostile_tasks:plain --level random --episodes 2 --max-steps 3 --size 8 --out own --workers ray"
    python(MAIN, "rollout", *words.split())
    assert len(Release.open(tmp_path / "own")) == 1
