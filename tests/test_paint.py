"""Releases without pictures: made so or stripped, painted where they arrive or when they are read, equal to the bit."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import write_json
from dmcvb_gen.release.paint import paint_release, without_pictures
from dmcvb_gen.store import open_release
from dmcvb_gen.store.manifest import commit_path

TINY = [
    "--episodes",
    "3",
    "--episodes-per-shard",
    "2",
    "--max-steps",
    "6",
    "--size",
    "32",
    "--level",
    "random",
    "--renderer",
    "native",
]
RELEASES = {
    "walker": ["walker-walk", "--distractor", "none", "--distractor", "dynamic", *TINY],
    "maze": ["ant-maze-empty7x7", "--goal", "visible", "--goal", "hidden", *TINY],
}


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module", params=RELEASES)
def made(request, tmp_path_factory):
    """A painted release, and the same made without pictures."""
    folder = tmp_path_factory.mktemp(request.param)
    for name, more in {"painted": [], "light": ["--no-pixels"]}.items():
        result = run("rollout", *RELEASES[request.param], "--out", folder / name, "--json", *more)
        assert result.exit_code == 0, result.output
    return folder


def files(root):
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_painting_a_light_release_gives_the_files_of_a_painted_one(made, tmp_path):
    light = open_release(made / "light")
    subset = next(iter(light.subsets.values()))
    assert not subset.pixel_arrays and not subset.record.pixels and light.manifest.complete
    shutil_copy(made / "light", tmp_path / "copy")
    assert not any("/pixels" in name for name in files(tmp_path / "copy"))
    result = run("paint", tmp_path / "copy", "--workers", 2, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    assert told["shards"] == 4 and told["known"] == 0
    assert told["digest"] == open_release(made / "painted").manifest.digest
    mine, theirs = files(tmp_path / "copy"), files(made / "painted")
    assert {n: v for n, v in mine.items() if n != ".lock"} == {n: v for n, v in theirs.items() if n != ".lock"}


def shutil_copy(source, target):
    import shutil

    shutil.copytree(source, target)


def test_a_stripped_release_comes_back_whole_and_is_compared(made, tmp_path):
    without_pictures(made / "painted", tmp_path / "light")
    light = open_release(tmp_path / "light")
    assert all(commit.pictures and not commit.painted for s in light.subsets.values() for commit in s.commits.values())
    assert run("verify", tmp_path / "light").exit_code == 0
    done = paint_release(tmp_path / "light")
    assert (done.shards, done.known, done.differing, done.drift) == (4, 4, (), ())
    assert done.manifest.digest == open_release(made / "painted").manifest.digest
    assert paint_release(tmp_path / "light").shards == 0


def test_a_part_can_be_painted_and_the_rest_says_how(made, tmp_path):
    shutil_copy(made / "light", tmp_path / "light")
    name = next(iter(open_release(tmp_path / "light").subsets))
    done = paint_release(tmp_path / "light", only=[name], episodes=(0, 1))
    assert done.shards == 1
    subset = open_release(tmp_path / "light")[name]
    stored = open_release(made / "painted")[name]
    array = stored.pixel_arrays[0]
    assert np.array_equal(subset.read(array, [0, 1]), stored.read(array, [0, 1]))
    with pytest.raises(StoreError, match="dmcvb-gen paint"):
        subset.read(array, [2])
    with pytest.raises(StoreError, match="dmcvb-gen paint"):
        subset.episode(2)
    verified = run("verify", tmp_path / "light")
    assert verified.exit_code == 0, verified.output
    assert paint_release(tmp_path / "light").manifest.digest == open_release(made / "painted").manifest.digest


def test_other_pictures_than_the_known_ones_are_named(made, tmp_path):
    without_pictures(made / "painted", tmp_path / "light")
    subset = next(iter(open_release(tmp_path / "light").subsets.values()))
    commit = subset.commits[1]
    first = commit.pictures[0].model_copy(update={"sha256": "0" * 64})
    wrong = commit.model_copy(update={"pictures": (first, *commit.pictures[1:])})
    write_json(tmp_path / "light" / commit_path(subset.name, 1), wrong)
    result = run("paint", tmp_path / "light")
    assert result.exit_code == 1 and f"differs: {subset.name} shard 1" in result.output


def test_without_pictures_commands_say_how_to_get_them(made, tmp_path):
    subset = next(iter(dmcvb_gen.open(str(made / "light")).subsets.values()))
    with pytest.raises(StoreError, match="dmcvb-gen paint"):
        next(iter(subset.batches(2)))
    for command in (
        ["preview", made / "light", "--out", tmp_path / "p"],
        ["export", made / "light", "--to", "npz", "--out", tmp_path / "e"],
    ):
        result = run(*command)
        assert result.exit_code == 2 and "dmcvb-gen paint" in result.output, result.output


@pytest.mark.parametrize("which", ["light", "painted"])
def test_pictures_painted_on_reading_are_the_stored_ones(made, which):
    stored = dmcvb_gen.open(str(made / "painted"))
    fresh = dmcvb_gen.open(str(made / which), paint=True, cache_bytes=1)
    for name, subset in stored.subsets.items():
        for array in subset.pixel_arrays:
            assert np.array_equal(fresh[name].read(array), subset.read(array)), (name, array)
        one, other = (next(iter(s.batches(4, seed=1))) for s in (subset, fresh[name]))
        assert all(np.array_equal(one[key], other[key]) for key in one)


def test_fresh_distractors_change_pictures_alone_and_repeat_by_epoch(made):
    subset = next(reversed(dmcvb_gen.open(str(made / "light"), paint=True, distractors="resample").subsets.values()))
    array = subset.picture_names[0]
    before, state = subset.read(array, [0]), subset.read("state", [0])
    subset.set_epoch(1)
    after = subset.read(array, [0])
    assert (before != after).any() and np.array_equal(state, subset.read("state", [0]))
    subset.set_epoch(0)
    assert np.array_equal(before, subset.read(array, [0]))


def test_painted_episodes_are_kept_while_there_is_room(made):
    subset = next(iter(dmcvb_gen.open(str(made / "light"), paint=True).subsets.values()))
    assert subset.painted(0) is subset.painted(0)
    subset.painting.__dict__["cache_bytes"] = 1
    first = subset.painted(1)
    assert subset.painted(2) is not None and subset.painted(1) is not first


def test_a_torch_loader_with_workers_paints(made):
    import torch

    subset = next(iter(dmcvb_gen.open(str(made / "light"), paint=True).subsets.values()))
    loader = torch.utils.data.DataLoader(subset.torch("stream", batch_size=4), batch_size=None, num_workers=1)
    assert sum(len(batch["reward"]) for batch in loader) == subset.steps


def test_a_way_of_painting_that_there_is_not_is_refused(made):
    with pytest.raises(DmcvbError, match="resample"):
        dmcvb_gen.open(str(made / "light"), paint=True, distractors="new")


def test_a_release_travels_without_pictures_and_is_painted_where_it_arrives(made, tmp_path):
    url = f"file:{tmp_path / 'there'}"
    sent = run("publish", made / "painted", url, "--no-pixels")
    assert sent.exit_code == 0, sent.output
    assert not any("/pixels" in name for name in files(tmp_path / "there"))
    assert not [path for path in made.iterdir() if path.name.startswith(".")]
    light = sum(map(len, files(tmp_path / "there").values()))
    assert light < sum(map(len, files(made / "painted").values()))
    came = run("fetch", url, "--paint", "--out", tmp_path / "here")
    assert came.exit_code == 0 and "not those" not in came.output, came.output
    for name, subset in open_release(made / "painted").subsets.items():
        for array in subset.pixel_arrays:
            assert np.array_equal(open_release(tmp_path / "here")[name].read(array), subset.read(array))
    part = run("fetch", url, "--episodes", "0:1", "--paint", "--out", tmp_path / "part")
    assert part.exit_code == 0, part.output
    assert all(list(s.episodes) == [0, 1] and s.pixel_arrays for s in open_release(tmp_path / "part").subsets.values())
