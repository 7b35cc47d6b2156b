"""Random histories of commands on small releases, with random faults; what may not happen, and how often what did.

    python scripts/campaign.py --minutes 60 --seed 1                 # a line a history, then a table
    python scripts/campaign.py --seed 1 --history 17 --count 1       # the same history again
    python scripts/campaign.py --races --seed 1 --table races.json   # every pair of commands on one release at once

A history makes a release (walker or a maze), then damages, repairs, repaints, publishes, fetches and exports it, and
strikes commands and files with faults. After every step: what was committed is there, with the bytes of a release that
was made without faults. At its end every command is given once more without a fault, and every folder must be, byte by
byte, what it is without faults; no process and no temporary file may be left, nothing may print a traceback.

Commands run in children forked from this process, which has imported everything, on a small tmpfs of their own (so the
disk can be full, and read-only, for root, too). Needs root, for the mount; moto's server for S3.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests.faults import races  # noqa: E402
from tests.faults.commands import Command, Ended, session  # noqa: E402
from tests.faults.tiny import shrink  # noqa: E402

shrink()  # here, so that processes of a pool, which import this file again, do the same

MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
ROOM = 64 * 2**20
"""Bytes of a history's disk."""
KINDS = {
    "walker": ["walker-walk", "--distractor", "none", "--distractor", "dynamic", "--episodes", "3"],
    "maze": ["ant-maze-empty7x7", "--goal", "hidden", "--episodes", "3"],
}
SMALL = ["--level", "random", "--episodes-per-shard", "1", "--size", "8", "--max-steps", "12"]
CARD = ("README.md", "CHANGELOG.md", "croissant.json", "card/")
STRIKES = ("die", "disk full", "ctrl-c", "cut off", "quota")
MODES = {"die": "kill", "disk full": "full", "ctrl-c": "interrupt", "cut off": "cut", "quota": "quota"}
SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}
NETWORK = {"drops": "drop", "delays": "delay", "truncates": "cut", "corrupts": "corrupt", "503": "503", "403": "403"}
KILLS = {"die", "ctrl-c", "cut off", "SIGKILL", "SIGTERM", "SIGINT", "worker killed", "all killed"}
DAMAGE = ("byte flipped", "truncated", "deleted", "swapped")
GROUPS = {
    "kills, signals": KILLS,
    "disk full, quota, read-only": {"disk full", "full disk", "quota", "read-only"},
    "network": set(NETWORK),
    "two writers": {"two writers"},
    "files damaged": set(DAMAGE),
    "clock set back": {"clock set back"},
}
ENDS = {  # fault -> the exit codes that are documented for a command that it strikes (0: it was done all the same)
    **dict.fromkeys(("die", "SIGKILL", "all killed"), {0, -signal.SIGKILL}),
    "cut off": {0, -signal.SIGXFSZ},
    **dict.fromkeys(("ctrl-c", "SIGINT"), {0, 1, 130}),
    "SIGTERM": {0, 1, 130, 143, -signal.SIGTERM},
    **dict.fromkeys(("worker killed", "disk full", "quota", "full disk", "read-only", "two writers", *NETWORK), {0, 2}),
}


