"""Rollouts: the same bits however they are made, interrupted and resumed."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from importlib.resources import files

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.distractors.backgrounds import builtin_folder, load_backgrounds
from dmcvb_gen.errors import DmcvbError, RecipeError, StoreError, UnknownNameError
from dmcvb_gen.generate.counts import count
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.plan import make_plan, start
from dmcvb_gen.generate.recipe import expand, load_recipe, make_recipe, narrow, override, shipped_recipes
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.request import make_request
from dmcvb_gen.policies.actor import RandomPolicy
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.rendering.opengl import unavailable
from dmcvb_gen.spec import LEVELS, is_maze
from dmcvb_gen.tasks import get_task
from tests.conftest import MAIN, invoke, maze_recipe, python, records, roll_out, short_recipe, small_recipe, wait
from tests.faults.commands import GRACE, session
from tests.faults.inject import files_up_to

NAME = "walker-walk/random/dynamic"
ONE = b"{tasks: walker-walk, levels: random, settings: none, episodes: 1}"
MAZES = b"{tasks: ant-maze-empty7x7, levels: random, settings: visible, episodes: 1}"
TWICE = """name: dup
base: &base {episodes: 1}
subsets:
- {tasks: walker-walk, levels: random, settings: none, <<: *base, <<: *base, episodes: 2}
- *base

