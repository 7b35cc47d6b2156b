"""A reviewer's way: a part of a published release is fetched, its card held against it, its shards made again."""

from __future__ import annotations

import json
import shutil

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.writer import commit_path
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.plan import make_plan, prepare
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from tests.conftest import maze_recipe, rewrite, small_recipe

WALKER = {"tasks": "walker-walk", "levels": "random", "settings": ["none", "dynamic"], "episodes": 3}
RECIPES = {
    "walker": small_recipe(subsets=[WALKER | {"episodes_per_shard": 1, "max_steps": 60}]),
    "maze": maze_recipe(("visible", "hidden"), max_steps=60),
}


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module", params=RECIPES)
def published(request, tmp_path_factory):
    """URL of a release with a card."""
    folder = tmp_path_factory.mktemp(request.param)
    plan = prepare(make_plan(RECIPES[request.param], folder / "made"))
    for _ in run_jobs(plan.jobs):
        pass
    unfinished = run("verify", folder / "made")
    assert unfinished.exit_code == 3 and "not finished" in unfinished.output, unfinished.output
    assert run("rollout", "--out", folder / "made", "--finish").exit_code == 0
    assert run("verify", folder / "made").exit_code == 0
    write_card(folder / "made")
    publish(folder / "made", f"file:{folder / 'there'}")
    return f"file:{folder / 'there'}"


@pytest.fixture
def part(published, tmp_path):
    """Folder of a part of it: an episode of one subset."""
    name = next(iter(open_release(published).subsets))
    fetch(published, tmp_path / "part", [name], (0, 1))
    return tmp_path / "part"


def test_the_card_is_held_against_what_is_here(part):
    result = run("card", part, "--check")
    release = open_release(part)
    [subset] = release.subsets.values()
    left = sum(record.episodes for record in release.manifest.subsets) - len(subset.episodes)
    assert result.exit_code == 3 and f"fits the episodes that are here; {left} are not" in result.output

    def better(group):
        group["reward"][0, 0] += 0.5
        group["return"][0] += 0.5

    rewrite(part, subset.name, better)
    result = run("card", part, "--check")
    assert result.exit_code == 1 and "card/episodes.parquet does not fit the episodes that are here" in result.output
    write_card(part)  # one of its own
    assert check_card(part) == [] and run("card", part, "--check").exit_code == 0


def test_what_is_here_is_made_again_and_nothing_else(part):
    before = {path for path in part.rglob("*") if path.is_file()}
    checked = run("regenerate", part, "--check", "--json")
    told = json.loads(checked.stdout)
    assert checked.exit_code == 3 and told["sound"] and told["not_here"] > 0, checked.output
    assert [shard["equal"] for shard in told["shards"]] == [True]
    other = open_release(part).manifest.subsets[-1].name
    none = run("regenerate", part, "--check", "--only", other)
    assert none.exit_code == 3 and "none of these shards is here" in none.output
    [shard] = list(open_release(part).subsets.values())[0].commits.values()
    (part / shard.files[0].path).unlink()
    assert run("regenerate", part, "--check").exit_code == 1
    repaired = run("regenerate", part)
    assert repaired.exit_code == 0 and "1 shard made again" in repaired.output
    assert {path for path in part.rglob("*") if path.is_file()} - {part / ".lock"} == before - {part / ".lock"}
    assert verify(part).sound
    more = run("regenerate", part, "--only", other)
    assert more.exit_code == 0 and verify(part).sound and other in open_release(part).subsets


def test_a_part_that_was_repainted_or_has_grown_is_repaired_too(part, tmp_path):
    [subset] = open_release(part).subsets.values()
    maze = subset.task.startswith("ant")
    look = ["--size", "48"] if maze else ["--distractor", "static"]
    assert run("repaint", part, *look, "--out", tmp_path / "other").exit_code == 0
    fixed = ["--goal", "fixed", "--fixed-goals", "1", "--episodes-per-goal", "1"]
    grown = fixed if maze else ["--distractor", "static", "--episodes", "1"]
    more = ["--level", "random", *grown, "--max-steps", "5", "--size", "16", "--seed", "3"]
    added = run("rollout", subset.task, *more, "--out", part)
    assert added.exit_code == 0, added.output
    for folder in (tmp_path / "other", part):
        new = list(open_release(folder).subsets.values())[-1]
        assert new.name != subset.name or folder != part
        (folder / new.commits[0].files[0].path).write_bytes(b"damaged")
        assert run("verify", folder).exit_code == 1
        repaired = run("regenerate", folder)
        assert repaired.exit_code == 0 and "repaired" in repaired.output, repaired.output
        assert verify(folder).sound


def test_a_shard_that_is_lost_from_a_whole_release_is_no_part(published, tmp_path):
    fetch(published, tmp_path / "whole")
    shutil.rmtree(tmp_path / "whole" / "commits")
    assert run("regenerate", tmp_path / "whole", "--check").exit_code == 1


def test_a_part_whose_record_is_lost_is_made_again_only_with_the_bytes_that_its_index_lists(part):
    [subset] = open_release(part).subsets.values()
    [shard] = subset.commits
    record = part / commit_path(subset.name, shard)
    was = record.read_bytes()
    record.unlink()
    checked = json.loads(run("regenerate", part, "--check", "--only", subset.name, "--json").stdout)
    assert checked["not_here"] > 0 and checked["shards"] == []
    repaired = json.loads(run("regenerate", part, "--json").stdout)
    assert [(made["equal"], made["repaired"]) for made in repaired["shards"]] == [(True, True)]
    assert record.read_bytes() == was


def test_another_machines_part_whose_record_is_lost_stays_as_it_is(published, tmp_path):
    """This machine makes other bytes than it holds; only the list of the release's files can say so."""
    whole, part = tmp_path / "whole", tmp_path / "part"
    fetch(published, whole)
    name = next(iter(open_release(whole).subsets))

    def elsewhere(group):
        group["action"][0] = group["action"][0] * 0.5

    rewrite(whole, name, elsewhere)
    fetch(f"file:{whole}", part, [name], (0, 1))
    (part / commit_path(name, 0)).unlink()
    before = {path: path.read_bytes() for path in part.rglob("*") if path.is_file()}
    result = run("regenerate", part)
    assert result.exit_code == 1 and "other bytes" in result.output, result.output
    assert {path: path.read_bytes() for path in part.rglob("*") if path.is_file() and path.name != ".lock"}.items() <= (
        before.items()
    )
    beside = run("regenerate", part, "--only", name, "--episodes", "0:1", "--out", tmp_path / "beside")
    assert beside.exit_code == 1 and "other bytes" in beside.output, beside.output
