"""Exports go to a URL as they are, and to the Hub with the tag that LeRobot's loader looks for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dmcvb_gen.errors import StoreError
from dmcvb_gen.release.export import export
from dmcvb_gen.release.export.publishing import export_format, publish_export
from tests.conftest import invoke
from tests.fake_hub import content, fake_hub

SUBSETS = ("walker-walk/random/static", "ant-maze-tiny/random/hidden")


@pytest.mark.parametrize(("to", "name"), zip(("hdf5", "lerobot"), SUBSETS, strict=True))
def test_an_export_arrives_whole_and_is_mixed_with_nothing(to, name, stored, tmp_path):
    there = tmp_path / "there"
    [folder] = export(str(stored[name].folder), to, tmp_path / to, [name])
    assert export_format(folder) == export_format(tmp_path / to) == to
    invoke("publish", folder, f"file://{there}", code=0)
    assert content(there) == content(folder)
    (there / "LICENSE").write_text("mine")  # no data, whatever the format's files are called
    again = publish_export(folder, f"file://{there}")
    assert again.moved == 0 and again.files == len(content(folder))
    data = next(path for path in map(Path, content(folder)) if path.suffix and not path.name.startswith("."))
    left = f"left-by-another{data.suffix}"
    (there / left).write_bytes(b"of a larger export")
    with pytest.raises(StoreError, match=f"{left}.*choose another URL"):
        publish_export(folder, f"file://{there}")
    with pytest.raises(StoreError, match="holds a release.*give another URL"):
        publish_export(folder, f"file://{stored[name].folder}")
    refused = invoke("publish", folder, f"file://{tmp_path / 'x'}", "--no-pixels", code=2).output
    assert "it is for releases, and this is an export" in refused


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


def test_what_is_no_export_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    assert "holds no release" in invoke("publish", tmp_path, f"file://{tmp_path / 'there'}", code=2).output
    with pytest.raises(StoreError, match="neither a release nor an export"):
        publish_export(tmp_path, f"file://{tmp_path / 'there'}")
