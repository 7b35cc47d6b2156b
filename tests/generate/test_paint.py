"""Releases without pictures: made so or stripped, painted where they arrive or when they are read, equal to the bit."""

from __future__ import annotations

import json
import shutil
import threading

import numpy as np
import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.index import write_release
from dmcvb_gen.dataset.manifest import commit_path
from dmcvb_gen.dataset.writer import finish_release
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import write_json
from dmcvb_gen.generate import executors, paint
from dmcvb_gen.generate.paint import paint_release, without_pictures
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from dmcvb_gen.storage.base import Storage

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
    again = run("paint", tmp_path / "copy")
    assert again.exit_code == 0 and "every shard that is here has its images already" in again.output
    mine, theirs = files(tmp_path / "copy"), files(made / "painted")
    assert {n: v for n, v in mine.items() if n != ".lock"} == {n: v for n, v in theirs.items() if n != ".lock"}


@pytest.mark.parametrize("task", ["walker-walk", "ant-maze-empty7x7"])
def test_a_rollout_that_goes_on_gets_its_digests_at_its_end_alone(task, tmp_path):
    asked = ["--level=random", "--episodes=2", "--episodes-per-shard=1", "--max-steps=3", "--size=16", "--workers=1"]
    where = ["--out", tmp_path / "r"]
    assert run("rollout", task, *asked, "--part=1/2", *where).exit_code == 0
    before = files(tmp_path / "r")
    assert run("paint", tmp_path / "r").exit_code == 0
    assert files(tmp_path / "r") == before and open_release(tmp_path / "r").manifest.digest is None
    assert run("rollout", task, *asked, "--part=2/2", *where).exit_code == 0
    assert run("rollout", "--finish", *where).exit_code == 0
    assert run("verify", tmp_path / "r").exit_code == 0


@pytest.mark.parametrize("moment", [(paint, "write_lock"), (executors, "run_job")], ids=["lock", "shard"])
def test_two_who_paint_a_release_end_in_what_one_ends_in(made, tmp_path, monkeypatch, moment):
    """Another one paints all of it before the first has the lock, or while the first is about to paint a shard."""
    shutil_copy(made / "light", tmp_path / "copy")
    mine = getattr(*moment)

    def meanwhile(*arguments, **options):
        monkeypatch.setattr(*moment, mine)
        paint_release(tmp_path / "copy")
        return mine(*arguments, **options)

    monkeypatch.setattr(*moment, meanwhile)
    paint_release(tmp_path / "copy")
    found, wanted = files(tmp_path / "copy"), files(made / "painted")
    assert {n: v for n, v in found.items() if n != ".lock"} == {n: v for n, v in wanted.items() if n != ".lock"}


def test_the_last_painter_keeps_how_others_painted_meanwhile(made, tmp_path, monkeypatch):
    """One subset at 40 pixels, painted by another while this one paints the other subset at 48."""
    shutil_copy(made / "light", tmp_path / "copy")
    mine, other = list(open_release(made / "light").subsets)
    work = executors.run_job

    def meanwhile(*arguments, **options):
        monkeypatch.setattr(executors, "run_job", work)
        (making := tmp_path / "copy" / f"{mine}.zarr/x.foreign.partial").touch()
        paint_release(tmp_path / "copy", [other], config=paint.RenderConfig(overrides=paint.RenderOverrides(size=40)))
        assert making.exists()  # somebody is still at work
        return work(*arguments, **options)

    monkeypatch.setattr(executors, "run_job", meanwhile)
    paint_release(tmp_path / "copy", [mine], config=paint.RenderConfig(overrides=paint.RenderOverrides(size=48)))
    release = open_release(tmp_path / "copy")
    assert {name: subset.record.size for name, subset in release.subsets.items()} == {mine: 48, other: 40}
    assert verify(tmp_path / "copy").sound and release.manifest.complete
    assert not list((tmp_path / "copy").rglob("*.foreign.partial"))