class Wrong(Exception):
    """Something that may not happen, in words."""


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, card and marks apart."""
    names = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
    return {
        n: (folder / n).read_bytes() for n in names if not n.startswith(CARD) and not n.endswith((".created", ".lock"))
    }


def unlike(found: dict[str, bytes], wanted: dict[str, bytes]) -> list[str]:
    """Names that one of two trees lacks or has otherwise."""
    return sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))


@dataclass
class Table:
    """How often which fault struck which command, and how it ended."""

    rows: collections.Counter = field(default_factory=collections.Counter)

    def add(self, operation: str, fault: str, what: str) -> None:
        self.rows[operation, fault, what] += 1

    def sum(self, what: str, faults=None, operations=None) -> int:
        return sum(
            count
            for (operation, fault, w), count in self.rows.items()
            if w == what and (faults is None or fault in faults) and (operations is None or operation in operations)
        )

    def save(self, path: Path) -> None:
        path.write_text(json.dumps([[*key, count] for key, count in sorted(self.rows.items())], indent=0))

    def load(self, path: Path) -> None:
        if path.exists():
            self.rows.update({tuple(key): count for *key, count in json.loads(path.read_text())})

    def summary(self) -> str:
        """Markdown: a row an operation, a column a group of faults, "times struck (of these: ended the command)"."""
        lines = [f"| operation | {' | '.join(GROUPS)} | wrong |", "|---|" + "---|" * (len(GROUPS) + 1)]
        rows = [[name] for name in sorted({operation for operation, *_ in self.rows})]
        for names in [*rows, None]:
            cells = []
            for faults in GROUPS.values():
                times, ended = (self.sum(what, faults, names) for what in ("times", "ended"))
                cells.append(f"{times} ({ended})" if ended else str(times or ""))
            wrong = self.sum("wrong", None, names)
            lines.append(f"| {names[0] if names else 'all'} | {' | '.join(cells)} | {wrong} |")
        return "\n".join(lines)

    def text(self) -> str:
        """Markdown: a row an operation and fault."""
        lines = ["| operation | fault | times | ended it | done all the same | wrong |", "|---|---|---|---|---|---|"]
        for operation, fault in sorted({key[:2] for key in self.rows}):
            times, ended, wrong = (self.rows[operation, fault, what] for what in ("times", "ended", "wrong"))
            lines.append(f"| {operation} | {fault} | {times} | {ended} | {times - ended} | {wrong} |")
        total, ended, wrong = self.sum("times"), self.sum("ended"), self.sum("wrong")
        lines.append(f"| all | | {total} | {ended} | {total - ended} | {wrong} |")
        return "\n".join([*lines, "", f"{total} faults, {self.sum('times', KILLS)} of them kills."])


class World:
    """What all histories share: the S3 server, the bad network before it, and the releases made without faults."""

    def __init__(self, folder: Path, table: Table):
        self.folder, self.table = folder, table
        self.typical: dict[str, float] = {}
        self.references: dict[str, Path] = {}
        self._processes: list[subprocess.Popen] = []
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
        quiet = dict(stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, env=environment, start_new_session=True)
        with contextlib.closing(__import__("socket").socket()) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        server = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
        self._processes.append(subprocess.Popen(server, stdout=subprocess.DEVNULL, **quiet))
        proxy = [sys.executable, "-m", "tests.faults.proxy", f"127.0.0.1:{port}"]
        self._processes.append(subprocess.Popen(proxy, stdout=subprocess.PIPE, text=True, **quiet))
        self.s3 = f"http://127.0.0.1:{int(self._processes[1].stdout.readline())}"
        self.direct = f"http://127.0.0.1:{port}"
        for attempt in range(300):
            with contextlib.suppress(OSError):
                urllib.request.urlopen(self.direct).close()
                break
            time.sleep(0.1 + 0 * attempt)
        urllib.request.urlopen(urllib.request.Request(f"{self.direct}/bucket", method="PUT")).close()

    def spoil(self, kinds: list[str], share: float, seed: int, times: int = 10**9) -> None:
        body = json.dumps(dict(kinds=kinds, share=share, seed=seed, times=times)).encode()
        urllib.request.urlopen(urllib.request.Request(f"{self.s3}/__faults__", body, method="POST")).close()

    def empty_bucket(self) -> None:
        urllib.request.urlopen(urllib.request.Request(f"{self.direct}/moto-api/reset", method="POST")).close()
        urllib.request.urlopen(urllib.request.Request(f"{self.direct}/bucket", method="PUT")).close()

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()

    def make_references(self) -> None:
        """Each command once without a fault: what every history must end in, and how long each takes."""
        for kind in KINDS:
            history = History(self, kind, random.Random(0), self.folder / f"reference-{kind}", faults=False)
            history.folder.mkdir()
            self.references[kind] = history.folder
            for operation in OPERATIONS:
                if operation != "repair":
                    history.do(operation)


class History:
    """One random history on a folder of its own."""

    def __init__(self, world: World, kind: str, rng: random.Random, folder: Path, faults: bool = True):
        self.world, self.kind, self.rng, self.folder, self.faults = world, kind, rng, folder, faults
        self.steps: list[str] = []
        self.struck = 0
        self.made: set[str] = set()
        self.damaged: set[str] = set()
        self.seen: dict[str, set[str]] = collections.defaultdict(set)
        self.root = folder / "release"

    @property
    def reference(self) -> Path:
        return self.world.references[self.kind]

    # -- commands ----------------------------------------------------------------------------------

    def run(self, name: str, arguments: list[str], fault: str | None = None) -> Ended:
        """One command, struck by `fault`; its end must be one that is documented."""
        self.steps.append(f"{name} [{fault or '-'}]: dmcvb-gen {' '.join(arguments)}")
        ended = self._strike(name, arguments, fault) if fault else self._plain(arguments)
        self.steps[-1] += f" -> {ended.code} in {ended.seconds:.1f} s"
        allowed = ENDS[fault] if fault else {0}
        if fault is None and ended.code == 0:
            self.world.typical[name] = 0.5 * ended.seconds + 0.5 * self.world.typical.get(name, ended.seconds)
        last = "\n".join(ended.said.strip().splitlines()[-25:])
        if fault:
            self._count(name, fault, ended)
        if "Traceback" in ended.said or "Exception ignored" in ended.said or "HUNG" in ended.said:
            raise Wrong(f"{name} under {fault} printed:\n{last}")
        if ended.stray:
            raise Wrong(f"{name} under {fault} left processes behind: {ended.stray}\n{last}")
        if ended.code not in allowed:
            raise Wrong(f"{name} under {fault} ended with {ended.code}, not {sorted(allowed)}:\n{last}")
        if ended.code == 2 and "error:" not in ended.said.lower():
            raise Wrong(f"{name} under {fault} ended with 2 and no line that says why:\n{last}")
        return ended

    def _count(self, name: str, fault: str, ended: Ended) -> None:
        struck = ended.code != 0 or ended.hit
        if struck:
            self.struck += 1
            self.world.table.add(name, fault, "times")
            if ended.code != 0:
                self.world.table.add(name, fault, "ended")

    def _plain(self, arguments: list[str]) -> Ended:
        return Command(arguments, self.folder).finish()

    def _strike(self, name: str, arguments: list[str], fault: str) -> Ended:
        rng, typical = self.rng, self.world.typical.get(name, 1.0)
        moment = rng.uniform(0, 1.1 * typical)
        if fault in STRIKES:
            at = rng.randrange(16_000) if fault in ("cut off", "quota") else rng.randrange(rng.choice([20, 200, 1200]))
            return Command(arguments, self.folder, (MODES[fault], at)).finish()
        if fault in SIGNALS:
            return Command(arguments, self.folder).finish(moment, lambda command: _send(command, SIGNALS[fault]))
        if fault in ("worker killed", "all killed"):
            return Command(arguments, self.folder).finish(moment, _kill_worker if fault[0] == "w" else _kill_all)
        if fault == "full disk":
            ballast = self.folder / "ballast"
            free = os.statvfs(self.folder).f_bavail * os.statvfs(self.folder).f_frsize
            with ballast.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, max(1, free - rng.randrange(0, 400_000)))
            try:
                return self._plain(arguments)
            finally:
                ballast.unlink()
        if fault == "read-only":
            subprocess.run(["mount", "-o", "remount,ro", str(self.folder)], check=True)
            try:
                return self._plain(arguments)
            finally:
                subprocess.run(["mount", "-o", "remount,rw", str(self.folder)], check=True)
        if fault == "two writers":
            other = Command(arguments, self.folder)
            time.sleep(rng.choice([0, rng.uniform(0, typical)]))
            one, other = Command(arguments, self.folder).finish(), other.finish()
            if other.code not in ENDS[fault] or "Traceback" in other.said or other.stray:
                raise Wrong(f"the first of two {name} ended with {other.code}:\n{other.said}")
            return Ended(one.code, one.said, one.seconds, one.stray, True)
        self.world.spoil([NETWORK[fault]], rng.choice([0.02, 0.1, 0.5]), rng.randrange(10**6))
        try:
            ended = self._plain(arguments)
        finally:
            self.world.spoil([], 0, 0)
        return Ended(ended.code, ended.said, ended.seconds, ended.stray, True)

    # -- looking -----------------------------------------------------------------------------------

    def look(self, name: str) -> None:
        """What is committed in a folder has the reference's bytes, and nothing that was committed is gone."""
        folder, reference = self.folder / name, self.reference / REFERENCE.get(name, name)
        now = set()
        if not (folder / "manifest.json").exists():
            return  # what is being published or fetched is no release before its manifest is there
        for path in sorted(folder.glob("commits/**/*.json")):
            record = path.relative_to(folder).as_posix()
            if record in self.damaged:
                continue
            now.add(record)
            if path.read_bytes() != (reference / record).read_bytes():
                raise Wrong(f"{record} of {name} is not what it is without faults")
            for file in json.loads(path.read_bytes())["files"]:
                if file["path"] in self.damaged:
                    continue
                there, wanted = folder / file["path"], reference / file["path"]
                if not there.exists() or there.read_bytes() != wanted.read_bytes():
                    raise Wrong(f"{record} of {name} is committed, and {file['path']} is not what it is without faults")
        if lost := self.seen[name] - now - self.damaged:
            raise Wrong(f"{sorted(lost)[0]} of {name} was committed and is gone")
        self.seen[name] = now

    def whole(self, name: str) -> None:
        """A folder is, byte by byte, what it is without faults, and nothing temporary is left."""
        found, wanted = tree(self.folder / name), tree(self.reference / REFERENCE.get(name, name))
        if other := unlike(found, wanted):
            raise Wrong(f"{name} differs from what it is without faults, first in {other[:3]} of {len(other)}")

    # -- a story -----------------------------------------------------------------------------------

    def do(self, operation: str, *, again: bool = False) -> None:
        """One operation, under a fault or two and then without one, until it is done."""
        OPERATIONS[operation](self)
        self.made.add(operation)

    def command(self, name: str, arguments: list[str], faults: tuple[str, ...], folder: str | None = None) -> None:
        """A command struck by some faults, one after the other, then left alone; looked at each time."""
        for _ in range(self.rng.choice([1, 2, 3, 5]) if self.faults else 0):
            ended = self.run(name, arguments, self.rng.choice(faults))
            if folder:
                self.look(folder)
            if ended.code == 0:
                break
            if self.rng.random() < 0.1 and folder:
                self.clock_back(folder)
        self.run(name, arguments)
        if folder and self.faults:
            self.look(folder)
            self.whole(folder)

    def clock_back(self, folder: str) -> None:
        """Files from 1970 and from 2096, as from machines whose clocks are wrong or were set back."""
        for path in (self.folder / folder).rglob("*"):
            with contextlib.suppress(FileNotFoundError):
                os.utime(path, (self.rng.choice([0, 4e9]),) * 2)
        self.steps.append(f"the clock of {folder} is set back")
        self.struck += 1
        self.world.table.add("between", "clock set back", "times")

    def tell(self, limit: int) -> None:
        """The whole story: a release, then whatever may come."""
        self.do("rollout")
        for _ in range(self.rng.randrange(2, limit)):
            self.do(self.rng.choices(list(WEIGHTS), WEIGHTS.values())[0])
        for name in sorted(path.name for path in self.folder.iterdir() if path.is_dir()):
            if name in CHECKED:
                self.whole(name)


