"""Files that are there and cannot be read, or hold other bytes: one line that names them, wherever they are read."""

from __future__ import annotations

import re

import pytest

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, PolicyFileError, StoreError
from dmcvb_gen.policies.bundled import resolve_policies
from dmcvb_gen.training.run import RunConfig, open_run
from tests.conftest import invoke

NAME = "walker-walk/random/dynamic"


def one_line(error) -> str:
    assert isinstance(error, DmcvbError) and "\n" not in str(error)
    assert len(re.sub(r"\S*/\S*", "", str(error))) < 300  # whatever the place that it names is called
    return str(error)


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
    "export": lambda subset: dmcvb_gen.export(subset.release.store.place, "npz", f"{subset.release.store.place}-npz"),
}


def _file(root, array):
    """Path of the file of an array in the first shard."""
    shards = Release.open(root).shards([NAME])
    return next(root / file.path for shard in shards for file in shard.files if f"/{array}/" in file.path)


@pytest.mark.parametrize("kind", READERS)
def test_every_reader_names_a_damaged_or_lost_chunk_in_one_line_and_prints_nothing(copy, kind, capfd):
    path = _file(copy, "pixels")
    subset, data = dmcvb_gen.open(str(copy))[NAME], path.read_bytes()
    for spoiled in (b"\xff" * len(data), data[: len(data) // 2], None):
        path.unlink() if spoiled is None else path.write_bytes(spoiled)
        with pytest.raises(StoreError, match="pixels.* is (damaged|not there)") as caught:
            READERS[kind](subset)
        assert "regenerate" in one_line(caught.value) and capfd.readouterr() == ("", "")
    path.write_bytes(data)
    READERS[kind](subset)


DAMAGES = {
    "garbage": lambda path: path.write_bytes(b"\xff\xfe\x00" + path.read_bytes()[3:]),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a link to itself": lambda path: (path.unlink(), path.symlink_to(path.name)),
    "missing": lambda path: path.unlink(),
}
COMMANDS = {
    "verify": "verify {0}",
    "regenerate": "regenerate {0} --check",
    "publish": "publish {0} {0}-there",
    "fetch": "fetch file://{0} --out {0}-there",
}
TARGETS = {
    "manifest": lambda root: root / "manifest.json",
    "list": lambda root: root / f"layers/{Release.open(root).manifest.layers[0].list}.json",
    "shard": lambda root: _file(root, "state"),
}


CASES = [("verify", target, damage) for target in TARGETS for damage in DAMAGES]
CASES.remove(("verify", "manifest", "missing"))  # it is a release in the making then
CASES += [(command, "shard", "missing") for command in ("publish", "fetch")]
CASES += [pytest.param("regenerate", target, "garbage", marks=pytest.mark.slow) for target in TARGETS]


@pytest.mark.parametrize(("command", "target", "damage"), CASES)
def test_a_command_names_what_it_cannot_read(copy, command, target, damage):
    path = TARGETS[target](copy)
    DAMAGES[damage](path)
    result = invoke(*COMMANDS[command].format(copy).split())
    assert result.exit_code in (1, 2, 3), result.output
    name = "state" if target == "shard" else path.name  # what is damaged in the middle is named by its array
    assert "Traceback" not in result.output and name in result.output.replace("\n", "")
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception


@pytest.mark.parametrize("place", ["file/x", "file/x/y", "file"])
def test_a_file_in_the_way_of_a_run_is_said_in_one_line(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(DmcvbError, match="choose (a place that you may write to|another)") as caught:
        open_run(tmp_path / place, RunConfig("cheetah-run", "sac", 10**5, 0, {"compile": False}), resume=False)
    assert str(tmp_path / place) in one_line(caught.value)


@pytest.mark.parametrize("text", [None, b"\xff", b"[]", b'{"levels": []}', b'{"levels": {"expert": 3}}', b"["])
def test_a_selection_that_is_damaged_or_not_there_says_how_to_get_one(tmp_path, text):
    if text is not None:
        (tmp_path / "selection.json").write_bytes(text)
    with pytest.raises(PolicyFileError, match="select-checkpoints"):
        resolve_policies("walker-walk", "expert", tmp_path)
