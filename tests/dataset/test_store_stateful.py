"""The store and publishing as a state machine: whatever ends a process between two file operations, nothing is lost.

Every step runs in a process of its own and may be killed, interrupted or run out of room at any of its file
operations, or within a write. The oracle is the made-up numbers themselves: what is committed reads back as them.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule, run_state_machine_as_test

from tests.faults.server import Result, Server
from tests.faults.store_ops import NAMES, SHARDS

STRUCK = {"kill": "killed", "cut": "killed", "full": "refused", "quota": "refused", "interrupt": "interrupted"}
"""Fault -> how a process that it strikes ends."""
FAULTS = st.one_of(
    st.none(),
    st.tuples(st.sampled_from(["kill", "kill", "full", "interrupt"]), st.integers(0, 200)),
    st.tuples(st.sampled_from(["cut", "quota"]), st.integers(0, 3000)),
)
DAMAGE = ("flip", "cut", "delete", "swap")


def leftovers(folder: Path) -> list[str]:
    """Temporary files: hidden ones apart from the store's own mark, and partial ones."""
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    return [name for name in names if name.endswith(".partial") or name.rsplit("/", 1)[-1].startswith(".manifest")]


def hurt(path: Path, kind: str, place: int, other: Path) -> None:
    """Damage a file: flip a bit of it, cut it short, delete it, or put another file in its place."""
    data = bytearray(path.read_bytes())
    if kind == "flip":
        data[place % len(data)] ^= 1 << place % 8
        path.write_bytes(data)
    elif kind == "cut":
        path.write_bytes(data[: place % len(data)])
    elif kind == "delete":
        path.unlink()
    else:
        path.write_bytes(other.read_bytes())


