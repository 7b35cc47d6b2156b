"""Files that are there and cannot be read, or hold other bytes: one line that names them, wherever they are read."""

from __future__ import annotations

import errno
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.index import INDEX
from dmcvb_gen.dataset.manifest import MANIFEST, commit_path
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.dataset.shards import damage
from dmcvb_gen.errors import DmcvbError, PolicyFileError, StoreError
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import check_files
from dmcvb_gen.storage import base as storage
from dmcvb_gen.training.run import RunConfig, open_run
from tests.faults import store_ops

NAME = store_ops.NAMES[0]
COMMIT = commit_path(NAME, 0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished release of made-up numbers."""
    root = tmp_path_factory.mktemp("made") / "release"
    store_ops.start(str(root))
    for name, shard in store_ops.SHARDS:
        store_ops.write(str(root), name, shard)
    store_ops.finish(str(root))
    return root


@pytest.fixture
def root(made, tmp_path):
    shutil.copytree(made, tmp_path / "r")
    return tmp_path / "r"


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(storage, "PAUSE", 0.001)


def deny(path, monkeypatch):
    """As if the file's rights were taken away, which root would not notice."""
    for name in ("read_bytes", "open"):
        given = getattr(Path, name)

        def refuse(self, *args, given=given, **options):
            if self == path:
                raise PermissionError(errno.EACCES, "Permission denied", str(self))
            return given(self, *args, **options)

        monkeypatch.setattr(Path, name, refuse)


def directory(path, monkeypatch):
    path.unlink()
    path.mkdir()


def loop(path, monkeypatch):
    path.unlink()
    path.symlink_to(path.name)


def other_bytes(path, monkeypatch):
    path.write_bytes(b"\xff\xfe\x00" + path.read_bytes()[3:])


WAYS = (deny, directory, loop, other_bytes)


def one_line(error) -> str:
    assert isinstance(error, DmcvbError) and "\n" not in str(error)
    assert len(re.sub(r"\S*/\S*", "", str(error))) < 300  # whatever the place that it names is called
    return str(error)


@pytest.mark.parametrize("name", [MANIFEST, COMMIT, INDEX])
@pytest.mark.parametrize("spoil", WAYS)
def test_verify_finds_what_cannot_be_read_and_goes_on(root, monkeypatch, spoil, name):
    spoil(root / name, monkeypatch)
    if name == MANIFEST and spoil in (directory, loop):
        found = [open_error(root)]
    else:
        found = [str(finding) for finding in check_files(root)]
    assert any(name in text for text in found) and all("\n" not in text for text in found), found
    if spoil is deny:
        assert any("Permission denied" in text for text in found)


def open_error(root) -> str:
    with pytest.raises(StoreError) as caught:
        open_release(root)
    return one_line(caught.value)


def test_verify_says_which_shard_cannot_be_read(root, monkeypatch):
    file = open_release(root)[NAME].commits[0].files[0]
    deny(root / file.path, monkeypatch)
    found = [str(finding) for finding in check_files(root)]
    assert any(f"{file.path} of shard 0 cannot be read: Permission denied" in text for text in found)
    assert damage(root, open_release(root)[NAME].record, 0) == f"{file.path} cannot be read: Permission denied"


@pytest.mark.parametrize("spoil", WAYS)
def test_a_manifest_that_cannot_be_read_stops_every_command_in_one_line(root, monkeypatch, tmp_path, spoil):
    spoil(root / MANIFEST, monkeypatch)
    for name in ("verify", "regenerate", "publish"):
        words = [name, str(root)] + [f"file://{tmp_path}/there"] * (name == "publish")
        result = CliRunner().invoke(main, words)
        assert result.exit_code in (1, 2) and "Traceback" not in result.output and MANIFEST in result.output
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    for read in (load_manifest, open_release):
        with pytest.raises(StoreError) as caught:
            read(root)
        assert MANIFEST in one_line(caught.value)


@pytest.mark.parametrize("name", [MANIFEST, COMMIT, INDEX, "a shard"])
@pytest.mark.parametrize("spoil", [deny, other_bytes])
def test_publish_and_fetch_say_what_they_could_not_read(root, monkeypatch, tmp_path, spoil, name):
    publish(root, f"file://{tmp_path}/there")
    fetch(f"file://{tmp_path}/there", tmp_path / "part", [NAME], (0, 1))
    name = open_release(root)[NAME].commits[0].files[0].path if name == "a shard" else name
    for folder in (root, tmp_path / "part"):
        spoil(folder / name, monkeypatch)
    with pytest.raises(StoreError) as caught:
        publish(root, f"file://{tmp_path}/elsewhere")
    assert "cannot write" not in one_line(caught.value) and "cannot move" not in one_line(caught.value)
    if name == MANIFEST:
        with pytest.raises(StoreError, match=MANIFEST) as caught:
            fetch(f"file://{tmp_path}/there", tmp_path / "part", [NAME])
        assert "cannot write" not in one_line(caught.value)


@pytest.mark.parametrize("name", [MANIFEST, INDEX, COMMIT])
def test_what_cannot_be_read_at_a_url_is_not_said_to_be_moved(root, monkeypatch, tmp_path, name):
    there = tmp_path / "there"
    publish(root, f"file://{there}")
    directory(there / name, monkeypatch)
    with pytest.raises(StoreError, match="cannot read") as caught:
        fetch(f"file://{there}", tmp_path / "part")
    assert Path(name).name in one_line(caught.value) and "moved" not in str(caught.value)


READERS = {
    "read": lambda subset: subset.read("pixels"),
    "episode": lambda subset: subset.episode(0),
    "each episode": lambda subset: list(subset.each_episode(["pixels"])),
    "xarray": lambda subset: subset.xarray()["pixels"].values,
    "xarray, a part": lambda subset: subset.xarray([1])["pixels"].isel(step=slice(1, 3), height=[0, 2]).values,
    "xarray, load": lambda subset: subset.xarray().load(),
    "torch, in memory": lambda subset: subset.torch("steps", in_memory=True)[0],
    "torch, from the store": lambda subset: subset.torch("transitions", in_memory=False)[0],
    "torch, episodes": lambda subset: subset.torch("episodes")[0],
    "torch, stream": lambda subset: list(subset.torch("stream")),
    "batches": lambda subset: list(subset.batches(2)),
    "source": lambda subset: subset.source()[0],
}


@pytest.mark.parametrize("kind", READERS)
def test_every_reader_names_a_damaged_chunk_in_one_line(root, kind):
    subset = dmcvb_gen.open(str(root))[NAME]
    [file] = [file for file in subset.commits[0].files if file.path.startswith(f"{NAME}.zarr/pixels/")]
    data = (root / file.path).read_bytes()
    for spoiled in (b"\xff" * len(data), data[: len(data) // 2]):
        (root / file.path).write_bytes(spoiled)
        with pytest.raises(StoreError, match="pixels is damaged") as caught:
            READERS[kind](subset)
        assert "dmcvb-gen regenerate" in one_line(caught.value)
    (root / file.path).write_bytes(data)
    READERS[kind](subset)


def test_a_guarded_data_set_is_lazy_and_reads_what_the_store_holds(root):
    subset = dmcvb_gen.open(str(root))[NAME]
    data, whole = subset.xarray(), subset.read("pixels")
    assert not data["pixels"].variable._in_memory and data["pixels"].encoding["shards"][0] == 2
    for given, wanted in (
        (dict(episode=1), whole[1]),
        (dict(episode=[2, 0], step=slice(None, None, 2)), whole[[2, 0]][:, ::2]),
        (dict(step=-1, channel=[2, 1]), whole[:, -1][..., [2, 1]]),
    ):
        np.testing.assert_array_equal(data["pixels"].isel(given).values, wanted)
    shutil.rmtree(root / f"{NAME}.zarr/pixels/zarr.json", ignore_errors=True)
    (root / f"{NAME}.zarr/zarr.json").write_bytes(b"{")
    with pytest.raises(StoreError, match=r"\.zarr is damaged"):
        dmcvb_gen.open(str(root))[NAME].xarray()


def test_array_metadata_that_is_damaged_while_a_release_is_made_is_named(tmp_path):
    store_ops.start(str(tmp_path / "r"))
    for text in (b"{", b"[]", b"\xff"):
        (tmp_path / f"r/{NAME}.zarr/zarr.json").write_bytes(text)
        with pytest.raises(StoreError, match=r"zarr\.json is damaged"):
            store_ops.start(str(tmp_path / "r"))


@pytest.mark.parametrize("place", ["file/x", "file/x/y", "file"])
def test_a_file_in_the_way_of_a_run_is_said_in_one_line(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(DmcvbError, match=r"choose (a place that you may write to|another --out)") as caught:
        open_run(tmp_path / place, RunConfig("cheetah-run", "sac", 10**5, 0, {"compile": False}), resume=False)
    assert str(tmp_path / place) in one_line(caught.value)


@pytest.mark.parametrize("text", [b"\xff", b"[]", b'{"levels": []}', b'{"levels": {"expert": 3}}', b"["])
def test_a_selection_that_is_damaged_is_as_none(tmp_path, text):
    (tmp_path / "selection.json").write_bytes(text)
    with pytest.raises(PolicyFileError, match="select-checkpoints"):
        resolve_policies("walker-walk", "expert", tmp_path)
