"""The crash table: each file operation of making, growing and copying a release, killed before and after it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dmcvb_gen.dataset import writer
from dmcvb_gen.dataset.chunks import encode
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.release.fetch import _Download, fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.storage.store import Store, open_store
from tests.conftest import wrong_files
from tests.dataset import made_up, oracle
from tests.dataset.killing import Killed, die

SOURCE = "source"


def _rollout(root: Path) -> None:
    made_up.make(open_store(root), made_up.recipe(3))


def _light(root: Path) -> None:
    made_up.make(open_store(root), made_up.recipe(3, images=False))


def _growth(root: Path) -> None:
    made_up.make(open_store(root), made_up.recipe(5))


def _fetch(root: Path) -> None:
    fetch(f"file:{root.parent / SOURCE}", root, ["hop/random/none"], (2, 3), workers=1)


def _publish(root: Path) -> None:
    publish(root.parent / SOURCE, f"file:{root}", workers=1)


def _publish_light(root: Path) -> None:
    publish(root.parent / SOURCE, f"file:{root}", workers=1, pixels=False)


TABLE: dict[str, tuple[list[Callable], Callable]] = {
    "rollout": ([], _rollout),
    "paint": ([_light], _rollout),
    "growth": ([_rollout], _growth),
    "fetch": ([], _fetch),
    "publish": ([], _publish),
    "publish of what grew": ([_rollout], _publish),
    "light publish": ([], _publish_light),
    "light publish of what grew": ([_rollout], _publish_light),
    "fetch of what grew": ([_rollout], _fetch),
}
"""Name -> commands that ran before, and the command that is killed."""
CASES = [pytest.param(name, marks=pytest.mark.slow if name == "fetch" else pytest.mark.full) for name in TABLE]


@pytest.fixture(autouse=True)
def one_writer_of_metadata(monkeypatch):
    monkeypatch.setattr(writer, "READERS", 1)  # writes in one order, so that each has a number


@pytest.mark.parametrize("name", CASES)
def test_a_killed_command_leaves_the_older_release_and_is_simply_run_again(tmp_path, name):
    strike_everywhere(tmp_path, name)


def strike_everywhere(tmp_path: Path, name: str) -> None:
    """Kill a command before and after each of its writes, look, and run it once more.

    Raises:
      AssertionError, DmcvbError: a reader saw something else than the older or the newer release.
    """
    before, command = TABLE[name]
    made_up.make(open_store(tmp_path / SOURCE), made_up.recipe(5))
    start = tmp_path / "start"
    start.mkdir()
    for each in before:
        each(start)
    shutil.copytree(start, tmp_path / "whole")
    with pytest.MonkeyPatch.context() as patch:
        writes = die(patch)
        command(tmp_path / "whole")
    older, newer = (_digest(tmp_path / folder) for folder in ("start", "whole"))
    for number, path in enumerate(writes):
        for after in (False, True):
            struck = tmp_path / f"{number}{'ab'[after]}"
            shutil.copytree(start, struck)
            with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
                die(patch, number, after)
                command(struck)
            where = f"{name} killed {'after' if after else 'before'} {path}"
            assert _seen(struck, name) in (older, newer), where
            command(struck)
            assert _seen(struck, name) == newer and not wrong_files(struck), where
            shutil.rmtree(struck)


def _digest(root: Path) -> str | None:
    return oracle.sha256(root / "manifest.json") if (root / "manifest.json").exists() else None


def _seen(root: Path, name: str) -> str | None:
    """Check what lies in the folder and what a reader sees; the digest of it."""
    if name.startswith(("fetch", "light")):
        assert not any(root.rglob("zarr.json")) or (root / "manifest.json").exists()
    else:
        oracle.check(root)
    if not any(root.glob("recipes/*.json")) and not (root / "manifest.json").exists():
        return None
    release = Release.open(root)
    for subset in release.subsets.values():
        subset.read("state")
        painted = subset.episodes[~subset.unpainted[subset.episodes]]
        assert len(subset.read("pixels", painted) if len(painted) else ()) == len(painted)
    return release.digest


# -- the table is judged: each of these mistakes must be noticed ------------------------------------


def _record_before_files(monkeypatch):
    def put_shard(store, layer, shard, arrays):
        data = {name: encode(layer, layer.array(name), values) for name, values in arrays}
        files = {name: writer.file_facts(each) for name, each in data.items() if each is not None}
        writer.put_record(store, layer, shard, writer.ShardRecord(key=layer.job_key(shard), files=files))
        for name in files:
            writer.put(store, layer.file_path(layer.array(name), shard), data[name])

    monkeypatch.setattr(made_up, "put_shard", put_shard)


def _manifest_before_lists(monkeypatch):
    late: list = []
    put, replace = writer.put, Store.replace

    def later(store, path, data, **options):
        return late.append((store, path, data)) if path.startswith("layers/") else put(store, path, data, **options)

    def first(self, path, data, expected="*"):
        done = replace(self, path, data, expected)
        while path == "manifest.json" and late:
            put(*late.pop())
        return done

    monkeypatch.setattr(writer, "put", later)
    monkeypatch.setattr(Store, "replace", first)


def _manifest_of_all_that_was_asked_for(monkeypatch):
    build, finish = writer.build_manifest, writer.finish

    def eager(recipes, lists):
        gaps = {name: (*records, *records[-1:] * 9) for name, records in lists.items()}
        return build(recipes, gaps)

    def begin(store, wanted, inputs):
        writer.begin(store, wanted, inputs)
        finish(store)

    monkeypatch.setattr(writer, "build_manifest", eager)
    monkeypatch.setattr(made_up, "begin", begin)


def _older_manifest_is_deleted_first(monkeypatch):
    replace = Store.replace

    def unsafe(self, path, data, expected="*"):
        if path == "manifest.json" and expected not in (None, "*"):
            self.delete(path)
            expected = None
        return replace(self, path, data, expected)

    monkeypatch.setattr(Store, "replace", unsafe)


def _records_of_copies_before_files(monkeypatch):
    def bring_shards(self, shards):
        self.bring([shard.record_file for shard in shards])
        self.bring([file for shard in shards for file in shard.files])

    monkeypatch.setattr(_Download, "bring_shards", bring_shards)


MISTAKES = {
    _record_before_files: "rollout",
    _manifest_before_lists: "growth",
    _manifest_of_all_that_was_asked_for: "growth",
    _older_manifest_is_deleted_first: "publish of what grew",
    _records_of_copies_before_files: "fetch",
}


@pytest.mark.full
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.__name__)
def test_the_crash_table_notices(tmp_path, monkeypatch, mistake):
    mistake(monkeypatch)
    with pytest.raises((AssertionError, DmcvbError, FileNotFoundError)):
        strike_everywhere(tmp_path, MISTAKES[mistake])
