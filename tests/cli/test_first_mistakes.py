"""What newcomers did wrong, or read and did not understand: each answer says what is the matter and names the cure."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset.manifest import record_path
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.extras import install_hint
from dmcvb_gen.generate.recipe import load_recipe
from dmcvb_gen.policies.bundled import bundled_policies

NAME = "walker-walk/random/none"
TINY = ["--max-steps", "4", "--size", "16", "--episodes", "2"]


def run(*words, code=0):
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == code, done.output
    return done.output


@pytest.fixture
def copy(small_release, tmp_path):
    return shutil.copytree(small_release, tmp_path / "copy")


# -- recipes and options --------------------------------------------------------------------------

WRONG_RECIPES = {
    "subsets:\n  tasks: walker-walk": "subsets: give a list",
    "subsets:\n- {task: walker-walk, levels: random, settings: none, episodes: 1}": "unknown field 'task'.*'tasks'",
    "subsets:\n- {levels: random, settings: none, episodes: 1}": "subsets.0.tasks: is missing",
    "subsets: [walker-walk]": "subsets.0: give fields on lines of their own: tasks, levels",
    "version: 1.0": 'version: give text; quote what looks like a number, e.g. "1.0.0"',
    "version: one": 'version: give three numbers, e.g. "1.0.0"',
    "renderer: native": "renderer: give fields on lines of their own: backend: native",
    "renderer: {backend: native, samples: 3}": "samples: Input should be 1, 2, 4 or 8",
    "renderer: {backend: native, sample: 2}": "unknown field 'sample'. Did you mean 'samples'",
}


@pytest.mark.parametrize("text", WRONG_RECIPES)
def test_a_wrong_field_of_a_recipe_is_told_with_what_to_write(text, tmp_path):
    subsets = "subsets:\n- {tasks: walker-walk, levels: random, settings: none, episodes: 1}\n"
    (tmp_path / "r.yaml").write_text("name: mine\n" + ("" if text.startswith("subsets") else subsets) + text)
    with pytest.raises(DmcvbError, match=WRONG_RECIPES[text]):
        load_recipe(tmp_path / "r.yaml")


def test_a_file_that_holds_no_recipe_says_what_is_wrong_with_it(tmp_path):
    (tmp_path / "empty.yaml").touch()
    with pytest.raises(DmcvbError, match="holds no recipe; begin it with"):
        load_recipe(tmp_path / "empty.yaml")
    (tmp_path / "open.yaml").write_text("name: [mine\n")
    with pytest.raises(DmcvbError, match="open.yaml: not YAML") as caught:
        load_recipe(tmp_path / "open.yaml")
    assert "shipped" not in str(caught.value)


TWICE = """name: dup
base: &base {episodes: 1}
subsets:
- {tasks: walker-walk, levels: random, settings: none, <<: *base, episodes: 2}
- *base

