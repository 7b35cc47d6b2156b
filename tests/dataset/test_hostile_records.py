"""Commit records that somebody changed are refused at a URL as they are in a folder, before anything else is read."""

from __future__ import annotations

import json
from pathlib import Path

import fsspec
import pytest

from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import commit_path
from dmcvb_gen.errors import StoreError
from tests.faults.hostile import valid_release
from tests.faults.store_ops import NAMES

RECORD = commit_path(NAMES[0], 0)


def change(**fields):
    return lambda record: record | fields


def change_file(**fields):
    return lambda record: record | {"files": [record["files"][0] | fields, *record["files"][1:]]}


HOSTILE = {
    "climbs out": (change_file(path="../../etc/passwd"), "not a plain relative path"),
    "absolute": (change_file(path="/etc/passwd"), "not a plain relative path"),
    "a URL": (change_file(path="file:///etc/passwd"), "not a plain relative path"),
    "the manifest": (change_file(path="manifest.json"), "names files outside of"),
    "another subset": (change_file(path=f"{NAMES[1]}.zarr/zarr.json"), "names files outside of"),
    "pictures outside": (
        lambda r: r | {"pictures": [r["files"][0] | {"path": "policies/x"}]},
        "names files outside of",
    ),
    "no digest": (change_file(sha256="0" * 63), "sha256"),
    "a digest of other letters": (change_file(sha256="Z" * 64), "sha256"),
    "negative bytes": (change_file(bytes=-1), "bytes"),
    "too many episodes": (change(episodes=[0, 10**15]), "is not the record of episodes 0:2"),
    "another shard": (change(shard=10**15, episodes=[0, 2]), "is not the record of episodes"),
    "a field more": (change(run="rm -rf /"), "run"),
    "no object": (lambda record: [record] * 1000, "valid"),
    "nested": (lambda record: b"[" * 10**6, "not JSON"),
    "not UTF-8": (lambda record: b"\xff\xfe\x00", "not JSON"),
    "an endless number": (lambda record: b'{"shard": ' + b"1" * 10**5 + b"}", "not JSON"),
}


@pytest.fixture
def at_url():
    """Puts files at a URL in memory, and forgets them."""
    memory = fsspec.filesystem("memory")

    def put(files):
        for name, data in files.items():
            memory.pipe_file(f"/hostile/{name}", data)
        return "memory://hostile"

    yield put
    memory.rm("/hostile", recursive=True)


def in_folder(files, folder: Path) -> Path:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_record_is_refused_at_a_url_as_in_a_folder(at_url, tmp_path, name):
    changed, words = HOSTILE[name]
    record = changed(json.loads(valid_release()[RECORD]))
    data = record if isinstance(record, bytes) else json.dumps(record).encode()
    files = valid_release() | {RECORD: data}
    said = []
    for place in (str(in_folder(files, tmp_path)), at_url(files)):
        with pytest.raises(StoreError, match=words) as caught:
            open_release(place)
        said.append(str(caught.value).replace(place, ""))
        assert RECORD in said[-1] and "\n" not in said[-1] and len(said[-1]) < 500
    assert said[0] == said[1]


def test_the_same_release_unchanged_is_read_at_both(at_url, tmp_path):
    places = (str(in_folder(valid_release(), tmp_path)), at_url(valid_release()))
    here, there = (open_release(place)[NAMES[0]] for place in places)
    assert here.commits == there.commits and (here.read("action") == there.read("action")).all()