def test_painting_goes_on_where_it_was_stopped_before_the_digests(made, tmp_path, monkeypatch):
    shutil_copy(made / "light", tmp_path / "copy")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(paint, "finish_together", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        paint_release(tmp_path / "copy")
    assert open_release(tmp_path / "copy").manifest.digest is None
    paint_release(tmp_path / "copy")
    found, wanted = files(tmp_path / "copy"), files(made / "painted")
    assert {n: v for n, v in found.items() if n != ".lock"} == {n: v for n, v in wanted.items() if n != ".lock"}


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


def test_pictures_that_are_published_come_to_a_light_release(made, tmp_path):
    url, here = f"file://{tmp_path}/there", tmp_path / "here"
    publish(made / "painted", url)
    shutil_copy(made / "light", here)
    name, other = open_release(here).subsets
    for only, whole in (([name], False), ([], True)):
        fetch(url, here, only, None if whole else (0, 1))
        release = open_release(here)
        painted = {n: [s for s, c in sub.commits.items() if c.painted] for n, sub in release.subsets.items()}
        assert painted == ({name: [0, 1], other: [0, 1]} if whole else {name: [0], other: []})
        assert verify(here).sound and np.any(release[name].episode(0)[release[name].pixel_arrays[0]])
    mine, theirs = files(here), files(made / "painted")
    assert {n: v for n, v in mine.items() if n != ".lock"} == {n: v for n, v in theirs.items() if n != ".lock"}


def test_a_part_of_the_published_pictures_and_the_rest_painted_are_the_release(made, tmp_path):
    publish(made / "painted", f"file://{tmp_path}/there")
    shutil_copy(made / "light", tmp_path / "here")
    fetch(f"file://{tmp_path}/there", tmp_path / "here", episodes=(0, 1))
    assert verify(tmp_path / "here").sound
    done = paint_release(tmp_path / "here")
    assert done.shards == 2 and done.manifest.digest == open_release(made / "painted").manifest.digest


def test_a_release_that_travels_light_has_a_card_of_its_own(made, tmp_path):
    shutil.copytree(made / "painted", tmp_path / "r")
    (tmp_path / "r/CHANGELOG.md").write_text("# Changes\n\n## 1.0.0\n\n- Much better.\n")
    assert run("card", tmp_path / "r").exit_code == 0
    for moved in (True, False):
        sent = run("publish", tmp_path / "r", f"file:{tmp_path / 'there'}", "--no-pixels", "--json")
        assert sent.exit_code == 0 and (json.loads(sent.stdout)["moved"] > 0) == moved, sent.output
    assert run("fetch", f"file:{tmp_path / 'there'}", "--out", tmp_path / "here").exit_code == 0
    checked = run("card", tmp_path / "here", "--check")
    assert checked.exit_code == 0, checked.output
    assert "`dmcvb-gen paint` makes the pictures" in (tmp_path / "here/README.md").read_text()
    assert "`dmcvb-gen paint` makes" not in (tmp_path / "r/README.md").read_text()
    assert "Much better" in (tmp_path / "here/CHANGELOG.md").read_text()


def test_a_release_that_travels_light_can_be_checked_and_repaired(made, tmp_path):
    url = f"file:{tmp_path / 'there'}"
    assert run("publish", made / "painted", url, "--no-pixels").exit_code == 0
    assert run("fetch", url, "--out", tmp_path / "here").exit_code == 0
    assert run("regenerate", tmp_path / "here", "--check").exit_code == 0
    [*_, state] = sorted(tmp_path.glob("here/*/*/*.zarr/state/c/*/**/*"))
    state.write_bytes(state.read_bytes()[:-9])
    assert run("regenerate", tmp_path / "here").exit_code == 0 == run("verify", tmp_path / "here").exit_code
    assert run("paint", tmp_path / "here", "--episodes", "0:1").exit_code == 0
    checked = run("regenerate", tmp_path / "here", "--check")
    assert checked.exit_code == 0, checked.output


def test_labels_travel_with_a_light_release_and_are_read_there(made, tmp_path):
    assert run("repaint", made / "painted", "--label", "depth", "--out", tmp_path / "r").exit_code == 0
    url = f"file:{tmp_path / 'there'}"
    assert run("publish", tmp_path / "r", url, "--no-pixels").exit_code == 0
    assert run("fetch", url, "--out", tmp_path / "light").exit_code == 0
    assert run("fetch", url, "--paint", "--out", tmp_path / "painted").exit_code == 0
    for name, subset in open_release(tmp_path / "r").subsets.items():
        depths = [array for array in subset.arrays if array.startswith("depth")]
        assert depths
        for folder in ("light", "painted"):
            for array in depths:
                assert np.array_equal(open_release(tmp_path / folder)[name].read(array), subset.read(array))


@pytest.fixture(scope="module")
def published(made):
    """The URL of the painted release without its pictures, whose digests are known."""
    url = f"file:{made / 'there'}"
    assert run("publish", made / "painted", url, "--no-pixels").exit_code == 0
    return url


def test_a_light_release_is_validated_as_the_painted_one(made, tmp_path):
    curves, trained = {}, ["--agents", "bc", "--threads", 1, "--precision", "float32"]
    for which in ("light", "painted"):
        out = tmp_path / which
        result = run("validate", made / which, *trained, "--out", out, "--json")
        assert result.exit_code == 0, result.output
        facts = json.loads((out / "report.json").read_text())
        curves[which] = [(cell["id"], cell["curve"][0]["loss"], cell["score"]["returns"]) for cell in facts["results"]]
    assert curves["light"] == curves["painted"] and curves["light"]


def test_other_sizes_views_and_goals_make_an_honest_other_release(made, published, tmp_path):
    maze = "maze" in str(made)
    choice = ["--views", "egocentric,top", "--goal", "hidden"] if maze else []
    assert run("fetch", published, "--episodes", "0:1", "--out", tmp_path / "small").exit_code == 0
    result = run("paint", tmp_path / "small", "--size", 48, *choice, "--json")
    assert result.exit_code == 0 and json.loads(result.stdout)["known"] == 0, result.output
    again = run("fetch", published, "--paint", "--size", 48, *choice, "--out", tmp_path / "small", "--json")
    assert again.exit_code == 0 and json.loads(again.stdout)["shards"] == 2, again.output
    release, whole = open_release(tmp_path / "small"), open_release(made / "painted")
    manifest = release.manifest
    assert manifest.complete and manifest.name == whole.manifest.name + "-repainted"
    assert [entry["kind"] for entry in manifest.lineage] == ["repaint"]
    assert manifest.lineage[0]["from"].startswith(whole.manifest.name) and manifest.lineage[0]["size"] == 48
    assert run("verify", tmp_path / "small").exit_code == 0
    name = next(iter(release.subsets))
    assert run("regenerate", tmp_path / "small", "--check", "--only", name, "--episodes", "0:1").exit_code == 0
    fresh = dmcvb_gen.open(str(made / "painted"), paint=True, size=48)
    names = {"pixels_hidden_goal/egocentric", "pixels_hidden_goal/top"} if maze else {"pixels"}
    for name, subset in dmcvb_gen.open(str(tmp_path / "small")).subsets.items():
        assert set(subset.pixel_arrays) == names
        assert all(np.array_equal(subset.read(array), fresh[name].read(array)) for array in names)
        assert next(iter(subset.batches(2)))["pixels"].shape[-2:] == (48, 48)
    other = run("paint", tmp_path / "small", "--size", 40)
    assert other.exit_code == 2 and "48 pixels a side" in other.output


def test_views_alone_keep_the_digests_that_are_known(made, published, tmp_path):
    choice = ["--views", "top"] if "maze" in str(made) else ["--views", "pixels"]
    result = run("fetch", published, "--paint", *choice, "--out", tmp_path / "r", "--json")
    told = json.loads(result.stdout)
    assert result.exit_code == 0 and told["known"] == told["shards"] == 4, result.output
    assert run("paint", tmp_path / "r", "--views", "nowhere").exit_code == 2
    if "maze" not in str(made):
        refused = run("paint", tmp_path / "r", "--goal", "hidden")
        assert refused.exit_code == 2 and "ant-maze" in refused.output


def test_what_was_painted_stays_when_more_is_fetched(made, published, tmp_path):
    def of_shard(root, shard):
        found = {path: path.stat().st_mtime_ns for path in root.rglob("*") if f"/c/{shard}" in str(path)}
        return {path: time for path, time in found.items() if path.is_file()}

    assert run("fetch", published, "--episodes", "0:1", "--paint", "--out", tmp_path / "r").exit_code == 0
    before = of_shard(tmp_path / "r", 0)
    more = run("fetch", published, "--out", tmp_path / "r")
    assert more.exit_code == 0 and before == of_shard(tmp_path / "r", 0), more.output
    subset = next(iter(open_release(tmp_path / "r").subsets.values()))
    assert subset.unpainted.tolist() == [False, False, True]
    table = dmcvb_gen.open(str(tmp_path / "r"))[subset.name]
    assert table.xarray([0, 1]).sizes["episode"] == 2
    with pytest.raises(StoreError, match="without images"):
        table.xarray()
    with pytest.raises(StoreError, match="paints nothing"):
        dmcvb_gen.open(str(tmp_path / "r"), paint=True)[subset.name].xarray()
    done = paint_release(tmp_path / "r")
    assert (done.shards, done.known) == (2, 2)
    assert done.manifest.digest == open_release(made / "painted").manifest.digest
    assert run("verify", tmp_path / "r").exit_code == 0


def test_shards_are_painted_while_others_come_and_a_cut_loses_nothing(made, published, tmp_path, monkeypatch):
    from dmcvb_gen.generate import paint as painting
    from dmcvb_gen.release import fetch as fetching

    painted, real = [], Storage.download
    plain = executors.run_job

    def run_job(job, tick):
        painted.append((job.subsets[0].name, job.shard))
        return plain(job, tick=tick)

    def download(storage, file, root):
        if "/c/1" in file.path and len(painted) < 1:
            for _ in range(600):  # the rest comes only once something was painted
                if painted or arrival_ended():
                    break
                threading.Event().wait(0.05)
            raise StoreError("the line went dead")
        return real(storage, file, root)

    def arrival_ended():
        return not any(thread.name == "fetch" for thread in threading.enumerate())

    monkeypatch.setattr(Storage, "download", download)
    monkeypatch.setattr(executors, "run_job", run_job)
    with pytest.raises(StoreError, match="line went dead"):
        fetching.fetch_and_paint(published, tmp_path / "r", painter=painting.RenderConfig())
    assert painted and open_release(tmp_path / "r").subsets
    monkeypatch.undo()
    count = sum(c.painted for s in open_release(tmp_path / "r").subsets.values() for c in s.commits.values())
    assert count == len(painted)
    result = run("fetch", published, "--paint", "--out", tmp_path / "r", "--json")
    assert result.exit_code == 0 and json.loads(result.stdout)["shards"] == 4 - count, result.output
    assert open_release(tmp_path / "r").manifest.digest == open_release(made / "painted").manifest.digest


def test_another_painter_is_said_before_and_after(made, tmp_path):
    without_pictures(made / "painted", tmp_path / "light")
    path = tmp_path / "light" / "manifest.json"
    manifest = json.loads(path.read_text())
    for environment in manifest["environments"]:
        environment["numba"] = "0.0.1"
    for subset in manifest["subsets"]:
        subset["renderer"]["version"] = "thick"
    write_json(path, manifest)
    subset = next(iter(open_release(tmp_path / "light").subsets.values()))
    commit = subset.commits[0]
    other = tuple(file.model_copy(update={"sha256": "0" * 64}) for file in commit.pictures)
    write_json(tmp_path / "light" / commit_path(subset.name, 0), commit.model_copy(update={"pictures": other}))
    light = open_release(tmp_path / "light")
    write_release(light.path, light.manifest, {name: subset.commits for name, subset in light.subsets.items()})
    result = run("paint", tmp_path / "light", "--episodes", "0:1", "--only", subset.name)
    assert result.exit_code == 1 and "1 of 1 differ" in result.stdout
    notes = result.stderr.splitlines()
    assert any("0.0.1 where the release was made" in note for note in notes)
    assert any("native's version is" in note and "thick in the manifest" in note for note in notes)


def test_pictures_are_claimed_by_the_first_who_paints(made, tmp_path, monkeypatch):
    """Another one asks for 48 pixels while the first shard is painted at the release's 32."""
    shutil_copy(made / "light", tmp_path / "copy")
    work = executors.run_job

    def meanwhile(*arguments, **options):
        monkeypatch.setattr(executors, "run_job", work)
        with pytest.raises(StoreError, match="32 pixels a side"):
            paint_release(tmp_path / "copy", config=paint.RenderConfig(overrides=paint.RenderOverrides(size=48)))
        return work(*arguments, **options)

    monkeypatch.setattr(executors, "run_job", meanwhile)
    paint_release(tmp_path / "copy")
    assert {s.record.size for s in open_release(tmp_path / "copy").subsets.values()} == {32}
    assert verify(tmp_path / "copy").sound


def test_regenerate_finds_pictures_of_another_size_under_their_own_digests(made, tmp_path):
    """As two painters at two sizes left them: the digests are those of the files, the array is larger."""
    for name, size in (("large", 40), ("small", None)):
        shutil_copy(made / "light", tmp_path / name)
        paint_release(tmp_path / name, config=paint.RenderConfig(overrides=paint.RenderOverrides(size=size)))
    name = next(iter(open_release(tmp_path / "large").subsets))
    [commit] = [c for shard, c in open_release(tmp_path / "small")[name].commits.items() if shard == 1]
    for file in commit.files:
        shutil.copy(tmp_path / "small" / file.path, tmp_path / "large" / file.path)
    shutil.copy(tmp_path / "small" / commit_path(name, 1), tmp_path / "large" / commit_path(name, 1))
    finish_release(tmp_path / "large", open_release(tmp_path / "large").manifest)
    result = run("regenerate", tmp_path / "large", "--only", name)
    assert result.exit_code == 1 and f"{name} shard 1" in result.output, result.output
    assert "do not fit their array" in result.output


def test_a_light_release_that_was_painted_grows_by_its_own_command(made, tmp_path):
    shutil_copy(made / "light", tmp_path / "copy")
    tiny = [{"3": "4"}.get(word, word) for word in RELEASES["walker" if "walker" in str(made) else "maze"]]
    first, second = open_release(tmp_path / "copy").subsets
    whole = ["rollout", *tiny, "--episodes", "2", "--out", tmp_path / "even", "--no-pixels"]
    assert run(*whole).exit_code == 0  # of full shards, which can grow
    grow = ["rollout", *tiny, "--out", tmp_path / "even", "--no-pixels"]
    paint_release(tmp_path / "even", [first])
    result = run(*grow)
    assert result.exit_code == 0, result.output
    release = open_release(tmp_path / "even")
    assert release.manifest.complete and verify(tmp_path / "even").sound
    assert not release[first].unpainted.any() and release[second].unpainted.all()
    paint_release(tmp_path / "even", [second], (0, 1))
    result = run(*[{"4": "6"}.get(word, word) for word in grow])
    assert result.exit_code == 2 and f"dmcvb-gen paint {tmp_path / 'even'} --only {second}" in result.output