def _send(command: Command, number: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(command.pid, number)
        return True
    return False


def _kill_worker(command: Command) -> bool:
    names = {pid: Path(f"/proc/{pid}/cmdline").read_bytes() for pid in command.workers() if _exists(pid)}
    workers = [pid for pid, name in names.items() if b"resource_tracker" not in name]
    if not workers:
        return False
    with contextlib.suppress(ProcessLookupError):
        os.kill(workers[0], signal.SIGKILL)
    return True


def _exists(pid: int) -> bool:
    return Path(f"/proc/{pid}/cmdline").exists()


def _kill_all(command: Command) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(command.pid, signal.SIGKILL)
        return True
    return False


# -- operations: each one function, added to the two tables below --------------------------------------------

LOCAL = (*STRIKES, *SIGNALS, "full disk", "read-only", "two writers")
REMOTE = ("die", "ctrl-c", *SIGNALS, *NETWORK, *NETWORK)
WORKERS = ("worker killed", "all killed", *SIGNALS)


def rollout(history: History) -> None:
    arguments = ["rollout", *KINDS[history.kind], *SMALL, "--out", str(history.root)]
    if history.faults and history.rng.random() < 0.15:
        more = [*arguments, "--workers", str(history.rng.choice([2, 3]))]
        history.run("rollout, workers", more, history.rng.choice(WORKERS))
        history.look("release")
    history.command("rollout", arguments, LOCAL, "release")


def repair(history: History) -> None:
    """A file is damaged: verify finds and names it, regenerate mends it."""
    rng, root = history.rng, history.root
    name = rng.choice(sorted(tree(root)))
    path, kind = root / name, rng.choice(DAMAGE)
    data = path.read_bytes()
    if kind == "deleted":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(data[: rng.randrange(len(data))])
    elif kind == "byte flipped":
        place = rng.randrange(len(data))
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :])
    else:
        others = [other for other in tree(root).values() if other != data]
        path.write_bytes(rng.choice(others))
    history.steps.append(f"{name}: {kind}")
    history.struck += 1
    history.damaged = {name} | {other for other in tree(root) if path.exists() and path.samefile(root / other)}
    history.world.table.add("release", kind, "times")
    checked = Command(["verify", str(root)], history.folder).finish()
    history.steps.append(f"verify -> {checked.code}: {checked.said.strip()[:300]}")
    if checked.code not in (1, 2) or "Traceback" in checked.said:
        raise Wrong(f"verify ended with {checked.code} where {name} was {kind}:\n{checked.said}")
    if name not in checked.said.replace(str(root) + "/", ""):
        raise Wrong(f"verify did not name {name}, which was {kind}:\n{checked.said}")
    if name == "manifest.json":
        path.write_bytes(data)  # what says how to make the rest cannot be made from the rest
        history.damaged = set()
        return
    history.command("regenerate", ["regenerate", str(root)], LOCAL, "release")
    history.damaged = set()
    history.look("release")


