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
from dmcvb_gen.benchmarks.validate import make_budget
from dmcvb_gen.cli import COMMANDS, main
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError

FUNCTIONS = ("rollout", "paint", "repaint", "regenerate", "verify", "publish", "fetch", "export", "validate")
FUNCTIONS += ("train_behaviour", "evaluate_behaviour")
FAMILIES = {
    "locomotion": dict(tasks="walker-walk", distractors=["none", "dynamic"]),
    "suite": dict(tasks="cartpole-swingup", levels="random", distractors="static"),
    "maze": dict(tasks="ant-maze-empty7x7", goals="visible"),
}
TINY = dict(episodes=2, max_steps=8, size=32, episodes_per_shard=1, progress=False)
COMMANDS_ALONE = {"as_json", "dry_run", "strict", "own", "list_settings"}
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


def test_every_file_and_folder_may_be_a_path(tmp_path, monkeypatch):
    """Runs and reports are written as JSON, which has no paths."""
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
