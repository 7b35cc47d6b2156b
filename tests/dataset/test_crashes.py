"""The crash table: each file operation of making, growing and copying a release, killed before and after it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dmcvb_gen.dataset import gate, writer
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.storage.store import Store, open_store
from tests.dataset import made_up, oracle
from tests.dataset.killing import Killed, KillingStore

SOURCE = "source"


def _rollout(store: Store, root: Path) -> None:
    made_up.make(store, made_up.recipe(3))


def _light(store: Store, root: Path) -> None:
    made_up.make(store, made_up.recipe(3, images=False))


def _growth(store: Store, root: Path) -> None:
    made_up.make(store, made_up.recipe(5))


def _fetch(store: Store, root: Path) -> None:
    """Copy the second shard of one setting, as `fetch` does."""
    source = open_store(root / SOURCE)
    release = Release.open(source)
    copy = [f"recipes/{digest}.json" for digest in release.manifest.recipes]
    promised: dict[str, set[int]] = {}
    for shard in release.shards(["hop/random/none"], (2, 3)):
        copy += [*[file.path for file in shard.files], shard.record_path]
        promised.setdefault(shard.layer.name, set()).add(shard.number)
    for path in [*copy, *release.lists()]:
        store.create(path, source.folder / path)
    writer.finish_copy(store, source.read("manifest.json", 10**6), source.place, promised)


TABLE: dict[str, tuple[list[Callable], Callable]] = {
    "rollout": ([], _rollout),
    "paint": ([_light], _rollout),
    "growth": ([_rollout], _growth),
    "fetch": ([], _fetch),
}
"""Name -> commands that ran before, and the command that is killed."""


@pytest.fixture(autouse=True)
def one_writer_of_metadata(monkeypatch):
    monkeypatch.setattr(writer, "READERS", 1)  # writes in one order, so that each has a number


@pytest.mark.full
@pytest.mark.parametrize("name", TABLE)
def test_a_killed_command_leaves_the_older_release_and_is_simply_run_again(tmp_path, name):
    strike_everywhere(tmp_path, name)


def strike_everywhere(tmp_path: Path, name: str, step: int = 1) -> None:
    """Kill a command before and after each of its writes (or every `step`-th), look, and run it once more.

    Raises:
      AssertionError, DmcvbError: a reader saw something else than the older or the newer release.
    """
    before, command = TABLE[name]
    made_up.make(open_store(tmp_path / SOURCE), made_up.recipe(5))
    start = open_store(tmp_path / "start")
    start.folder.mkdir()
    for each in before:
        each(start, tmp_path)
    shutil.copytree(start.folder, tmp_path / "whole")
    counted = KillingStore(open_store(tmp_path / "whole"))
    command(counted, tmp_path)
    older, newer = (_digest(tmp_path / folder) for folder in ("start", "whole"))
    for number in range(0, len(counted.writes), step):
        for after in (False, True):
            struck = tmp_path / f"{number}{'ab'[after]}"
            shutil.copytree(start.folder, struck)
            store = open_store(struck)
            with pytest.raises(Killed):
                command(KillingStore(store, number, after), tmp_path)
            where = f"{name} killed {'after' if after else 'before'} {counted.writes[number]}"
            assert _seen(struck, name) in (older, newer), where
            command(store, tmp_path)
            assert _seen(struck, name) == newer, where
            shutil.rmtree(struck)


def _digest(root: Path) -> str | None:
    return oracle.sha256(root / "manifest.json") if (root / "manifest.json").exists() else None


def _seen(root: Path, name: str) -> str | None:
    """Check what lies in the folder and what a reader sees; the digest of it."""
    if name != "fetch":
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
    def put_shard(store, layer, shard, arrays, *, first_wins=False):
        data = {name: writer.encode(layer, layer.array(name), values) for name, values in arrays}
        files = {name: writer.file_facts(each) for name, each in data.items() if each is not None}
        writer.put_record(store, layer, shard, writer.ShardRecord(key=layer.job_key(shard), files=files))
        for name in files:
            writer.put(store, layer.file_path(layer.array(name), shard), data[name])

    monkeypatch.setattr(made_up, "put_shard", put_shard)


def _manifest_before_lists(monkeypatch):
    late: list = []
    put, replace = writer.put, KillingStore.replace

    def later(store, path, data, **options):
        return late.append((store, path, data)) if path.startswith("layers/") else put(store, path, data, **options)

    def first(self, path, data, expected="*"):
        done = replace(self, path, data, expected)
        if path == "manifest.json":
            while late:
                put(*late.pop())
        return done

    monkeypatch.setattr(writer, "put", later)
    monkeypatch.setattr(KillingStore, "replace", first)


def _plain_metadata_first(monkeypatch):
    finish = writer.finish

    def early(store):
        store.replace("hop/random.zarr/zarr.json", b"{}")
        return finish(store)

    monkeypatch.setattr(made_up, "finish", early)


def _manifest_of_all_that_was_asked_for(monkeypatch):
    build = writer.build_manifest

    def eager(recipes, lists):
        recipes = list(recipes)
        gaps = {name: (*records, *records[-1:] * 9) for name, records in lists.items()}
        return build(recipes, gaps)

    monkeypatch.setattr(writer, "build_manifest", eager)
    monkeypatch.setattr(
        made_up, "begin", lambda store, wanted, inputs: (writer.begin(store, wanted, inputs), finish(store))
    )
    finish = writer.finish


def _older_manifest_is_deleted_first(monkeypatch):
    replace = KillingStore.replace

    def unsafe(self, path, data, expected="*"):
        if path == "manifest.json" and expected not in (None, "*"):
            self.delete(path)
            expected = None
        return replace(self, path, data, expected)

    monkeypatch.setattr(KillingStore, "replace", unsafe)


def _records_of_copies_before_files(monkeypatch):
    files = gate.Shard.files.fget
    monkeypatch.setattr(gate.Shard, "record_path", property(lambda self: files(self)[0].path))
    monkeypatch.setattr(
        gate.Shard,
        "files",
        property(lambda self: (FileAt(gate.record_path(self.layer.name, self.number)), *files(self))),
    )


class FileAt:
    """Anything with a path."""

    def __init__(self, path: str):
        self.path = path


MISTAKES = {
    "record before files": (_record_before_files, "rollout"),
    "manifest before lists": (_manifest_before_lists, "growth"),
    "metadata for plain readers before the manifest": (_plain_metadata_first, "rollout"),
    "a manifest of shards that are not there": (_manifest_of_all_that_was_asked_for, "growth"),
    "the manifest is deleted before it is written": (_older_manifest_is_deleted_first, "growth"),
    "a copy's record before its files": (_records_of_copies_before_files, "fetch"),
}


@pytest.mark.full
@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_crash_table_notices(tmp_path, monkeypatch, mistake):
    make, row = MISTAKES[mistake]
    make(monkeypatch)
    with pytest.raises((AssertionError, DmcvbError, FileNotFoundError)):
        strike_everywhere(tmp_path, row)