def repaint(history: History) -> None:
    arguments = ["repaint", str(history.root), "--size", "12", "--out", str(history.folder / "repainted")]
    history.command("repaint", arguments, LOCAL, "repainted")


def publish_folder(history: History) -> None:
    there = history.folder / "published"
    history.command("publish to a folder", ["publish", str(history.root), f"file://{there}"], LOCAL, "published")


def publish_s3(history: History) -> None:
    history.world.empty_bucket()
    option = ["--option", f"endpoint_url={history.world.s3}"]
    history.command("publish to S3", ["publish", str(history.root), "s3://bucket/r", *option], REMOTE)
    arguments = ["fetch", "s3://bucket/r", "--out", str(history.folder / "fetched"), *option]
    if history.rng.random() < 0.5:
        history.command("fetch a part", [*arguments, "--episodes", "0:2"], REMOTE, None)
    history.command("fetch", arguments, (*REMOTE, "full disk", "read-only", "quota"), "fetched")


def rollout_s3(history: History) -> None:
    """Straight to a bucket, then fetched: the same release."""
    history.world.empty_bucket()
    option = ["--option", f"endpoint_url={history.world.s3}"]
    scratch = ["--scratch", str(history.folder / "scratch")]
    (history.folder / "scratch").mkdir(exist_ok=True)
    arguments = ["rollout", *KINDS[history.kind], *SMALL, "--out", "s3://bucket/d", *option, *scratch]
    history.command("rollout to S3", arguments, (*REMOTE, "two writers", "full disk"))
    shutil.rmtree(history.folder / "direct", ignore_errors=True)
    history.run("fetch", ["fetch", "s3://bucket/d", "--out", str(history.folder / "direct"), *option])
    history.whole("direct")


