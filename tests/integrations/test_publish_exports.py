"""Exports go to a URL as they are, and to the Hub with the tag that LeRobot's loader looks for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.errors import StoreError
from dmcvb_gen.release.export import export
from dmcvb_gen.release.export.publishing import export_format, publish_export
from dmcvb_gen.release.export.registry import all_formats
from tests.fake_hub import fake_hub

SUBSETS = ("walker-walk/random/static", "ant-maze-tiny/random/hidden")
FORMATS = list(all_formats())


def content(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("to", FORMATS)
def test_an_export_arrives_whole_and_is_mixed_with_nothing(to, stored, tmp_path):
    name, there = SUBSETS[FORMATS.index(to) % 2], tmp_path / "there"
    [folder] = export(str(stored[name].folder), to, tmp_path / to, [name])
    assert export_format(folder) == export_format(tmp_path / to) == to
    done = CliRunner().invoke(main, ["publish", str(folder), f"file://{there}"])
    assert done.exit_code == 0, done.output
    assert content(there) == content(folder)
    (there / "LICENSE").write_text("mine")  # no data, whatever the format's files are called
    again = publish_export(folder, f"file://{there}")
    assert again.moved == 0 and again.files == len(content(folder))
    data = next(path for path in map(Path, content(folder)) if path.suffix and not path.name.startswith("."))
    left = f"left-by-another{data.suffix}"
    (there / left).write_bytes(b"of a larger export")
    with pytest.raises(StoreError, match=f"{left}.*choose another URL"):
        publish_export(folder, f"file://{there}")
    release = shutil.copytree(stored[name].folder, tmp_path / "release")
    with pytest.raises(StoreError, match="holds a release.*give another URL"):
        publish_export(folder, f"file://{release}")
    refused = CliRunner().invoke(main, ["publish", str(folder), f"file://{tmp_path / 'x'}", "--no-pixels"])
    assert refused.exit_code == 2 and "it is for releases, and this is an export" in refused.output


def test_the_hub_gets_lerobots_tag(stored, tmp_path, monkeypatch):
    hub = fake_hub(tmp_path / "hub", monkeypatch)
    for name in SUBSETS:
        [folder] = export(str(stored[name].folder), "lerobot", tmp_path / "out", [name])
    with pytest.raises(StoreError, match="--merge"):
        publish_export(tmp_path / "out", "hf://datasets/me/tiny")
    assert publish_export(folder, "hf://datasets/me/tiny").moved == len(content(folder))
    assert hub.files == content(folder) and "v3.0" in hub.tags
    [other] = export(str(stored[SUBSETS[0]].folder), "lerobot", tmp_path / "other", [SUBSETS[0]])
    with pytest.raises(StoreError, match="is of another export; give another URL"):
        publish_export(other, "hf://datasets/me/tiny")


def test_what_a_killed_export_left_is_not_published(stored, tmp_path):
    [folder] = export(str(stored[SUBSETS[0]].folder), "hdf5", tmp_path / "out", [SUBSETS[0]])
    whole, killed = content(tmp_path / "out"), folder.parent / ".dynamic.m@1-2.x.partial"
    shutil.copytree(folder, killed / "dynamic")
    (folder / ".data.hdf5.m@1-2.x.partial").write_bytes(b"half")
    sent = publish_export(tmp_path / "out", f"file://{tmp_path / 'there'}")
    assert content(tmp_path / "there") == whole and sent.files == len(whole)
    shutil.rmtree(folder)
    assert export_format(tmp_path / "out") is None and export_format(killed) == "hdf5"


def test_an_export_goes_to_an_empty_folder_and_replaces_nothing(stored, tmp_path):
    for to, merge in (("lerobot", True), ("hdf5", False)):
        out = tmp_path / to
        place = out if merge else out / SUBSETS[0]
        place.mkdir(parents=True)
        assert export(str(stored[SUBSETS[0]].folder), to, out, [SUBSETS[0]], merge=merge) == [place]
    (place / ".dmcvb-gen.json").write_text("{}")
    with pytest.raises(StoreError, match="holds something else"):
        export(str(stored[SUBSETS[0]].folder), to, out, [SUBSETS[0]])


def test_what_is_no_export_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    done = CliRunner().invoke(main, ["publish", str(tmp_path), f"file://{tmp_path / 'there'}"])
    assert done.exit_code == 2 and "holds no release" in done.output
    with pytest.raises(StoreError, match="neither a release nor an export"):
        publish_export(tmp_path, f"file://{tmp_path / 'there'}")