class Releases(RuleBasedStateMachine):
    """A release, the folder it is published to and one it is fetched to; `done` are the shards that must be there."""

    server: Server
    reference: dict

    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="stateful-"))
        self.root, self.there, self.here = self.folder / "r", self.folder / "published", self.folder / "fetched"
        self.url = f"file://{self.there}"
        self.started, self.done, self.finished = False, set(), False

    def run(self, function: str, arguments: dict, fault=None) -> bool:
        """Whether a step came to its end; every other end must be the one that its fault brings about."""
        mode, at = fault or (None, None)
        result: Result = self.server.call(function, arguments, root=self.folder, mode=mode, at=at)
        assert result.status in {"done", STRUCK.get(mode, "done")}, f"{function} {arguments} {fault}: {result}"
        return result.status == "done"

    def ask(self, function: str, **arguments):
        result = self.server.call(function, arguments, root=self.folder)
        assert result.status == "done", f"{function} {arguments}: {result}"
        return result.value

    def see(self, may: set = frozenset()) -> None:
        """The committed shards are those that must be there, and perhaps those of `may`."""
        found = {(name, shard) for name, shards in self.ask("look", root=str(self.root)).items() for shard in shards}
        assert self.done <= found <= self.done | may, f"{found} where {self.done} (and perhaps {may}) should be"
        self.done = found

    @precondition(lambda self: not self.started or self.done)
    @rule(fault=FAULTS)
    def start(self, fault):
        self.started |= self.run("start", {"root": str(self.root)}, fault)
        self.see()

    @precondition(lambda self: self.started)
    @rule(key=st.sampled_from(SHARDS), fault=FAULTS)
    def write(self, key, fault):
        """Also shards that are there already: two who plan at the same time write the same shard."""
        self.run("write", {"root": str(self.root), "name": key[0], "shard": key[1]}, fault)
        self.see({key})

    @precondition(lambda self: self.started)
    @rule(fault=FAULTS)
    def finish(self, fault):
        self.finished |= self.run("finish", {"root": str(self.root)}, fault) and len(self.done) == len(SHARDS)
        self.see()

    @precondition(lambda self: self.finished)
    @rule(fault=FAULTS)
    def publish(self, fault):
        self.run("publish", {"root": str(self.root), "url": self.url}, fault)
        assert sum(map(len, self.ask("look", root=str(self.there)).values())) in (0, len(SHARDS))  # whole or no release

    @precondition(lambda self: (self.there / "manifest.json").exists())
    @rule(names=st.sampled_from([*((name,) for name in NAMES), ()]), part=st.sampled_from([(0, 1), None]), fault=FAULTS)
    def fetch(self, names, part, fault):
        arguments = {"url": self.url, "out": str(self.here), "only": list(names), "episodes": part}
        before = {(name, shard) for name, shards in self.ask("look", root=str(self.here)).items() for shard in shards}
        whole = self.run("fetch", arguments, fault)
        after = {(name, shard) for name, shards in self.ask("look", root=str(self.here)).items() for shard in shards}
        wanted = {(name, shard) for name, shard in SHARDS if name in (names or NAMES) and (part is None or shard == 0)}
        assert before | (wanted if whole else set()) <= after <= before | wanted

    @precondition(lambda self: self.done)
    @rule(data=st.data(), kind=st.sampled_from(DAMAGE), place=st.integers(0, 10**6))
    def damage(self, data, kind, place):
        """Every damage is found and named, and the shard can be made again."""
        name, shard = data.draw(st.sampled_from(sorted(self.done)))
        record = self.root / f"commits/{name}/{shard:05d}.json"
        files = sorted(self.root / file["path"] for file in json.loads(record.read_bytes())["files"])
        path = data.draw(st.sampled_from(files))
        other = next(file for file in files if file.read_bytes() != path.read_bytes())
        saved = record.read_bytes()
        hurt(path, kind, place, other)
        if self.finished:
            found = self.ask("check", root=str(self.root))
            assert any(name in line and f"shard {shard} " in line for line in found), found
        record.unlink()
        self.run("write", {"root": str(self.root), "name": name, "shard": shard})
        assert record.read_bytes() == saved
        self.see()

    @rule()
    def set_the_clock_back(self):
        """Files from the future and from the past: nothing may go by their times."""
        for number, path in enumerate(self.folder.rglob("*")):
            os.utime(path, (number % 2 * 4e9, number % 2 * 4e9))

    def teardown(self):
        try:
            self.run("start", {"root": str(self.root)})
            for name, shard in sorted(set(SHARDS) - self.done):
                self.run("write", {"root": str(self.root), "name": name, "shard": shard})
            assert self.ask("finish", root=str(self.root)) == self.reference
            assert self.ask("check", root=str(self.root)) == []
            self.run("publish", {"root": str(self.root), "url": self.url})
            self.run("fetch", {"url": self.url, "out": str(self.here), "only": [], "episodes": None})
            for folder in (self.root, self.there, self.here):
                assert leftovers(folder) == [] and len(self.ask("look", root=str(folder))) == len(NAMES)
            assert not (self.there / "publishing.json").exists()
        finally:
            shutil.rmtree(self.folder)


@pytest.fixture(scope="module")
def server():
    with Server("tests.faults.store_ops") as server:
        yield server


@pytest.fixture(scope="module")
def reference(server, tmp_path_factory):
    """The manifest of the release that no fault has struck."""
    folder = tmp_path_factory.mktemp("reference")
    root = str(folder / "r")
    server.call("start", {"root": root}, root=folder)
    for name, shard in SHARDS:
        server.call("write", {"root": root, "name": name, "shard": shard}, root=folder)
    return server.call("finish", {"root": root}, root=folder).value


@pytest.mark.slow
def test_no_end_of_a_process_between_two_file_operations_loses_or_spoils_anything(server, reference):
    assert reference["complete"]
    Releases.server, Releases.reference = server, reference
    chosen = settings(
        max_examples=int(os.environ.get("DMCVB_STATEFUL_EXAMPLES", "6")),
        stateful_step_count=14,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        database=None,
        phases=[Phase.generate],  # a shorter story of a failure costs minutes; the one that is printed can be replayed
    )
    run_state_machine_as_test(Releases, settings=chosen)