subsets:
- {tasks: cheetah-run, levels: random, settings: none, episodes: 1}
"""


def test_a_field_that_is_given_twice_is_told_with_its_line(tmp_path):
    """Line 7 has the second `subsets`; what a merge key brings may be given again."""
    (tmp_path / "dup.yaml").write_text(TWICE)
    with pytest.raises(DmcvbError, match=r"dup\.yaml: subsets is given twice \(line 7\); keep one$"):
        load_recipe(tmp_path / "dup.yaml")
    (tmp_path / "inner.yaml").write_text("name: mine\nsubsets:\n- tasks: walker-walk\n  tasks: cheetah-run\n")
    with pytest.raises(DmcvbError, match=r"tasks is given twice \(line 4\)"):
        load_recipe(tmp_path / "inner.yaml")
    merged = "- &first {tasks: walker-walk, levels: random, settings: none, episodes: 1}\n- {<<: *first, episodes: 2}\n"
    (tmp_path / "merged.yaml").write_text(f"name: mine\nsubsets:\n{merged}")
    assert [pattern.episodes for pattern in load_recipe(tmp_path / "merged.yaml").subsets] == [1, 2]


@pytest.mark.parametrize("words, told", [
    (["walker-walk", "--level", "expert,medium"], "unknown level 'expert,medium'"),
    (["foo.txt"], "cannot read layout foo.txt"),
    (["walker-walk", "--level", "expert", "--behaviour", "mine.py"], "give --behaviour mine:FUNCTION"),
    (["walker-walk", "--level", "expert", "--behaviour", "mine.py:swing"], "give --behaviour mine:swing"),
    (["walker-walk", "--samples", "3"], "samples: Input should be 1, 2, 4 or 8"),
])  # fmt: skip
def test_an_option_that_cannot_be_is_answered_by_its_own_name(words, told, tmp_path):
    said = run("rollout", *words, *TINY, "--out", tmp_path / "out", code=2)
    assert told in said and not (tmp_path / "out").exists()


# -- releases that are there ----------------------------------------------------------------------


def test_a_level_has_one_behaviour_in_a_release(tmp_path):
    expert = ["rollout", "walker-walk", "--level", "expert", *TINY, "--out", tmp_path / "a"]
    run(*expert)
    other = bundled_policies("walker-walk", "medium")[0]
    said = run(*expert, "--distractor", "static", "--behaviour", other, code=2)
    assert "walker-walk/expert/trajectories has policies" in said and "choose another --out" in said
    planned = run(*expert, "--distractor", "static", "--dry-run")
    assert "holds walker-walk-expert 1.0.0 already; this adds walker-walk/expert/static" in planned
    run(*expert, "--distractor", "static")


def test_a_release_without_images_says_how_to_get_them(tmp_path):
    words = ["rollout", "walker-walk", "--level", "random", *TINY]
    run(*words, "--no-pixels", "--out", tmp_path / "light")
    run(*words, "--out", tmp_path / "painted")
    assert f"No images are stored; add them: dmcvb-gen paint {tmp_path / 'light'}" in run("info", tmp_path / "light")
    assert "No images" not in run("info", tmp_path / "painted")
    assert f"dmcvb-gen paint {tmp_path / 'light'}" in run("preview", tmp_path / "light", code=2)
    found = run("diff", tmp_path / "painted", tmp_path / "light", code=1)
    assert "walker-walk/random/none/pixels: only in the first" in found and "other bytes" not in found


def test_a_label_given_twice_is_stored_once(copy, tmp_path):
    twice = ["--label", "depth", "--label", "depth"]
    run("repaint", copy, *twice, "--only", "*/none", "--out", tmp_path / "depth")
    assert "depth" in dmcvb_gen.open(str(tmp_path / "depth"))[NAME].arrays


READ = """
import sys, dmcvb_gen
subset = dmcvb_gen.open(sys.argv[1])["walker-walk/random/dynamic"]
try:
    for step in range(0, 1500, 10):
        subset.source(stack=3)[step]
except dmcvb_gen.errors.StoreError as error:
    print("caught", error)
"""


def test_a_damaged_chunk_is_one_line_in_python(copy):
    files = [path for path in (copy / "walker-walk/random.zarr/dynamic/pixels").rglob("*") if path.is_file()]
    for path in (path for path in files if path.name != "zarr.json"):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 255
        path.write_bytes(data)
    read = subprocess.run([sys.executable, "-c", READ, str(copy)], capture_output=True, text=True, check=True)
    assert read.stdout.startswith("caught") and "Stored:" not in read.stdout and read.stderr == ""


def test_late_and_open_shards_are_counted_once(copy):
    (copy / record_path(f"{NAME}/labels", 0)).unlink()
    [row] = [line for line in run("status", copy).splitlines() if line.startswith(NAME)]
    assert row.split()[1:] == ["1", "1", "0"]


def test_a_url_where_a_folder_is_needed_says_how_to_get_one(tmp_path):
    said = run("paint", "s3://bucket/demo", code=2)
    assert "s3://bucket/demo is a URL; give a local one, or fetch" in said
    assert "dmcvb-gen fetch s3://bucket/demo --paint --out FOLDER" in said
    assert "s3://bucket/demo is a URL; give a local one, a folder or file" in run(
        "fetch", "file:x", "--out", "s3://bucket/demo", code=2
    )


def test_a_manifest_is_always_compared_so_check_is_refused_at_once(small_release, tmp_path):
    for more in ([], ["--out", tmp_path / "z"]):
        said = run("regenerate", "--manifest", "quickstart", "--check", *more, code=2)
        assert "remove --check: with --manifest, digests are always compared" in said
        assert ("add --out FOLDER" in said) == (not more)
    assert "give --check or --out, not both" in run("regenerate", small_release, "--check", "--out", "z", code=2)


def test_a_missing_pyarrow_names_the_extra_of_cards_first():
    assert "the extra [hf] or [lerobot]" in install_hint("pyarrow")


# -- policies and scores --------------------------------------------------------------------------


def still(observation):
    return np.zeros((len(observation["state"]), 6))


def test_an_evaluation_of_one_episode_has_no_standard_error():
    assert math.isnan(dmcvb_gen.evaluate(still, "walker-walk/none", episodes=1, max_steps=2, pixels=False).stderr)


def test_what_an_evaluation_cannot_be_of_is_said():
    with pytest.raises(DmcvbError, match="names a subset; .* give walker-walk/dynamic"):
        dmcvb_gen.evaluate(still, "walker-walk/expert/dynamic")
    with pytest.raises(DmcvbError, match="shows no videos, so backgrounds have no effect"):
        dmcvb_gen.evaluate(still, "walker-walk/none", backgrounds="videos")


def test_one_view_may_be_named_alone(small_release):
    subset = dmcvb_gen.open(str(small_release))[NAME]
    assert subset.source(pictures="pixels")[0]["pixels"].shape == (9, 16, 16)
    with pytest.raises(UnknownNameError, match="unknown view 'agent'"):
        subset.source(pictures="agent")
    with pytest.raises(UnknownNameError, match="option of painting 'distractor'. Did you mean 'distractors'"):
        dmcvb_gen.open(str(small_release), paint=True, distractor="resample")


SWING = """
import numpy as np

