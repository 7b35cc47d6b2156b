"""Strike commands on small releases with random faults, and look at what lies there after each.

    python scripts/campaign.py --minutes 30                # a line for each thing that was wrong, then a table
    python scripts/campaign.py --minutes 30 --seed 7       # other faults
    python scripts/campaign.py --ledger faults.jsonl       # add to the faults of earlier days on the same code

Each command of `STEPS` first runs without a fault; the digest of the manifest that it leaves is the reference. Then
commands are struck: killed at a random file operation or after a random time, with a full disk, with a file that cannot
grow, by Ctrl-C. After a strike, the folder and the bucket must hold the older or the newer release, to the byte, as an
oracle of JSON and SHA-256 sees it (tests/dataset/oracle.py). Then the same command runs once more and must leave the
newer one. What is enumerated for each operation of the store is in tests/dataset/test_crashes.py; here the operations
are those of whole commands with their workers.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import gc
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests.dataset import oracle  # noqa: E402
from tests.faults.bucket import Bucket  # noqa: E402
from tests.faults.commands import Command, Ended  # noqa: E402
from tests.faults.tiny import shrink  # noqa: E402

shrink()  # here, so that processes of a pool, which import this file again, do the same

SMALL = ["--level", "random", "--episodes-per-shard", "1", "--size", "8", "--max-steps", "12", "--workers", "1"]
KINDS = {
    "walker": ["walker-walk", "--distractor", "none", "--distractor", "dynamic"],
    "maze": ["ant-maze-empty7x7", "--goal", "hidden"],
}
STRIKES = ("die", "full", "quota", "cut", "interrupt", "SIGKILL", "SIGTERM")
PLACES = dict.fromkeys(STRIKES, 160) | {"quota": 4000, "cut": 4000}
"""Strike -> operations, or bytes of a file, among which it is placed at first; one that comes too late lowers them."""
NOT_STRUCK = {"agents", "benchmarks", "training"}
"""Folders of the package that no command of `STEPS` imports."""
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None


@dataclass(frozen=True)
class Step:
    """A command of a history.

    Attributes:
      name: of its row in the table.
      before: the step whose release it starts from; None for an empty place.
      arguments: with {out}, {url} and {kind} to fill in.
      place: "folder" or "bucket", whose manifest it changes.
    """

    name: str
    before: str | None
    arguments: tuple[str, ...]
    place: str = "folder"

    @property
    def uses_bucket(self) -> bool:
        """Whether it reads or writes the bucket."""
        return "{url}" in self.arguments


STEPS = (
    Step("light rollout", None, ("rollout", "{kind}", "--episodes", "2", "--no-pixels", *SMALL, "--out", "{out}")),
    Step("rollout", None, ("rollout", "{kind}", "--episodes", "2", *SMALL, "--out", "{out}")),
    Step("growth", "rollout", ("rollout", "{kind}", "--episodes", "4", *SMALL, "--out", "{out}")),
    Step("paint", "light rollout", ("paint", "{out}", "--workers", "1")),
    Step("rollout into a bucket", None, ("rollout", "{kind}", "--episodes", "2", *SMALL, "--out", "{url}"), "bucket"),
    Step("publish", "rollout", ("publish", "{out}", "{url}"), "bucket"),
    Step("fetch", "publish", ("fetch", "{url}", "--out", "{out}")),
)


class History:
    """One kind of release, with the state that each step leaves without a fault."""

    def __init__(self, kind: str, scratch: Path, bucket: Bucket):
        self.kind, self.scratch, self.bucket = kind, scratch / kind, bucket
        self.after: dict[str, tuple[Path, Path]] = {}
        self.seconds: dict[str, float] = {}
        self.places: dict[tuple[str, str], int] = {}
        for step in STEPS:
            folder, objects = self.lay(step)
            ended = self.run(step, folder)
            if ended.code != 0:
                sys.exit(f"{kind}: {step.name} failed without a fault: {ended.said}")
            if step.uses_bucket:
                self.bucket.bring(objects)
            self.after[step.name] = folder, objects
            self.seconds[step.name] = ended.seconds

    def lay(self, step: Step) -> tuple[Path, Path]:
        """A folder and a copy of a bucket as they are before a step; a bucket that it uses holds these objects."""
        place = Path(tempfile.mkdtemp(dir=_made(self.scratch)))
        folder, objects = place / "release", place / "objects"
        objects.mkdir()
        if step.before:
            before = self.after[step.before]
            if step.name != "fetch":
                shutil.copytree(before[0], folder)
            shutil.copytree(before[1], objects, dirs_exist_ok=True)
        if step.uses_bucket:
            self.bucket.fill(objects)
        return folder, objects

    def run(self, step: Step, folder: Path, strike: tuple[str, int] | None = None, after: float | None = None) -> Ended:
        """Run a step, struck at the k-th operation, or by a signal after so many seconds."""
        filled = {"{out}": [str(folder)], "{url}": [self.bucket.url], "{kind}": KINDS[self.kind]}
        arguments = [word for given in step.arguments for word in filled.get(given, [given])]
        arguments += self.bucket.options if step.uses_bucket else []
        name = strike[0] if strike else ""
        if name.startswith("SIG"):

            def stop(command: Command) -> bool:
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    os.killpg(command.pid, getattr(signal, name))
                    return True
                return False

            return Command(arguments, folder).finish(after, stop)
        return Command(arguments, folder.parent, strike).finish()

    def digest(self, step: Step, folder: Path, objects: Path) -> str | None:
        """Digest of the manifest at a step's place, None if there is none; all that it names must be there."""
        root = folder if step.place == "folder" else self.bucket.bring(objects)
        copy = (root / "copy.json").exists()
        if not copy:
            oracle.check(root)
        manifest = root / "manifest.json"
        return oracle.sha256(manifest) if manifest.exists() else None


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def strike_once(history: History, step: Step, rng: random.Random) -> tuple[str, bool, str | None]:
    """Strike a step and run it once more: the fault, whether it struck, and what was wrong."""
    fault = rng.choice(STRIKES)
    older = None
    if step.before and step.name not in ("publish", "fetch"):
        older = oracle.sha256(history.after[step.before][0] / "manifest.json")
    reference = history.after[step.name][0 if step.place == "folder" else 1]
    newer = oracle.sha256(reference / "manifest.json")
    folder, objects = history.lay(step)
    try:
        at = rng.randrange(history.places.setdefault((step.name, fault), PLACES[fault]))
        mode = {"die": "kill"}.get(fault, fault)
        ended = history.run(step, folder, (mode, at), rng.uniform(0, history.seconds[step.name]))
        struck = ended.code != 0
        if not struck and not fault.startswith("SIG"):
            history.places[step.name, fault] = max(1, at)
        where = f"{history.kind}, {step.name}, {fault} at {at}"
        if "Traceback" in ended.said:
            return fault, struck, f"{where}: a traceback: {ended.said[-300:]}"
        if (found := history.digest(step, folder, objects)) not in (older, newer):
            return fault, struck, f"{where}: a reader sees {found}"
        again = history.run(step, folder)
        if again.code != 0:
            return fault, struck, f"{where}: the same command then failed: {again.said[-300:]}"
        if (found := history.digest(step, folder, objects)) != newer:
            return fault, struck, f"{where}: the same command then left {found} instead of {newer}"
        if ended.stray or again.stray:
            return fault, struck, f"{where}: processes were left"
        return fault, struck, None
    except (AssertionError, OSError, ValueError) as error:
        return fault, True, f"{history.kind}, {step.name}, {fault}: {error}"
    finally:
        shutil.rmtree(folder.parent, ignore_errors=True)


