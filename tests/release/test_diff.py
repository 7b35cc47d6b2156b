"""`diff` names what is different in two releases, folders or URLs, and nothing else."""

from __future__ import annotations

import functools
import http.server
import json
import re
import shutil
import threading

from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.dataset.writer import commit_path
from dmcvb_gen.dataset3.gate import Release
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.release.diff import diff
from dmcvb_gen.release.publish import publish
from tests.conftest import maze_recipe, roll_out

NAME, MAZE = "walker-walk/random/none", "ant-maze-tiny/random/visible"


def test_equal_releases_have_no_difference(small_release, maze_release):
    for folder in (small_release, maze_release):
        result = CliRunner().invoke(main, ["diff", str(folder), f"file://{folder}"])
        assert result.exit_code == 0 and "no difference" in result.output


def test_another_seed_changes_arrays_and_missing_episodes_are_counted(maze_release, small_release, tmp_path):
    roll_out(maze_recipe(episodes=1).model_copy(update={"seed": 5}), tmp_path / "other")
    found = {str(difference) for difference in diff(maze_release, tmp_path / "other")}
    assert f"{MAZE}: episodes: 2 and 1" in found and f"{MAZE}: episodes that are there: 2 and 1" in found
    assert f"{MAZE}: physics has other bytes in the episodes 0:1" in found
    assert f"{MAZE}: pixels_top has other bytes in the episodes 0:1" in found
    shutil.copytree(small_release, tmp_path / "copy")
    (tmp_path / "copy" / commit_path(NAME, 1)).unlink()
    result = CliRunner().invoke(main, ["diff", str(small_release), str(tmp_path / "copy"), "--json"])
    assert result.exit_code == 1
    found = [{"subset": NAME, "message": "episodes that are there: 3 and 2"}]
    assert json.loads(result.output) == {"differences": found}
    shutil.copytree(maze_release, tmp_path / "a")
    shutil.copytree(maze_release, tmp_path / "b")
    for folder, shard in (("a", 0), ("b", 1)):
        (tmp_path / folder / commit_path(MAZE, shard)).unlink()
    [alone] = diff(tmp_path / "a", tmp_path / "b")
    assert str(alone) == f"{MAZE}: only one has shards of the episodes 0:1, 1:2"
    found = [str(difference) for difference in diff(small_release, maze_release)]
    assert f"{NAME}: only in the first" in found and f"{MAZE}: only in the second" in found


def test_an_array_that_only_one_has_is_not_called_different(small_release, tmp_path):
    repaint(Repainting(small_release, tmp_path / "r", size=16, labels=["depth"]))
    found = {str(difference) for difference in diff(tmp_path / "r", small_release)}
    assert f"{NAME}: depth is only in the first, in the episodes 0:2, 2:3" in found
    assert not any("other bytes" in one for one in found)


def test_a_release_is_listed_described_and_verified_where_it_is(maze_release, tmp_path, monkeypatch):
    there = tmp_path / "there"
    publish(maze_release, f"file://{there}/mazes")
    (there / "half").mkdir()
    run = CliRunner().invoke
    listed = json.loads(run(main, ["list", "--remote", f"file://{there}", "--json"]).output)
    digest = Release.open(maze_release).manifest.digest
    [facts] = listed
    assert (facts["name"], facts["version"], facts["episodes"], facts["digest"]) == ("mazes", "1.0.0", 2, digest)
    url = facts["url"]
    assert digest in run(main, ["info", url]).output
    result = run(main, ["verify", url, "--all"])
    assert result.exit_code == 0 and "sound" in result.output and digest in result.output, result.output
    shard = next(
        path for path in (there / "mazes").rglob("*") if "/pixels_top/c/" in path.as_posix() and path.is_file()
    )
    data = shard.read_bytes()
    shard.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    result = run(main, ["verify", url, "--all"])
    assert result.exit_code == 1 and f"{shard.relative_to(there / 'mazes')} does not have its digest" in result.output
    shard.unlink()
    monkeypatch.setattr("dmcvb_gen.release.verify_url.SAMPLE_FILES", 1)  # of many files, that is not among them
    result = run(main, ["verify", url])
    assert result.exit_code == 1 and f"{shard.relative_to(there / 'mazes')} is missing" in result.output
    shard.write_bytes(data)
    assert run(main, ["verify", url]).exit_code == 0
    record = there / "mazes" / commit_path(MAZE, 0)
    text = record.read_text()
    record.write_text(text.replace('"bytes": ', '"bytes": 1', 1))
    result = run(main, ["verify", url])
    assert result.exit_code == 1 and "commit record and files.json do not agree about" in result.output
    assert "do not give the digest" not in result.output  # which sizes are no part of
    record.write_text(re.sub(r'"sha256": "....', '"sha256": "0000', text, count=1))
    assert "do not give the digest" in run(main, ["verify", url]).output
    record.write_text(text)
    with shard.open("ab") as file:
        file.write(b"more")
    for every in ([], ["--all"]):
        result = run(main, ["verify", url, *every])
        assert result.exit_code == 1 and result.output.count("is missing or has another size") == 1
    shard.write_bytes(data)
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(http.server.SimpleHTTPRequestHandler, directory=there)
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    result = run(main, ["verify", f"http://127.0.0.1:{server.server_port}/mazes"])  # whose lists say no sizes
    server.shutdown()
    assert result.exit_code == 0, result.output
    assert run(main, ["list", "--remote", f"file://{there}/half"]).exit_code == 2


def test_a_url_is_no_folder(tmp_path, small_release):
    url = "s3://bucket/x"
    for command in (["fetch", url, "--out", url], ["card", str(small_release), "--out", url]):
        result = CliRunner().invoke(main, command)
        assert result.exit_code == 2 and "Traceback" not in result.output and "publish" in result.output
    for command in (["export", str(small_release), "--to", "npz", "--out", url], ["import", "x", "--out", url]):
        assert CliRunner().invoke(main, command).exit_code == 2


def test_options_are_for_urls(small_release):
    option = ["--option", "auto_mkdir=true"]
    result = CliRunner().invoke(main, ["diff", str(small_release), f"file://{small_release}", *option])
    assert result.exit_code == 0 and "no difference" in result.output
    for command in (["diff", str(small_release), str(small_release)], ["status", str(small_release)]):
        result = CliRunner().invoke(main, [*command, *option])
        assert result.exit_code == 2 and "--option has no effect" in result.output