def swing(observations, generator):
    return generator.normal(size=(len(observations), 6)).clip(-1, 1)
"""


def test_a_function_of_ones_own_is_named_beside_its_returns(tmp_path, monkeypatch):
    (tmp_path / "swinging.py").write_text(SWING)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DMCVB_GEN_BEHAVIOURS", raising=False)
    said = run("evaluate-behaviour", "walker-walk", "--behaviour", "swinging:swing", "--episodes", 2)
    assert "swinging:swing" in said and "mean actions" not in said


@pytest.mark.slow
def test_a_selection_that_picks_nothing_says_why_wherever_one_looks(tmp_path):
    settings = [f"--set={pair}" for pair in ("warmup_steps=100", "compile=false", "batch_size=16")]
    folder = tmp_path / "run"
    run("train-behaviour", "cheetah-run", "--steps", 120, "--evaluate-every", 120, *settings, "--out", folder)
    found = json.loads(run("select-checkpoints", folder, "--json", "--episodes", 2, code=1), parse_constant=pytest.fail)
    assert found["convergence"]["error"] is None
    said = run("select-checkpoints", folder, "--episodes", 2, code=1)
    assert "nan" not in said and f"{folder}/selected" not in said and "selection.json" in said
    for words in (["evaluate-behaviour", "cheetah-run"], ["rollout", "cheetah-run", "--level", "expert", *TINY]):
        said = run(*words, "--behaviour", folder, code=2)
        assert "at least 2 are needed" in said and "select-checkpoints" not in said


def test_subsets_that_only_leaves_out_are_not_missed(small_release, tmp_path):
    asked = ["validate", small_release, "--profile", "smoke", "--agents", "state-bc", "--workers", 1, "--threads", 1]
    said = run(*asked, "--only", NAME, "--out", tmp_path / "report")
    assert "not in the release" not in said


def test_a_maze_of_ones_own_without_a_policy_is_told_how_to_train_one(tmp_path):
    (tmp_path / "ring.txt").write_text("*****\n*   *\n* * *\n*   *\n*****\n")
    said = run("rollout", tmp_path / "ring.txt", "--level", "expert", "--out", tmp_path / "out", code=2)
    assert "`dmcvb-gen train-behaviour --layout FILE`" in said and "**" not in said


def test_mistakes_in_what_is_validated_are_told_before_any_work(small_release, tmp_path, monkeypatch):
    monkeypatch.setattr("dmcvb_gen.benchmarks.report.check_structure", lambda *_: pytest.fail("work was done"))
    for words, told in (
        (["--benchmark", "b9"], "unknown benchmark 'b9'"),
        (["--benchmark", "b3"], "has no data"),
        (["--agent", "nowhere:x"], "cannot find agent nowhere:x"),
        (["--only", "foo*"], "unknown subset pattern 'foo*'"),
    ):
        assert told in run("validate", small_release, *words, "--out", tmp_path / "out", code=2)
