"""Races: every pair of commands on one release at once, in a folder and in a bucket.

Two commands start on a release that is half made, the second a moment after the first. Both must end in a documented
way: done, or refused in one line. Then each of them is given again until it is done. The release must then be what one
of the two orders gives without a race: the same subsets with the same digests, sound, and without temporary files.
"""

from __future__ import annotations

import itertools
import json
import random
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.faults.commands import Command, Ended

BASES = {
    "walker": ["walker-walk", "--distractor", "none", "--episodes", "2"],
    "maze": ["ant-maze-empty7x7", "--goal", "hidden", "--episodes", "2"],
}
ADDED = {"walker": ["walker-walk", "--distractor", "static", "--episodes", "2"]}
ADDED["maze"] = ["ant-maze-empty7x7", "--goal", "visible", "--episodes", "2"]
SMALL = ["--level", "random", "--episodes-per-shard", "1", "--size", "8", "--max-steps", "12", "--workers", "1"]
FOLDER = ("rollout", "grow", "finish", "paint", "regenerate", "publish", "fetch", "verify")
BUCKET = ("rollout", "grow", "finish", "publish", "fetch", "verify")
"""Commands that write to or read from a release at a URL."""
CODES = {0, 1, 2, 3}
"""Exit codes that are documented: done, damage found, refused, not finished yet."""
TRIES = 4
"""How often a command may be refused after the race."""


class Wrong(Exception):
    """Something that may not happen, in words."""


@dataclass(frozen=True)
class Pair:
    """Two commands on one release: "walker/folder/grow+finish"."""

    kind: str
    place: str
    first: str
    second: str

    @property
    def name(self) -> str:
        return f"{self.kind}/{self.place}/{self.first}+{self.second}"


def all_pairs() -> list[Pair]:
    """Every pair of commands, a command with itself too, for both kinds of tasks and both places."""
    return [
        Pair(kind, place, *two)
        for place, names in (("folder", FOLDER), ("bucket", BUCKET))
        for kind in BASES
        for two in itertools.combinations_with_replacement(names, 2)
    ]


class Racecourse:
    """Where one pair runs: a folder of its own, and the bucket's prefix if the release is there.

    Args:
      s3: URL of the S3 server; needed for buckets alone.
    """

    def __init__(self, pair: Pair, folder: Path, s3: str | None):
        self.pair, self.folder, self.s3 = pair, folder, s3
        self.release, self.scratch = folder / "release", folder / "scratch"
        self.prefix = f"bucket/{folder.name}"
        shutil.rmtree(folder, ignore_errors=True)
        self.scratch.mkdir(parents=True)

    @property
    def url(self) -> list[str]:
        """The release and the options of its place."""
        if self.pair.place == "folder":
            return [str(self.release)]
        return [f"s3://{self.prefix}", "--option", f"endpoint_url={self.s3}"]

    def rollout(self, subsets: Sequence[str], *more: str) -> list[str]:
        scratch = [] if self.pair.place == "folder" else ["--scratch", str(self.scratch)]
        return ["rollout", *subsets, *SMALL, "--no-pixels", *more, *scratch, "--out", *self.url]

    def arguments(self, command: str, runner: int) -> list[str]:
        """Of a command of the pair, run by the first (0) or the second (1)."""
        base = BASES[self.pair.kind]
        bucket = self.pair.place == "bucket"
        return {
            "rollout": lambda: self.rollout(base),
            "grow": lambda: self.rollout(ADDED[self.pair.kind]),
            "finish": lambda: self.rollout(base, "--finish"),
            "paint": lambda: ["paint", str(self.release)],
            "regenerate": lambda: ["regenerate", str(self.release)],
            "publish": lambda: ["publish", str(self.folder / "whole" if bucket else self.release), *self._target()],
            "fetch": lambda: ["fetch", *self._source(), "--out", str(self.folder / f"fetched-{runner}")],
            "verify": lambda: ["verify", *self.url],
        }[command]()

    def _target(self) -> list[str]:
        return self.url if self.pair.place == "bucket" else [f"file://{self.folder / 'published'}"]

    def _source(self) -> list[str]:
        return self.url if self.pair.place == "bucket" else [f"file://{self.release}"]

    def run(self, arguments: Sequence[str]) -> Ended:
        return checked(Command(arguments, self.folder).finish(), arguments)

    def begin(self) -> None:
        """A release without pictures of two shards, of which one is made; damaged if the pair mends it."""
        base = BASES[self.pair.kind]
        if self.pair.place == "bucket":
            whole = ["rollout", *base, *SMALL, "--no-pixels", "--out", str(self.folder / "whole")]
            assert self.run(whole).code == 0
        for more in (["--init"], ["--part", "1/2"]):
            if (ended := self.run(self.rollout(base, *more))).code != 0:
                raise Wrong(f"the start of {self.pair.name} ended with {ended.code}:\n{ended.said}")
        if "regenerate" in (self.pair.first, self.pair.second):
            sorted(self.release.glob("**/reward/c/**/*"))[-1].write_bytes(b"damaged")

    def until_done(self) -> None:
        """Each of the pair's commands again, until it is done; then the release is completed and verified."""
        mends = "regenerate" in (self.pair.first, self.pair.second)
        order = [name for name in FOLDER if name in (self.pair.first, self.pair.second, "rollout")]
        if mends:
            order.insert(0, order.pop(order.index("regenerate")))
        for name in [*order, "finish", "verify"]:
            for _ in range(TRIES):
                ended = self.run(self.arguments(name, 1))
                if ended.code == 0:
                    break
            else:
                raise Wrong(f"{name}, given again, ends with {ended.code}:\n{ended.said}")

    def outcome(self) -> dict[str, str]:
        """Subset -> digest of the finished release; and what lies about that should not."""
        if self.pair.place == "bucket":
            to = self.folder / "outcome"
            assert self.run(["fetch", *self.url, "--out", str(to)]).code == 0
        else:
            to = self.release
        manifest = json.loads((to / "manifest.json").read_text())
        found = {subset["name"]: subset["digest"] for subset in manifest["subsets"]}
        for path in self.release.rglob("*"):
            if path.is_file() and (path.name.endswith(".partial") or ".partial" in path.parts):
                raise Wrong(f"{path.relative_to(self.release)} is left over")
        return found