def code_digest() -> str:
    """SHA-256 of the sources that the commands import: faults of other code do not count."""
    digest, package = hashlib.sha256(), Path(__file__).parents[1] / "dmcvb_gen"
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] not in NOT_STRUCK:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def warm_up() -> None:
    """Import, compile and keep, in this process, what commands need; the children that are forked from it have it."""
    import s3fs  # noqa: F401
    from click.testing import CliRunner

    from dmcvb_gen.cli import main as command

    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        for name, kind in KINDS.items():
            made = CliRunner().invoke(
                command, ["rollout", *kind, "--episodes", "1", *SMALL, "--out", f"{folder}/{name}"]
            )
            if made.exit_code:
                sys.exit(f"{name}: a rollout failed without a fault: {made.output}")
    gc.collect()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ledger", type=Path, help="JSON lines to which the faults are added")
    given = parser.parse_args()
    rng, end = random.Random(given.seed), time.monotonic() + 60 * given.minutes
    table: collections.Counter[str] = collections.Counter()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(dir=MEMORY) as scratch, contextlib.closing(Bucket()) as bucket:
        warm_up()
        histories = [History(kind, Path(scratch), bucket) for kind in KINDS]
        left = (end - time.monotonic()) / 60
        print(f"{left:.1f} minutes are left for faults after the references", flush=True)
        while time.monotonic() < end:
            step = rng.choice(STEPS)
            fault, struck, fault_found = strike_once(rng.choice(histories), step, rng)
            table[f"{fault} ({'struck' if struck else 'too late'})"] += 1
            if fault_found:
                wrong.append(fault_found)
                print(f"WRONG {fault_found}", flush=True)
    for name, count in sorted(table.items()):
        print(f"{count:6,}  {name}")
    struck_count = sum(count for name, count in table.items() if "(struck)" in name)
    code = code_digest()
    if given.ledger:
        with given.ledger.open("a") as file:
            print(json.dumps({"code": code, "seed": given.seed, "struck": struck_count, "wrong": wrong}), file=file)
        runs = [json.loads(line) for line in given.ledger.read_text().splitlines()]
        same = [run for run in runs if run["code"] == code]
        print(f"on this code in {len(same)} runs: {sum(run['struck'] for run in same):,} faults struck")
    rate = f"{60 * struck_count / left:,.0f} an hour" if left > 0 else "no time was left"
    print(f"{struck_count:,} faults struck ({rate}), {len(wrong)} found something wrong")
    sys.exit(1 if wrong or not struck_count else 0)


if __name__ == "__main__":
    main()