def parts(history: History) -> None:
    """Begun, made in parts, finished: the same release."""
    arguments = ["rollout", *KINDS[history.kind], *SMALL, "--out", str(history.folder / "parted")]
    history.command("rollout --init", [*arguments, "--init"], LOCAL)
    for part in history.rng.sample(["1/2", "2/2"], 2):
        history.command("rollout --part", [*arguments, "--part", part], LOCAL)
        history.look("parted")
    history.command("rollout --finish", [*arguments, "--finish"], LOCAL, "parted")


def grow(history: History) -> None:
    arguments = ["rollout", *KINDS[history.kind], *SMALL, "--out", str(history.folder / "grown")]
    if not (history.folder / "grown" / "manifest.json").exists():
        history.run("rollout", [*arguments, "--episodes", "2"])
    history.command("grow", arguments, LOCAL, "grown")


def paint(history: History) -> None:
    light = history.folder / "light"
    if not (light / "manifest.json").exists():
        arguments = ["rollout", *KINDS[history.kind], *SMALL, "--no-pixels", "--out", str(light)]
        history.command("rollout --no-pixels", arguments, LOCAL)
    history.command("paint", ["paint", str(light)], LOCAL)
    history.whole("light")


def export(history: History) -> None:
    formats = ["npz", "replay-buffer"]
    for to in [history.rng.choice(formats)] if history.faults else formats:
        out = history.folder / f"exported-{to}"
        arguments = ["export", str(history.root), "--to", to, "--out", str(out)]
        history.command("export", arguments, ("die", "ctrl-c", *SIGNALS, "full disk", "read-only", "two writers"))
        history.whole(out.name)


