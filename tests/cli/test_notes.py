"""What commands say unasked, because silence would cost a user an afternoon."""

from __future__ import annotations

import json
import shutil

import imageio.v3 as imageio
import numpy as np
import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main

TINY = ["--level", "random", "--max-steps", "4", "--size", "16"]


def run(*words, code=0):
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == code, done.output
    return done.output


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    folder = tmp_path_factory.mktemp("notes") / "a"
    run("rollout", "walker-walk", *TINY, "--episodes", 3, "--out", folder)
    return folder


@pytest.fixture
def copy(release, tmp_path):
    return shutil.copytree(release, tmp_path / "a")


def test_a_release_that_gains_subsets_or_episodes_says_which(copy):
    assert "adds" not in run("rollout", "walker-walk", *TINY, "--episodes", 3, "--out", copy)
    said = run("rollout", "cheetah-run", *TINY, "--episodes", 1, "--out", copy)
    assert f"{copy} holds walker-walk-random 1.0.0 already; this adds cheetah-run/random/none." in said
    run("rollout", "pendulum-swingup", *TINY, "--episodes", 50, "--out", copy)
    said = run("rollout", "pendulum-swingup", *TINY, "--episodes", 51, "--out", copy)
    assert "this adds pendulum-swingup/random/none (1 episode more)." in said


def test_episodes_that_come_with_their_shard_are_counted(release, tmp_path):
    place = f"file:{tmp_path / 'published'}"
    run("publish", release, place)
    said = run("fetch", place, "--range", "0:1", "--out", tmp_path / "part")
    assert "Shards are fetched whole: walker-walk/random/none has the episodes 0:3; you asked for" in said
    assert "fetched whole" not in run("fetch", place, "--range", "0:3", "--out", tmp_path / "all")


@pytest.mark.parametrize("count", [1, 3])
def test_videos_that_are_kept_for_evaluation_are_counted(tmp_path, count):
    (tmp_path / "videos").mkdir()
    for index in range(count):
        frames = np.full((3, 32, 32, 3), 60 * index, np.uint8)
        imageio.imwrite(tmp_path / "videos" / f"{index}.gif", frames)
    words = ["rollout", "walker-walk", *TINY, "--distractor", "dynamic", "--backgrounds", tmp_path / "videos"]
    said = run(*words, "--episodes", 1, "--out", tmp_path / "out")
    assert ("2 of 3 videos" in said and "--split val" in said) == (count == 3)


def test_returns_of_short_episodes_are_marked(release, tmp_path):
    said = run("info", release)
    assert "walker-walk/random/none *" in said and "their returns cannot be compared" in said
    assert json.loads(run("info", release, "--json"))["subsets"][0]["other_length"] is True
    run("rollout", "walker-walk", "--level", "random", "--episodes", 1, "--no-pixels", "--out", tmp_path / "whole")
    assert "*" not in run("info", tmp_path / "whole")


@pytest.mark.slow
def test_checks_alone_name_no_profile(release, tmp_path):
    run("validate", release, "--checks-only", "--out", tmp_path / "v")
    for name in ("report.md", "report.html"):
        text = (tmp_path / "v" / name).read_text()
        assert "smoke" not in text and "no agent was trained" in text


def test_a_url_without_a_bucket_is_one_line(release, tmp_path):
    url = "s3://"
    for words in (["publish", release, url], ["fetch", url, "--out", tmp_path / "x"], ["info", url]):
        said = run(*words, code=2)
        assert said == f"error: {url} names no bucket; give {url}BUCKET/NAME\n"
