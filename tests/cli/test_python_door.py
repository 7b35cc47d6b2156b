"""Python is a door as good as the command line: every command of data is a function of the same name."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re

import click
import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.benchmarks.report import make_budget
from dmcvb_gen.cli import COMMANDS, main
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.options import with_parameters

FUNCTIONS = ("rollout", "paint", "repaint", "regenerate", "verify", "publish", "fetch", "export", "validate")
FUNCTIONS += ("train_behaviour", "evaluate_behaviour")
FAMILIES = {
    "locomotion": dict(tasks="walker-walk", distractors=["none", "dynamic"]),
    "suite": dict(tasks="cartpole-swingup", levels="random", distractors="static"),
    "maze": dict(tasks="ant-maze-empty7x7", goals="visible"),
}
TINY = dict(episodes=2, max_steps=8, size=32, episodes_per_shard=1, progress=False)
COMMANDS_ALONE = {"as_json", "dry_run", "strict", "executor", "ray_address", "own", "list_settings"}
"""Options that say how something is printed, only print, begin and end a release of many machines, or belong to another
one."""


@pytest.fixture(scope="module", params=FAMILIES)
def family(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("door")
    return folder, dmcvb_gen.rollout(out=folder / "r", **FAMILIES[request.param], **TINY)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_command_has_the_options_of_its_function(name):
    command = main.get_command(None, name.replace("_", "-"))
    parameters = dict(inspect.signature(getattr(dmcvb_gen, name)).parameters)
    assert command.name in COMMANDS and name in dmcvb_gen.__all__
    options = {parameter.name: parameter for parameter in command.params if parameter.name not in COMMANDS_ALONE}
    assert options.keys() == parameters.keys() - {"progress", "notify", "on_score"}
    words = []
    for option in options.values():
        assert option.required == (parameters[option.name].default is inspect.Parameter.empty)
        assert isinstance(option, click.Argument) or option.help.strip()
        if option.required:
            words += ["x"] if isinstance(option, click.Argument) else [option.opts[0], "x"]
    parsed = command.make_context(name, words).params
    for option in options.values():
        default = "x" if option.required else parameters[option.name].default
        assert parsed[option.name] == default or not (parsed[option.name] or default), option.name


def test_the_help_of_rollout_states_the_defaults_of_recipes():
    """They are those of `Recipe` and `SubsetPattern`, which other arguments of `rollout` override."""
    from dmcvb_gen.generate.recipe import NATIVE, Recipe, SubsetPattern
    from dmcvb_gen.generate.request import EPISODES

    fields = Recipe.model_fields | SubsetPattern.model_fields
    stated = {
        option.name: found[1]
        for option in main.get_command(None, "rollout").params
        if (found := re.search(r"\[default: ([^];]*)", getattr(option, "help", "") or ""))
    }
    for name in ("seed", "size", "backgrounds", "split"):
        assert stated[name] == str(fields[name].default)
    assert stated["renderer"] == NATIVE and stated["episodes"] == str(EPISODES)


@pytest.mark.slow_cases("locomotion", "maze", "suite")
def test_a_whole_release_goes_through_python(family):
    folder, release = family
    assert not release.shortfalls
    assert dmcvb_gen.verify(folder / "r", progress=False).sound
    assert dmcvb_gen.validate(folder / "r", checks_only=True, out=folder / "report", progress=False).sound
    assert dmcvb_gen.regenerate(folder / "r", check=True, progress=False).sound
    url = f"file:{folder / 'published'}"
    assert dmcvb_gen.publish(folder / "r", url, pixels=False, progress=False).moved > 0
    light = dmcvb_gen.fetch(url, folder / "light", progress=False)
    assert light.digest is not None
    painted = dmcvb_gen.paint(folder / "light", progress=False)
    assert painted.known == painted.shards > 0 and not painted.differing
    name = next(iter(release))
    one, other = release[name].episode(0), dmcvb_gen.open(str(folder / "light"))[name].episode(0)
    for key in one:
        np.testing.assert_array_equal(np.asarray(one[key]), np.asarray(other[key]))
    larger = dmcvb_gen.repaint(folder / "r", out=folder / "large", size=24, progress=False)
    assert {subset.size for subset in larger.manifest.subsets} == {24}
    [*folders] = dmcvb_gen.export(folder / "r", "hdf5", folder / "h5", progress=False)
    assert len(folders) == len(release.manifest.subsets) and all(path.is_dir() for path in folders)


def test_the_command_line_makes_the_same_bytes(tmp_path):
    from click.testing import CliRunner

    words = "rollout walker-walk --level expert --distractor dynamic --episodes 1 --max-steps 5 --size 16 --out"
    assert CliRunner().invoke(main, [*words.split(), str(tmp_path / "cli")]).exit_code == 0
    given = dict(levels="expert", distractors="dynamic", episodes=1, max_steps=5, size=16, progress=False)
    made = dmcvb_gen.rollout("walker-walk", out=tmp_path / "python", **given)
    assert made.digest == Release.open(tmp_path / "cli").digest
    assert dmcvb_gen.rollout(out=tmp_path / "python", progress=False).digest == made.digest


def test_shipped_recipes_and_manifests_by_name(tmp_path):
    given = dict(levels="random", distractors="none", episodes=1, max_steps=4, size=16, progress=False)
    made = dmcvb_gen.rollout(recipe="quickstart", out=tmp_path / "r", **given)
    assert list(made) == ["walker-walk/random/none"]
    with pytest.raises(UnknownNameError, match="quickstart"):
        dmcvb_gen.regenerate(manifest="quickstrat", out=tmp_path / "x", progress=False)


@pytest.mark.slow_cases("locomotion", "maze")
def test_every_file_and_folder_may_be_a_path(family, tmp_path, monkeypatch):
    """Runs and reports are written as JSON, which has no paths."""
    folder, _ = family
    budget = make_budget(backgrounds=tmp_path / "videos", dino_weights=tmp_path / "weights")
    json.dumps(dataclasses.asdict(budget))
    begun = []

    def stop(_, config, __):
        begun.append(json.dumps(dataclasses.asdict(config)))
        raise DmcvbError("enough")

    monkeypatch.setattr("dmcvb_gen.training.run.open_run", stop)
    with pytest.raises(DmcvbError, match="enough"):
        dmcvb_gen.train_behaviour("walker-walk", out=tmp_path / "run", init_from=tmp_path / "other", progress=False)
    assert str(tmp_path / "other") in begun[0]


def two_rings(folder):
    """Two layouts of one name."""
    for name, row in (("a", "*   *"), ("b", "* * *")):
        (folder / name).mkdir()
        (folder / name / "ring.txt").write_text(f"*****\n*   *\n{row}\n*   *\n*****\n")
    return [folder / "a/ring.txt", folder / "b/ring.txt"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda out: dmcvb_gen.rollout("walker-wlak", out=out), "walker-walk"),
        (lambda out: dmcvb_gen.rollout(), "recipe"),
        (
            lambda out: dmcvb_gen.rollout("walker-walk", episodes=0, out=out),
            "^episodes is 0: input should be",
        ),
        (
            lambda out: dmcvb_gen.rollout("walker-walk", episodes=2.5, out=out),
            "^episodes is 2.5: input",
        ),
        (
            lambda out: dmcvb_gen.rollout("walker-walk", size="large", out=out),
            "^size is 'large': input",
        ),
        (lambda out: dmcvb_gen.rollout("ant-maze-empty7x7@geodesik", out=out), "geodesic"),
        (lambda out: dmcvb_gen.paint(out, views=[]), "views names no view"),
        (
            lambda out: dmcvb_gen.evaluate_behaviour("walker-walk", episodes=1),
            "^episodes is 1: input should be",
        ),
        (lambda out: dmcvb_gen.rollout("ant-maze-empty7x7", distractors="dynamic", out=out), "goal"),
        (lambda out: dmcvb_gen.rollout("walker-walk", episodes=2, steps=9, out=out), "not both"),
        (
            lambda out: dmcvb_gen.rollout("walker-walk", levels="random", sample=True, out=out),
            "level random is always drawn",
        ),
        (lambda out: dmcvb_gen.regenerate(manifest="quickstart"), "out=FOLDER"),
        (lambda out: dmcvb_gen.verify(out, everything=True), "always read whole"),
        (lambda out: dmcvb_gen.fetch("file:/nowhere", out, size=32), "paint=True"),
        (lambda out: dmcvb_gen.export(out, "hdf5", out / "x"), "no release"),
        (lambda out: dmcvb_gen.validate(out, checks_only=True, agents="bc"), ": checks_only trains nothing"),
        (lambda out: dmcvb_gen.validate(out, checks_only=True, profile="paper"), "^profile has no effect"),
        (lambda out: dmcvb_gen.validate(out, agents="bc,state-bc"), "no release"),
        (lambda out: dmcvb_gen.validate(out, scale=float("inf")), "^scale is inf: input should be "),
        (
            lambda out: dmcvb_gen.fetch("file:publ", out, episode_range="0:2"),
            r"^episode_range is '0:2': input should be a valid tuple",
        ),
        (lambda out: dmcvb_gen.paint(out, episode_range=5), "^episode_range is 5: input should be a valid tuple"),
        (lambda out: dmcvb_gen.regenerate(out, episode_range=(0,)), r"^episode_range is \(0,\): "),
        (
            lambda out: dmcvb_gen.export(out, "npz", out, episode_range=(0.5, 1.5)),
            r"^episode_range is \(0.5, 1.5\): input should be a valid integer",
        ),
        (lambda out: dmcvb_gen.fetch("file:publ", out, episode_range=(2, 2)), "with 0 <= A < B"),
        (lambda out: dmcvb_gen.fetch("file:publ", out, episode_range=(-1, 2)), "with 0 <= A < B"),
        (lambda out: dmcvb_gen.rollout("walker-walk", episode_range="0:1", out=out), "^episode_range is '0:1': input"),
        (
            lambda out: dmcvb_gen.rollout("walker-walk", workers=-3, out=out),
            "^workers is -3: input should be greater than or equal to 1",
        ),
        (lambda out: dmcvb_gen.rollout("walker-walk", workers=0, out=out), "^workers is 0: input should be greater"),
        (lambda out: dmcvb_gen.rollout(None, out=out), "^tasks is None"),
        (lambda out: dmcvb_gen.rollout("walker-walk", behaviour="", out=out), "behaviour is empty; leave it out"),
        (
            lambda out: dmcvb_gen.rollout(two_rings(out.parent), out=out),
            "two mazes are called ant-maze-ring; re",
        ),
        (
            lambda out: dmcvb_gen.evaluate_behaviour("ant-maze-empty7x7", levels="random", pictures="s3://bucket/x"),
            "is a URL; give a local one",
        ),
        (lambda out: dmcvb_gen.verify(None), "^release is None: input should be"),
        (lambda out: dmcvb_gen.repaint(out, out=None), "^out is None: input should be"),
        (lambda out: dmcvb_gen.fetch(None, out), "^url is None: input should be"),
    ],
)
def test_errors_are_those_of_the_commands(call, message, tmp_path):
    with pytest.raises(DmcvbError, match=message) as caught:
        call(tmp_path / "out")
    assert " --" not in re.sub("`[^`]*`|dmcvb-gen [^;,]*", "", f" {caught.value}"), "a flag, which Python has not"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "message, named",
    [
        ("choose another --out, or fewer --episodes", "choose another out, or fewer episodes"),
        ("select with --only and --range", "select with only and episode_range"),
        ("see `info --json`; add --checks-only", "see `info --json`; add checks_only"),
        (
            "run dmcvb-gen fetch URL --out FOLDER; or leave --paint",
            "run dmcvb-gen fetch URL --out FOLDER; or leave paint",
        ),
    ],
)
def test_messages_of_functions_name_parameters(message, named):
    assert with_parameters(message) == named


def test_arguments_may_be_paths_numpys_numbers_and_iterators(tmp_path):
    few = dict(episodes=np.int64(1), max_steps=np.int32(2), size=np.uint8(16), progress=False)
    few |= dict(episode_range=[np.int64(0), np.uint8(1)])
    layout = tmp_path / "ring.txt"
    layout.write_text("*****\n*   *\n* * *\n*   *\n*****\n")
    made = dmcvb_gen.rollout(layout, levels=iter(["random"]), out=tmp_path / "maze", **few)
    assert list(made) == ["ant-maze-ring/random/visible"]
    made = dmcvb_gen.rollout(iter(["walker-walk"]), levels="random", out=tmp_path / "walker", **few)
    assert made["walker-walk/random/none"].record.size == 16
    rows = dmcvb_gen.evaluate_behaviour("walker-walk", levels=(level for level in ["random"]), episodes=2)
    assert [row["level"] for row in rows] == ["random"]