def verify(history: History) -> None:
    history.command("verify", ["verify", str(history.root)], ("SIGKILL", "SIGTERM", "SIGINT", "read-only"))


def validate(history: History) -> None:
    out = history.folder / "report"
    smoke = history.kind == "walker" and history.rng.random() < 0.3  # no benchmark is about random levels of mazes
    arguments = ["validate", str(history.root), "--out", str(out)]
    arguments += ["--profile", "smoke", "--agents", "state-bc"] if smoke else ["--checks-only"]
    faults = ("SIGKILL", "SIGTERM", "SIGINT", "die", "full disk", "read-only")
    history.command("validate, smoke" if smoke else "validate, checks", arguments, faults)


OPERATIONS: dict[str, Callable[[History], None]] = {
    "rollout": rollout,
    "repair": repair,
    "repaint": repaint,
    "publish to a folder": publish_folder,
    "publish to S3": publish_s3,
    "rollout to S3": rollout_s3,
    "rollout in parts": parts,
    "grow": grow,
    "paint": paint,
    "export": export,
    "verify": verify,
    "validate": validate,
}
WEIGHTS = dict.fromkeys(OPERATIONS, 1.0) | {"repair": 4, "publish to S3": 1.5, "validate": 0.2}
CHECKED = {"release", "repainted", "published", "fetched", "parted", "grown", "light", "direct"}
"""Folders that are compared, byte by byte."""
REFERENCE: dict[str, str] = {"fetched": "release", "parted": "release", "direct": "release"}
"""Folder -> the reference's folder that it must be like, where that has another name."""


# -- a campaign ----------------------------------------------------------------------------------------------


def warm() -> None:
    """Import what commands import, compile the models and decode the backgrounds, once for all children."""
    import importlib
    import pkgutil

    import dmcvb_gen
    from dmcvb_gen.distractors import load_backgrounds
    from dmcvb_gen.rendering import available_renderers, default_renderer
    from dmcvb_gen.tasks import get_task

    for module in pkgutil.walk_packages(dmcvb_gen.__path__, "dmcvb_gen."):
        if not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError):  # of packages that are not installed
                importlib.import_module(module.name)
    importlib.import_module("s3fs")
    for kind in KINDS.values():
        task = get_task(kind[0])
        default_renderer(task)
        _ = task.picture_model  # which compiles it
    load_backgrounds("builtin", "train")
    available_renderers()