subsets:
- {tasks: cheetah-run, levels: random, settings: none, episodes: 1}
"""
"""Line 7 has the second `subsets`; what a merge key brings may be given again."""


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_works_in_any_order_and_workers_give_one_digest(workers, tmp_path):
    whole = roll_out(short_recipe(), tmp_path / "whole")
    again = roll_out(short_recipe(), tmp_path / "r", works=lambda works: works[::-1], workers=workers)
    assert again.digest == whole.digest


def test_a_range_of_episodes_made_alone_gives_the_same_records(small_release, tmp_path):
    plan = make_plan(small_recipe(), tmp_path / "r", [NAME], episodes=(2, 3))
    assert [(work.shard, len(work.settings)) for work in plan.works] == [(1, 1)]
    start(plan)
    list(run_works(plan.works))
    made, whole = Release.in_making(plan.release.store), Release.open(small_release)
    for layer in whole[NAME].record.layers:
        assert made.records(layer) == {1: whole.records(layer)[1]}


def test_settings_show_the_same_episodes_and_are_stored_once(small_release):
    release = Release.open(small_release)
    assert {subset.trajectories.name for subset in release.subsets.values()} == {"walker-walk/random/trajectories"}
    none, static, dynamic = (subset.read("pixels") for subset in release.subsets.values())
    assert (none != static).mean() > 0.5 and (static != dynamic).mean() > 0.3
    alone = small_recipe(trajectories="independent")
    assert len({layer.key for layer in make_plan(alone, "nowhere").release.layers.values()}) == 9


@pytest.mark.slow_cases("maze_recipe")
@pytest.mark.parametrize("recipe", [short_recipe, maze_recipe])
def test_a_release_grows_without_touching_what_is_there(recipe, tmp_path):
    """From 3 episodes in shards of 2 (mazes: 2 in shards of 1) to 5, by the same command with another number."""
    few = roll_out(recipe(max_steps=20), tmp_path / "r")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "r").rglob("c/**/*") if path.is_file()}
    whole = roll_out(override(recipe(max_steps=20), episodes=5), tmp_path / "r")
    assert {len(subset.episodes) for subset in whole.subsets.values()} == {5}
    assert before.items() <= {path: path.stat().st_mtime_ns for path in (tmp_path / "r").rglob("c/**/*")}.items()
    for name, old in records(few).items():
        assert old.items() <= whole.records(name).items()


def test_an_episode_depends_on_its_index_alone():
    task = get_task("cheetah-run")
    policies = [RandomPolicy(task)]
    together = simulate(task, policies, [3, 4, 40], 0, ("a", "b"), max_steps=20)
    alone = simulate(task, policies, [40], 0, ("a", "b"), max_steps=20)
    np.testing.assert_array_equal(together.physics[2:], alone.physics)
    np.testing.assert_array_equal(together.action[2:], alone.action)
    other = simulate(task, policies, [40], 1, ("a", "b"), max_steps=20)
    assert (other.action != alone.action).any() and other.seed != alone.seed


@pytest.mark.slow
@pytest.mark.skipif(unavailable() is not None, reason=f"OpenGL: {unavailable()}")
def test_opengl_in_this_process_ends_without_a_word_of_its_own(tmp_path):
    words = ["--level", "random", "--distractor", "dynamic", "--episodes", 1, "--max-steps", 2, "--size", 16]
    words += ["--renderer", "opengl", "--workers", 1, "--out", tmp_path / "r"]
    done = python(MAIN, "rollout", "walker-walk", *words)
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr, done.stderr


@pytest.mark.slow
def test_ctrl_c_ends_cleanly_leaves_no_process_and_says_how_to_go_on(tmp_path):
    command = [sys.executable, "-m", "dmcvb_gen", "rollout", "walker-walk", "--level", "random", "--size", "16"]
    command += ["--distractor", "dynamic", "--episodes", "40", "--episodes-per-shard", "1", "--workers", "2"]
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process = subprocess.Popen([*command, "--out", tmp_path / "r"], **pipes, start_new_session=True)
    wait(lambda: list((tmp_path / "r").glob("records/**/labels/*.json")), 120)
    assert len(session(process.pid)) >= 3
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert wait(lambda: not session(process.pid), GRACE)
    assert process.returncode != 0 and "rerun the same command to go on" in errors
    assert "Traceback" not in errors and "pending" not in errors
    assert len(Release.open(tmp_path / "r").subsets) >= 1


def test_shards_keep_the_size_with_which_they_were_begun(small_release, caplog):
    plan = make_plan(override(small_recipe(), episodes_per_shard=3), small_release)
    assert plan.works == () and plan.there and "shards keep their" in caplog.text


def test_other_versions_than_those_of_the_beginning_are_refused_unless_asked_for(copy):
    (copy / record_path(f"{NAME}/pixels", 1)).unlink()
    [note] = (copy / "provenance").glob("*.json")
    note.write_text(note.read_text().replace('"mujoco":"', '"mujoco":"1.'))
    plan = make_plan(None, copy)
    with pytest.raises(StoreError, match="begun with mujoco 1.*--other-versions"):
        start(plan)
    start(plan, other_versions=True)


def test_a_full_disk_is_said_and_costs_nothing_that_is_there(small_release, copy):
    (copy / record_path(f"{NAME}/pixels", 1)).unlink()
    pixels = copy / "walker-walk/random.zarr/dynamic/pixels/c/1/0/0/0/0"
    pixels.unlink()
    plan = make_plan(small_recipe(), copy)
    with files_up_to(20_000), pytest.raises(StoreError, match="no room to write to .*pixels.*make room"):
        list(run_works(plan.works))
    [work] = make_plan(small_recipe(), copy).works
    assert not pixels.exists() and work.make == {f"{NAME}/pixels"}
    assert roll_out(small_recipe(), copy).digest == Release.open(small_release).digest


def test_counts_are_those_of_the_release_that_is_made(small_release, tmp_path):
    release = Release.open(small_release)
    before = {subset.name: subset for subset in count(make_plan(small_recipe(), tmp_path / "r"))}
    for name, subset in release.subsets.items():
        assert (before[name].done, before[name].left) == (0, len(subset.episodes))
        assert before[name].frames == 2 * 2 * 501  # two full shards of two episodes
        raw = sum(subset.raw_bytes for subset in before.values())
        assert sum(file.bytes for shard in release.shards([name]) for file in shard.files) < raw
    after = count(make_plan(small_recipe(), small_release))
    assert [(subset.done, subset.left, subset.frames, subset.raw_bytes) for subset in after] == [(3, 0, 0, 0)] * 3
    assert not (tmp_path / "r").exists()


def test_a_file_goes_before_a_shipped_recipe_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "laom").write_text((files("dmcvb_gen.generate") / "data/recipes/dmcvb-mini.yaml").read_text())
    assert load_recipe("laom") == load_recipe("dmcvb-mini") != load_recipe("quickstart")


def test_shipped_recipes_expand_to_what_the_paper_has():
    assert {"quickstart", "dmcvb-mini"} <= set(shipped_recipes())
    mini = expand(load_recipe("dmcvb-mini"))
    whole = expand(load_recipe("dmcvb-v1"))
    assert {request.name for request in mini} == {request.name for request in whole}
    assert load_recipe("dmcvb-v1").trajectories == "shared"  # as released
    locomotion = [request for request in whole if not is_maze(request.task)]
    assert len(locomotion) == 36 and all(request.episodes * 500 == 1_000_000 for request in locomotion)
    assert len(whole) == 36 + 7 * 2 * 2 + 7


SUBSET = {"tasks": "walker-walk", "levels": "random", "settings": "none", "episodes": 2}
BIG_SHARDS = SUBSET | {"episodes": 50, "max_steps": 1000}
SHARED = [SUBSET | {"settings": name, "episodes_per_shard": count} for name, count in (("none", 1), ("static", 2))]
NONSENSE = [
    ({"seed": -1}, RecipeError, "seed"),
    ({"name": "a/b"}, RecipeError, "name"),
    ({"colour": "red"}, RecipeError, "colour"),
    ({"action_repeat": 3}, RecipeError, "action_repeat: Input should be 1, 2 or 4"),
    ({"backgrounds": "/nowhere"}, DmcvbError, "give a folder of videos"),
    ({"license": "CC\nBY"}, DmcvbError, "license is not as a release may have it"),
    ({"size": 1024, "subsets": [BIG_SHARDS]}, DmcvbError, "is not as a release may have it: .*shards"),
    ({"subsets": SHARED}, RecipeError, "share their shards"),
    ({"subsets": []}, RecipeError, "subsets"),
    ({"subsets": [{"task": "walker-walk"}]}, RecipeError, "unknown field 'task'.*'tasks'"),
    ({"renderer": {"backend": "native", "sample": 2}}, RecipeError, "unknown field 'sample'. Did you mean 'samples'"),
]
NONSENSE_OF_SUBSETS = [
    ({"episodes": 0}, "greater than 0"),
    ({"episodes": 10**9}, "1,000,000,000 episodes; a release may have 10,000,000"),
    ({"episodes": 10**7}, "shards.*give more episodes_per_shard"),
    ({"episodes": None}, "say how much"),
    ({"steps": 500}, "not both"),
    ({"policies": {"expert": "x"}}, "has no use"),
    ({"policies": {"random": "x"}}, "has no use"),
    ({"levels": "expert", "policies": {"expert": "/nowhere.safetensors"}}, "nowhere"),
]


@pytest.mark.parametrize(
    "changes, error, words",
    NONSENSE + [({"subsets": [SUBSET | changes]}, DmcvbError, words) for changes, words in NONSENSE_OF_SUBSETS],
)
def test_recipes_that_make_no_sense_are_refused_before_any_work(tmp_path, changes, error, words):
    with pytest.raises(error, match=words):
        make_plan(make_recipe(small_recipe().model_dump(mode="json") | changes), tmp_path / "r")
    assert not (tmp_path / "r").exists()


def test_a_recipe_is_narrowed_to_what_has_the_asked_names():
    mini = load_recipe("dmcvb-mini")
    part = narrow(mini, ["walker-walk"], ["expert", "random"], ["dynamic"])
    names = [request.name for request in expand(part)]
    assert names == ["walker-walk/expert/dynamic", "walker-walk/random/dynamic"]
    mazes = expand(narrow(load_recipe("dmcvb-v1"), (), (), ["fixed"]))
    assert len(mazes) == 7 and {request.setting for request in mazes} == {"fixed"}
    with pytest.raises(UnknownNameError, match="task of recipe quickstart 'ant-maze-empty7x7'"):
        narrow(load_recipe("quickstart"), ["ant-maze-empty7x7"])
    with pytest.raises(RecipeError, match="no subset that is walker-walk, visible at once"):
        narrow(load_recipe("dmcvb-v1"), ["walker-walk"], (), ["visible"])


@pytest.mark.slow_cases("content1-not YAML")
@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b'{"levels": [' + b'"x", ' * 20_001 + b"]}", "over 100 kB"),  # a megabyte of it takes PyYAML ten seconds
        (b"[" * 50_000, "not YAML"),
        (b"name: \xff", "UTF-8"),
        (b"a: b: c", "not YAML"),
        (b"", "holds no recipe; begin it with"),
        (b"name: a\nsubsets: [%s, %s]" % (ONE, ONE), "asks for walker-walk/random/none twice; keep one"),
        (b"name: a\nsubsets: [%s]" % MAZES.replace(b"episodes", b"steps"), "vary in length, so give episodes: N"),
        (TWICE.encode(), r"subsets is given twice \(line 7\); keep one$"),
    ],
)
def test_what_is_no_recipe_is_refused_in_a_line(tmp_path, content, why):
    path = tmp_path / "recipe.yaml"
    path.write_bytes(content)
    with pytest.raises(RecipeError, match=why) as refused:
        expand(load_recipe(path))
    assert "\n" not in str(refused.value)


def test_a_recipe_takes_other_values_and_none_is_dropped():
    mini = narrow(load_recipe("dmcvb-mini"), ["walker-walk"])
    other = override(mini, episodes=5, seed=7, size=32, max_steps=50, deterministic=True)
    assert other.seed == 7 and other.size == 32
    for request in expand(other):
        assert request.episodes == 5 and request.max_steps == 50
        assert request.deterministic == (request.level != "random")
    whole = narrow(load_recipe("dmcvb-v1"), (), (), ["none"])
    assert {request.episodes for request in expand(override(whole, episodes=3))} == {3}
    both = override(load_recipe("dmcvb-mini"), episodes=3)
    assert {(request.setting == "fixed", request.episodes) for request in expand(both)} == {(False, 3), (True, 5)}
    more = override(load_recipe("dmcvb-mini"), episodes=12, fixed_goals=4)
    assert {request.episodes for request in expand(more)} == {12}
    with pytest.raises(RecipeError, match="--behaviour needs one task"):
        override(mini, behaviour="x")


def test_a_release_has_its_own_copies_of_policies_and_videos_and_no_place_of_this_machine(tmp_path):
    shutil.copytree(builtin_folder(), tmp_path / "mine/videos")
    shutil.copy(bundled_policies("walker-walk", "expert")[0], tmp_path / "mine/own.safetensors")
    mine = {"backgrounds": str(tmp_path / "mine/videos")}
    mine |= {"policies": {"expert": str(tmp_path / "mine/own.safetensors")}}
    recipe = short_recipe(levels="expert", settings="dynamic", episodes=1, max_steps=3, size=8, **mine)
    release = roll_out(recipe, tmp_path / "r")
    shutil.rmtree(tmp_path / "mine")
    for path in [*(tmp_path / "r").glob("*.json"), *(tmp_path / "r/recipes").iterdir()]:
        assert str(tmp_path) not in path.read_text()
    assert Regeneration(tmp_path / "r").check().sound
    [subset] = release.manifest.subsets
    assert subset.backgrounds["digest"] == load_backgrounds("builtin", "train").digest
    for split in ("train", "val"):
        copies = load_backgrounds(tmp_path / "r" / subset.backgrounds["source"], split)
        assert copies.digest == load_backgrounds("builtin", split).digest


def test_the_recipe_and_the_layers_name_everything_needed_to_make_it_again(small_release):
    release = Release.open(small_release)
    [recipe] = release.recipes
    assert make_recipe(recipe.recipe) == small_recipe()
    subset = release[NAME]
    trajectories, labels, images = subset.layers
    assert trajectories.makes["seed"] == 3 and labels.makes["videos"] == subset.record.backgrounds["digest"]
    assert images.makes["renderer"]["name"] == "native" and images.makes["of"] == labels.key
    [note] = [json.loads(path.read_text()) for path in (small_release / "provenance").iterdir()]
    assert {"mujoco", "numba", "numpy", "cpu", "system", "zarr"} <= set(note["environment"])


@pytest.mark.parametrize("task", ["walker-walk", "ant-maze-empty7x7"])
def test_a_dry_run_for_a_bucket_knows_policies_and_videos_that_are_not_there_yet(tmp_path, task):
    shutil.copytree(builtin_folder(), tmp_path / "videos")
    own = shutil.copy(bundled_policies(task, "expert")[0], tmp_path / "own.safetensors")
    videos = ["--distractor", "dynamic", "--backgrounds", str(tmp_path / "videos")] if task == "walker-walk" else []
    asked = ["rollout", task, "--level", "expert", "--behaviour", str(own), *videos, "--episodes", "1", "--size", "16"]
    sizes = ["--max-steps", "20", "--out", f"file://{tmp_path}/bucket"]
    result = invoke(*asked, *sizes, "--dry-run", "--json", code=0)
    assert json.loads(result.stdout)["frames"] > 0 and not (tmp_path / "bucket").exists()


def test_what_some_subsets_take_up_is_heard():
    """As rollouts ask for them: sampled actions, splits, and the episodes of fixed goals."""

    def asked(task, **given):
        return {request.name: request for request in expand(make_request([task], **given))}

    maze = "ant-maze-empty7x7"
    drawn = asked("walker-walk", levels=LEVELS, sample=True)
    assert len(drawn) == 4 and not any(request.deterministic for request in drawn.values())
    videos = asked("walker-walk", distractors=["none", "static_hard"], split="val")
    assert set(videos) == {"walker-walk/expert/none", "walker-walk/expert/static_hard"}
    assert asked(maze, goals="fixed", episodes=12)[f"{maze}/expert/fixed"].episodes == 5 * 3
    assert asked(maze, goals="fixed")[f"{maze}/expert/fixed"].episodes == 5 * 10
    both = asked(maze, goals=["visible", "fixed2"], episodes=4)
    assert [request.episodes for request in both.values()] == [4, 2 * 2]
    assert set(asked(maze, split="val")) == {f"{maze}/expert/visible"}


def test_shards_that_do_not_fit_in_memory_are_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr("dmcvb_gen.generate.executors.free_memory", lambda: 10_000)
    for workers in (1, 2):
        with pytest.raises(StoreError, match="B of memory.*--episodes-per-shard"):
            roll_out(small_recipe(), tmp_path / "r", workers=workers)
    assert not list((tmp_path / "r").rglob("c"))