def checked(ended: Ended, arguments: Sequence[str]) -> Ended:
    """Raises `Wrong` if a command ended as no command may."""
    words = " ".join(arguments)
    last = "\n".join(ended.said.strip().splitlines()[-12:])
    if "Traceback" in ended.said or "Exception ignored" in ended.said or "HUNG" in ended.said:
        raise Wrong(f"{words} printed:\n{last}")
    if ended.code not in CODES:
        raise Wrong(f"{words} ended with {ended.code}:\n{last}")
    if ended.code == 2 and "error:" not in ended.said.lower():
        raise Wrong(f"{words} ended with 2 and no line that says why:\n{last}")
    if ended.stray:
        raise Wrong(f"{words} left processes behind: {ended.stray}")
    return ended


def orders(pair: Pair, folder: Path, s3: str | None) -> list[dict[str, str]]:
    """What the two orders of a pair give, one command after the other."""
    found = []
    for number, names in enumerate(dict.fromkeys([(pair.first, pair.second), (pair.second, pair.first)])):
        course = Racecourse(pair, folder / f"{_plain(pair.name)}-order-{number}", s3)
        course.begin()
        for runner, name in enumerate(names):
            course.run(course.arguments(name, runner))
        course.until_done()
        found.append(course.outcome())
        shutil.rmtree(course.folder)
    return found


def race(pair: Pair, folder: Path, s3: str | None, seed: int, wanted: list[dict[str, str]] | None = None) -> list[int]:
    """One race of a pair, from a seed.

    Returns:
      The exit codes of the two.

    Raises:
      Wrong: a command ended as none may, or the release is not what one order gives.
    """
    rng = random.Random(f"{seed}/{pair.name}")
    wanted = orders(pair, folder, s3) if wanted is None else wanted
    course = Racecourse(pair, folder / f"{_plain(pair.name)}-{seed}", s3)
    course.begin()
    started = time.time()
    first = Command(course.arguments(pair.first, 0), course.folder)
    time.sleep(rng.choice([0, rng.uniform(0, 1.0)]))
    arguments = course.arguments(pair.second, 1)
    second = Command(arguments, course.folder).finish()
    ended = [first.finish(), second]
    for end, name, runner in ((ended[0], pair.first, 0), (second, pair.second, 1)):
        checked(end, course.arguments(name, runner))
    course.until_done()
    if (found := course.outcome()) not in wanted:
        raise Wrong(
            f"the release has {found}, not {' nor '.join(map(str, wanted))}, after {time.time() - started:.1f} s"
        )
    shutil.rmtree(course.folder)
    return [end.code for end in ended]


def campaign(pairs: Sequence[Pair], folder: Path, s3: str | None, seed: int, table: Path | None = None) -> int:
    """Race pairs one after the other and print a line each. Pairs that `table` has with this seed are skipped.

    Returns:
      How many races of the table went wrong.
    """
    done: dict[str, str] = json.loads(table.read_text()) if table and table.exists() else {}
    for pair in pairs:
        key = f"{seed}/{pair.name}"
        if key in done:
            continue
        try:
            codes = race(pair, folder, s3, seed)
            done[key] = f"ok {codes[0]} {codes[1]}"
        except Wrong as error:
            done[key] = f"WRONG {error}"
        except Exception as error:
            done[key] = f"WRONG the campaign itself: {error!r}"
        print(f"{key}: {done[key]}", flush=True)
        if table:
            part = table.with_suffix(".part")
            part.write_text(json.dumps(done, indent=0))
            part.replace(table)
    return sum(words.startswith("WRONG") for words in done.values())


def summary(table: Path) -> str:
    """Markdown: a row a pair of commands, a column a place: races, and how many of them went wrong."""
    cells: dict[tuple[str, str], list[bool]] = {}
    for key, words in json.loads(table.read_text()).items():
        _, _, place, two = key.split("/")
        cells.setdefault((two, place), []).append(words.startswith("WRONG"))
    lines = ["| at once | folder | bucket | wrong |", "|---|---|---|---|"]
    for two in sorted({two for two, _ in cells}):
        row = [cells.get((two, place), []) for place in ("folder", "bucket")]
        lines.append(f"| {two.replace('+', ', ')} | {len(row[0]) or ''} | {len(row[1]) or ''} | {sum(map(sum, row))} |")
    total = [sum(len(wrong) for (_, at), wrong in cells.items() if at == place) for place in ("folder", "bucket")]
    lines.append(f"| all | {total[0]} | {total[1]} | {sum(sum(wrong) for wrong in cells.values())} |")
    return "\n".join(lines)


def _plain(name: str) -> str:
    return name.replace("/", "-").replace("+", "-")