@contextlib.contextmanager
def disk(folder: Path):
    """A folder with a small disk of its own."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={ROOM}", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
        folder.rmdir()


def tell_history(world: World, seed: int, number: int, steps: int) -> str | None:
    """One history from its seed; what went wrong, None if nothing did."""
    rng = random.Random(f"{seed}/{number}")
    kind, started, wrong = rng.choice(list(KINDS)), time.time(), None
    with disk(world.folder / f"history-{number}") as folder:
        history = History(world, kind, rng, folder)
        try:
            history.tell(steps)
        except Wrong as error:
            wrong = str(error)
        except Exception:
            wrong = f"the campaign itself: {traceback.format_exc()}"
        if wrong:
            world.table.add(history.steps[-1].split(" [")[0][:40], "any", "wrong")
            kept = Path(tempfile.gettempdir()) / f"campaign-{seed}-{number}"
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept, symlinks=True)
            (kept / "story.txt").write_text("\n".join([*history.steps, "", wrong]))
    words = "ok" if wrong is None else f"WRONG (seed {seed}, history {number})"
    seconds = time.time() - started
    print(f"history {number} {kind}: {len(history.steps)} steps, {history.struck} faults, {seconds:.0f} s: {words}")
    if wrong:
        print("    " + wrong.replace("\n", "\n    "))
    sys.stdout.flush()
    return wrong


def race(options: argparse.Namespace) -> int:
    """Every pair of commands at once, of those that are asked for."""
    pairs = [pair for pair in races.all_pairs() if any(name in pair.name for name in options.pair or [""])]
    pairs = pairs[options.history : options.history + options.count]
    warm()
    with tempfile.TemporaryDirectory(prefix="races-", dir=MEMORY) as folder:
        world = World(Path(folder), Table()) if any(pair.place == "bucket" for pair in pairs) else None
        try:
            wrong = races.campaign(pairs, Path(folder), world and world.direct, options.seed, options.table)
        finally:
            if world:
                world.close()
    return 1 if wrong else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--history", type=int, default=0, metavar="K", help="go on with history K")
    parser.add_argument("--count", type=int, default=10**9, help="at most so many histories")
    parser.add_argument("--steps", type=int, default=9, help="operations a history at most")
    parser.add_argument("--table", type=Path, help="JSON of the counts: read at the start if there, kept up to date")
    parser.add_argument("--summary", action="store_true", help="print a summary of --table and leave")
    parser.add_argument("--races", action="store_true", help="race every pair of commands on one release instead")
    parser.add_argument("--pair", action="append", metavar="NAME", help="with --races: only pairs with NAME in theirs")
    options = parser.parse_args()
    if options.summary and options.races:
        print(races.summary(options.table))
        return 0
    if options.summary:
        table = Table()
        table.load(options.table)
        print(table.summary())
        return 0
    os.environ |= {"AWS_ACCESS_KEY_ID": "someone", "AWS_SECRET_ACCESS_KEY": "x", "AWS_DEFAULT_REGION": "us-east-1"}
    if options.races:
        return race(options)
    table = Table()
    if options.table:
        table.load(options.table)
    warm()
    wrong, number, until = 0, options.history, time.time() + 60 * options.minutes
    with tempfile.TemporaryDirectory(prefix="campaign-", dir=MEMORY) as folder:
        world = World(Path(folder), table)
        try:
            world.make_references()
            print("without faults:", ", ".join(f"{n} {s:.1f} s" for n, s in world.typical.items()), flush=True)
            while time.time() < until and number < options.history + options.count:
                wrong += tell_history(world, options.seed, number, options.steps) is not None
                number += 1
                if options.table:
                    table.save(options.table)
        finally:
            world.close()
    assert not session(os.getpid()) or session(os.getpid()) == [os.getpid()], "the campaign left processes behind"
    print(f"\n{number - options.history} histories, {wrong} of them wrong (seed {options.seed})\n\n{table.text()}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
