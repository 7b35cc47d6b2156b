"""No option goes unheard: what would change nothing is refused by its name."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.generate.plan import make_plan, start
from dmcvb_gen.generate.recipe import expand
from dmcvb_gen.spec import LEVELS
from tests.conftest import small_recipe

MAZE, WALKER = "ant-maze-empty7x7", "walker-walk"


def rollout(*arguments):
    return CliRunner().invoke(main, ["rollout", *map(str, arguments)])


@pytest.fixture
def asked(monkeypatch):
    """Subsets that a command line asks for; nothing is planned."""
    recipes = []

    def stop(recipe, *_, **__):
        recipes.append(recipe)
        raise click.Abort()

    def ask(*arguments):
        monkeypatch.setattr("dmcvb_gen.generate.plan.make_plan", stop)
        result = rollout(*arguments)
        assert result.exit_code == 1, result.output
        return {request.name: request for request in expand(recipes[-1])}

    return ask


def assert_refused(result, options, cure):
    """One line, which names one of the options and the cure."""
    said = next(line for line in result.stderr.splitlines() if line.lower().startswith("error: "))
    assert result.exit_code == 2 and cure in said and any(option in said for option in options), said


@pytest.mark.parametrize(
    "arguments, cure",
    [
        ([WALKER, "--goal", "hidden"], "--goal is for mazes"),
        ([MAZE, "--distractor", "dynamic"], "no effect in mazes, which vary in style; ask for --goal"),
        ([WALKER, "--backgrounds", "builtin"], "--distractor static or dynamic"),
        ([MAZE, "--backgrounds", "builtin"], "no subset shows videos"),
        ([WALKER, "--split", "val"], "--distractor static or dynamic"),
        ([WALKER, "--distractor", "dynamic_camera", "--backgrounds", "builtin"], "shows videos"),
        ([WALKER, "--distractor", "dynamic_camera-light", "--split", "val"], "shows videos"),
        ([WALKER, "--level", "random", "--sample"], "level random is always drawn"),
        ([MAZE, "--independent"], "always have their own episodes"),
        ([WALKER, "--option", "a=b"], "is a folder"),
        ([WALKER, "--workers", "2", "--executor", "ray"], "remove it"),
        ([WALKER, "--ray-address", "x:1"], "--executor ray"),
        ([WALKER, "--behaviour", ""], "is empty"),
    ],
)
def test_an_option_that_would_change_nothing_is_refused_with_the_cure(tmp_path, monkeypatch, arguments, cure):
    monkeypatch.chdir(tmp_path)
    options = [word for word in arguments if word.startswith("--")]
    assert_refused(rollout(*arguments), options, cure)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words, cure",
    [
        ("info r --option a=b", "r is a folder"),
        ("diff r r --option a=b", "r is a folder"),
        ("status r --option a=b", "r is a folder"),
        ("publish r mine --option a=b", "mine is a folder"),
        ("fetch r --out mine --option a=b", "r is a folder"),
        ("export r --to hdf5 --out mine --option a=b", "r is a folder"),
        ("evaluate-behaviour walker-walk --level random --behaviour x", "level random has no policy"),
        ("evaluate-behaviour walker-walk --level random --sample", "level random is always drawn"),
        ("card r --check --url file:/x", "--check writes no card"),
        ("card r --check --out x", "--check writes no card"),
        ("validate r --agents state-bc,bc --dino-weights x", "add --agents dino+bc"),
        ("validate r --dino-weights x", "add --agents dino+bc"),
    ],
)
def test_other_commands_refuse_what_has_no_effect(words, cure, small_release, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r").symlink_to(small_release)
    result = CliRunner().invoke(main, words.split())
    assert_refused(result, [word for word in words.split() if word.startswith("--")], cure)
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


@pytest.mark.parametrize(
    "options, cure",
    [
        (["--distractor", "none", "--backgrounds", "builtin"], "--distractor static or dynamic"),
        (["--distractor", "none", "--split", "val"], "--distractor static or dynamic"),
        (["--level", "random", "--sample"], "level random is always drawn"),
    ],
)
def test_also_beside_a_recipe(options, cure):
    result = rollout("--recipe", "dmcvb-mini", WALKER, *options, "--dry-run")
    assert_refused(result, [word for word in options[2:] if word.startswith("--")], cure)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--seed", "5"], "TASKs or --recipe"),
        (["--independent"], "TASKs or --recipe"),
    ],
)
def test_a_release_that_goes_on_from_its_manifest_says_what_it_cannot_take(tmp_path, arguments, words):
    start(make_plan(small_recipe(), tmp_path / "r"))
    result = rollout("--out", tmp_path / "r", *arguments)
    assert result.exit_code == 2 and words in result.output + result.stderr


def test_what_some_subsets_take_up_is_heard(asked):
    levels = [word for level in LEVELS for word in ("--level", level)]
    drawn = asked(WALKER, *levels, "--sample")
    assert len(drawn) == 4 and not any(request.deterministic for request in drawn.values())
    settings = ["--distractor", "none", "--distractor", "static_hard", "--split", "val"]
    assert set(asked(WALKER, *settings)) == {f"{WALKER}/expert/none", f"{WALKER}/expert/static_hard"}
    assert asked(MAZE, "--goal", "fixed", "--episodes", "12")[f"{MAZE}/expert/fixed"].episodes == 5 * 3
    assert asked(MAZE, "--goal", "fixed")[f"{MAZE}/expert/fixed"].episodes == 5 * 10
    both = ["--goal", "visible", "--goal", "fixed2", "--episodes", "4"]
    assert [request.episodes for request in asked(MAZE, *both).values()] == [4, 2 * 2]
    assert set(asked(f"{MAZE}@geodesic", "--split", "val")) == {f"{MAZE}-geodesic/expert/visible"}


@pytest.mark.parametrize(
    "words, flag",
    [
        (("s3://bucket/r", "--executor", "ray"), "--executor"),
        (("s3://bucket/r", "--backgrounds", "videos"), "--backgrounds"),
        ((".", "--all"), "--all"),
        ((".", "--option", "endpoint_url=http://127.0.0.1:1"), "--option"),
    ],
)
def test_verify_refuses_what_is_for_the_other_kind_of_place(words, flag):
    result = CliRunner().invoke(main, ["verify", *words])
    assert result.exit_code == 2 and f"{flag} has no effect" in result.output.replace("\n", " ")
