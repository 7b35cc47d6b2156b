"""The viewer's page, driven in headless Chromium: it plays, scrubs, changes subset, and compares two distractors."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.viewer import view
from tests.conftest import invoke, roll_out, short_recipe

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SCRIPTS = ("watch_viewer.js", "drive_viewer.js")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")


def drive(page):
    """What the page shows while its controls are used, as the driver writes it down."""
    watch, drive = (f"<script>{Path(__file__).with_name(name).read_text()}</script>" for name in SCRIPTS)
    test = page.with_name("driven.html")
    test.write_text(page.read_text().replace("<head>", "<head>" + watch).replace("</body>", drive + "</body>"))
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--dump-dom"]
    profile = f"--user-data-dir={page.parent / 'profile'}"
    done = subprocess.run([*command, profile, test.as_uri()], capture_output=True, text=True, timeout=120)
    found = re.search(r'data-seen="([^"]*)"', done.stdout)
    assert found, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(html.unescape(found[1]))


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize(("family", "light"), [("small_release", True), ("small_mazes", False)])
def test_the_page_plays_scrubs_and_changes_subset(family, light, request, tmp_path):
    source = folder = request.getfixturevalue(family)
    if light:
        folder = tmp_path / source.name
        publish(source, f"file:{folder}", pixels=False)
    written = view(str(folder), tmp_path / "viewer.html", episodes=2)
    release = dmcvb_gen.open(str(source))
    names = list(release.subsets)
    assert written.episodes == 2 * len(names) and written.bytes == written.path.stat().st_size < 20_000_000
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", written.path.read_text())
    seen, first = drive(written.path), release[names[0]]
    assert seen["problems"] == []
    assert seen["subsets"] == names and seen["titles"][0] == f"{names[0]}, episode 0"
    assert tuple(seen["views"]) == first.record.views
    assert seen["charts"] == ["Reward", "Action", "State", "Distractor"]
    assert seen["command"] == f"dmcvb-gen regenerate {folder} --only {names[0]} --range 0:1 --out regenerated"
    assert seen["below"] < 900  # pixels down the page, of the first curve: images leave room for curves
    actuators = first.record.actuators
    assert [text.rpartition(" ")[0] for text in seen["curves"]] == list(actuators) and "" not in actuators
    assert ("Distractor" in seen["lastcharts"]) == (family == "small_mazes")  # of setting none there are no labels
    length = int(first.lengths[0])
    assert (seen["right"], seen["ten"], seen["left"]) == (1, min(11, length), min(11, length) - 1)
    assert seen["end"] == length and seen["home"] == 0
    assert 0 < seen["played"] == seen["paused"] and seen["scrubbed"].startswith(f"step 2 of {length}")
    assert seen["added"] == 1
    array = "pixels" if "pixels" in first.arrays else "pixels/top"
    frames = first.episode(0, [array])[array].astype(float)  # the stored pictures are the oracle, WebP loses a little
    np.testing.assert_allclose(seen["first"], frames[0].mean((0, 1)), atol=4)
    np.testing.assert_allclose(seen["last"], frames[-1].mean((0, 1)), atol=4)
    assert seen["changed"] == [f"{names[1]}, episode 0"] and seen["next"] == [f"{names[2]}, episode 0"]
    assert seen["episode"] == [f"{names[2]}, episode 1"]
    if family == "small_release":  # the three distractors share their trajectories
        assert seen["titles"][1] == f"{names[1]}, episode 0" and len(seen["twins"]) == 2
        assert seen["kept"] == [f"{names[2]}, episode 0", f"{names[0]}, episode 0"]
        twins = [text for text in seen["beside"] if text.startswith("same trajectory")]
        assert twins == [f"same trajectory: {other}, episode 0" for other in names[1:]]


def page_data(path):
    return json.loads(re.search(r'id="data">(.*?)</script>', path.read_text())[1])["episodes"]


def test_a_small_limit_leaves_pictures_out_evenly_and_says_so(maze_release, tmp_path):
    whole = view(str(maze_release), tmp_path / "whole.html", episodes=1, size=16)
    small = view(str(maze_release), tmp_path / "small.html", episodes=1, max_mb=whole.bytes * 3 / 4e6)
    assert whole.stride == 1 and small.stride > 1 and small.bytes <= whole.bytes * 3 / 4
    with pytest.raises(StoreError, match="do not fit"):
        view(str(maze_release), tmp_path / "none.html", max_mb=0.001)


def test_the_command_writes_and_refuses(small_release, tmp_path):
    command = ["view", small_release, "--only", "*/none", "--episodes", 1, "--size", 24]
    said = invoke(*command, "--out", tmp_path / "v.html", code=0).output
    [episode] = page_data(tmp_path / "v.html")
    assert "1 episode of 1 subset" in said and "one image in" not in said and episode["views"][0]["width"] == 24
    with pytest.raises(StoreError, match="say with out where"):
        view("s3://bucket/release")
    for option in (dict(max_mb=0), dict(episodes=0), dict(episodes=1.5)):
        with pytest.raises(DmcvbError, match=f"^{next(iter(option))} is .*: input should be "):
            view(str(small_release), tmp_path / "none.html", **option)


def test_lamps_have_curves_and_a_url_the_command_that_fetches(tmp_path):
    recipe = short_recipe(settings="dynamic_camera0.2-light0.2", episodes=1, max_steps=3, size=8)
    folder = roll_out(recipe, tmp_path / "lamps").path
    for place, command in ((folder, f"regenerate {folder}"), (f"file://{folder}", f"fetch file://{folder}")):
        [episode] = page_data(view(str(place), tmp_path / "page.html").path)
        names = {curve["name"] for curve in episode["curves"]["distractor"]}
        assert {f"light_shift {axis}" for axis in "xyz"} <= names
        assert episode["command"].startswith(f"dmcvb-gen {command} --only ")
