"""The benchmarks as tables: a release's subsets in, cells (agent, pre-training set, policy set) out.

b1         every agent on every level and distractor                           (paper, section 5.1)
b2         encoders from mixed data, policies from 20 expert episodes          (section 5.2)
b3         encoders from hidden random goals, policies from ten episodes of one fixed goal (section 5.3)
ablations  frames of a stack, k of inverse dynamics, share of the data         (appendix)
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from dmcvb_gen.agents.catalog import Agent, parse_agent
from dmcvb_gen.agents.data import part_count
from dmcvb_gen.benchmarks.goals import goal_pairs
from dmcvb_gen.dataset import Release
from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.spec import (
    ANT_MAZE,
    DISTRACTOR_KINDS,
    FIXED,
    HIDDEN,
    LEVELS,
    MAZE_TRAINED_LEVELS,
    VISIBLE,
    is_maze,
    subset_name,
)

BENCHMARKS = ("b1", "b2", "b3", "ablations")
POLICY_SETS = (("expert",), ("medium",), ("expert", "medium"), ("mixed",), ("random",))
"""Levels of the data that a policy learns from, B1; mazes have the first two, and others where a release has them."""
B1_AGENTS = ("state-bc", "bc", "td3-bc", "id+bc", "lfd+bc", "ae+bc", "state+bc")
"""The paper's columns; DINO's needs weights, so it is asked for by name."""
B3_LEVEL = "expert"
B3_PAIRS = 5
"""Fixed (start, goal) pairs a layout, as the paper made them."""
DEFAULT_EPISODES = 100
"""That a command asks for where the release has none to go by."""
FEW_EPISODES = 20
"""B2: 1 % of the paper's expert subset of 2,000 episodes."""
B2_AGENTS = ("id+bc", "bc+bc", "lfd+bc", "ae+bc")
B3_AGENTS = ("bc+bc", "id+bc")
ABLATION_AGENTS = ("bc:frames=1", "bc", "bc+bc", "id+bc", "id+bc:k=5", "id+bc:k=10", "id+bc:k=10,sample")
"""Inverse dynamics over more steps stand beside pre-training by BC, which the paper sees them tend to."""
SHARES = (0.01, 0.05, 0.1, 0.25, 0.5)


@dataclass(frozen=True)
class Part:
    """A part of a subset by name, as `agents.data.Source`."""

    subset: str
    share: float = 1.0
    episodes: int | None = None
    goal_pair: int | None = None

    @property
    def label(self) -> str:
        level = self.subset.split("/")[-2]
        if self.goal_pair is not None:
            return f"{level} goal {self.goal_pair}"
        if self.episodes is not None:
            return f"{self.episodes} {level}"
        return level if self.share == 1 else f"{100 * self.share:g}% {level}"


@dataclass(frozen=True)
class Cell:
    """One number of a benchmark: an agent, what its encoder and what its policy learns from.

    Attributes:
      policy: parts that the policy learns from; it is evaluated in the task and setting of the first.
      pretrain: parts that the encoder learns from; the policy's, where empty.
    """

    benchmark: str
    task: str
    setting: str
    agent: Agent
    policy: tuple[Part, ...]
    pretrain: tuple[Part, ...] = ()

    @property
    def policy_label(self) -> str:
        return "+".join(part.label for part in self.policy)

    @property
    def pretrain_label(self) -> str:
        """What the encoder learns from, with its setting where that is another one; "" for the policy's data."""
        labels = []
        for part in self.pretrain:
            setting = part.subset.split("/")[-1]
            labels.append(part.label if setting == self.setting else f"{part.label}, {setting}")
        return "+".join(labels)

    @property
    def pretrain_parts(self) -> tuple[Part, ...]:
        return (self.pretrain or self.policy) if self.agent.pretrain else ()

    @property
    def subsets(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(part.subset for part in (*self.pretrain_parts, *self.policy)))

    @property
    def id(self) -> str:
        """A file name, different for every cell of a release."""
        parts = [self.benchmark, self.task, self.setting, self.agent.name, self.policy_label]
        parts += ["from " + "+".join(part.label for part in self.pretrain)] if self.pretrain else []
        return "_".join(slug(part) for part in parts)

    def facts(self) -> dict[str, Any]:
        """Everything that decides the cell, as plain values."""
        return asdict(self) | {"agent": asdict(self.agent), "agent_name": self.agent.name}


@dataclass(frozen=True)
class Missing:
    """Subsets that a part of a benchmark needs besides.

    Attributes:
      subsets: those that the release lacks.
      command: how to get those.
      left_out: those that the release has and the user left out.
    """

    benchmark: str
    task: str
    subsets: tuple[str, ...]
    command: str
    left_out: tuple[str, ...] = ()


def slug(text: str) -> str:
    """A piece of a file name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", text.replace("%", "pc")).strip("-")


def plan_benchmark(
    name: str, release: Release, agents: Sequence[str] = (), left_out: Collection[str] = ()
) -> tuple[list[Cell], list[Missing]]:
    """The cells that a release has the data for, and what is missing for the others.

    Args:
      name: one of `BENCHMARKS`.
      agents: names instead of the benchmark's own. B2 and B3 compare encoders: of these, they take those that have one
        of their own, beside BC without.
      left_out: subsets that are there but that the user left out of `release`.

    Raises:
      DmcvbError: no such benchmark or agent.
    """
    makers = {"b1": _b1, "b2": _b2, "b3": _b3, "ablations": _ablations}
    if name not in makers:
        raise UnknownNameError("benchmark", name, BENCHMARKS)
    shelf = _Shelf(release)
    chosen = [parse_agent(agent) for agent in agents]
    cells = list(makers[name](shelf, chosen))
    return list(dict.fromkeys(cells)), shelf.missing(name, left_out)


class _Shelf:
    """The subsets of a release by (task, level, setting); remembers what was asked for in vain."""

    def __init__(self, release: Release):
        self.release = release
        self._names = {(s.task, s.level, s.setting): name for name, s in release.subsets.items()}
        self._records = {name: subset.record for name, subset in release.subsets.items()}
        self.tasks = tuple(dict.fromkeys(subset.task for subset in release.subsets.values()))
        self._asked: dict[str, list[tuple[str, str]]] = {}
        self._partial: dict[str, tuple[int, ...]] = {}

    def settings(self, task: str) -> list[str]:
        """Settings of a task: those there are, in the paper's order, other difficulties last."""
        have = dict.fromkeys(setting for t, _, setting in self._names if t == task)
        order = {setting: index for index, setting in enumerate(DISTRACTOR_KINDS)}
        return sorted(have, key=lambda s: (order.get(s, len(order)), s))

    def levels(self, task: str, setting: str) -> list[str]:
        """Levels that there are of a task and setting, best first."""
        return [level for level in LEVELS if (task, level, setting) in self._names]

    def find(self, task: str, levels: Iterable[str], setting: str) -> tuple[str, ...] | None:
        """Names of the subsets, or None where one is missing (which is then noted)."""
        lacking = [(level, setting) for level in levels if (task, level, setting) not in self._names]
        if lacking:
            self._asked.setdefault(task, []).extend(lacking)
            return None
        return tuple(self._names[task, level, setting] for level in levels)

    def parts(self, task: str, levels: Iterable[str], setting: str, **share: Any) -> tuple[Part, ...] | None:
        names = self.find(task, levels, setting)
        return names and tuple(Part(name, **share) for name in names)

    def first(self, task: str, level: str, setting: str, most: int) -> tuple[Part, ...] | None:
        """Some episodes of a subset, all of them where it has no more than that."""
        names = self.find(task, [level], setting)
        return names and tuple(Part(name, episodes=min(most, len(self.release[name].episodes))) for name in names)

    def pairs(self, name: str) -> tuple[int, ...]:
        """The goal pairs of a fixed-goal subset whose episodes are all there; the others are noted."""
        pairs = goal_pairs(self.release[name])
        if pairs.partial:
            self._partial[name] = pairs.partial
        return pairs.whole

    def missing(self, benchmark: str, left_out: Collection[str]) -> list[Missing]:
        found = []
        for task, asked in self._asked.items():
            names = {subset_name(task, level, setting): (level, setting) for level, setting in asked}
            excluded = tuple(name for name in names if name in left_out)
            names = {name: where for name, where in names.items() if name not in left_out}
            command = self._command(benchmark, task, list(names.values())) if names else ""
            found.append(Missing(benchmark, task, tuple(names), command, excluded))
        for name, pairs in self._partial.items():
            lacking = f"{name}, episodes of goal pairs {', '.join(map(str, pairs))}"
            task = self._records[name].task
            found.append(Missing(benchmark, task, (lacking,), "fetch them, or run the release's rollout again"))
        return found

    def _command(self, benchmark: str, task: str, lacking: list[tuple[str, str]]) -> str:
        """How to roll out a task with what is lacking, and with what the release has of it."""
        have = [(level, setting) for t, level, setting in self._names if t == task]
        levels = dict.fromkeys(level for level, _ in have + lacking)
        settings = dict.fromkeys(setting for _, setting in have + lacking)
        counts = [self._records[self._names[task, *place]].episodes for place in have if place[1] != FIXED]
        count = max(counts, default=DEFAULT_EPISODES)
        rollout = f"dmcvb-gen rollout {shlex.quote(task)} " + " ".join(f"--level {level}" for level in levels)
        out = f"--out releases/{slug(benchmark)}"
        if not is_maze(task):
            return f"{rollout}{''.join(f' --distractor {s}' for s in settings)} --episodes {count} {out}"
        goals = [setting for setting in settings if setting != FIXED]
        lines = [f"{rollout} {' '.join(f'--goal {s}' for s in goals)} --episodes {count}"] if goals else []
        lines += [f"{rollout} --fixed-goals {B3_PAIRS}"] if FIXED in settings else []
        return "; ".join(f"{line} {out}-{number}" for number, line in enumerate(lines))


def _b1(shelf: _Shelf, agents: list[Agent]):
    agents = agents or [parse_agent(name) for name in B1_AGENTS]
    for task in shelf.tasks:
        if is_maze(task):
            settings = [VISIBLE]
            others = [(level,) for level in shelf.levels(task, VISIBLE) if level not in MAZE_TRAINED_LEVELS]
            sets = [*((level,) for level in MAZE_TRAINED_LEVELS), *others]
        else:
            settings, sets = list(dict.fromkeys([*DISTRACTOR_KINDS, *shelf.settings(task)])), list(POLICY_SETS)
        for levels in sets:
            state_done = False
            for setting in settings:
                parts = shelf.parts(task, levels, setting)
                if not parts:
                    continue
                for agent in agents:
                    if agent.sees_state and state_done:
                        continue  # states know of no distractors: one cell serves all
                    yield Cell("b1", task, setting, agent, parts)
                state_done = True


def _b2(shelf: _Shelf, agents: list[Agent]):
    encoders = [agent for agent in agents or map(parse_agent, B2_AGENTS) if agent.pretrain]
    bc, reference = parse_agent("bc"), parse_agent("bc")
    for task in [task for task in shelf.tasks if not is_maze(task)]:
        full = shelf.parts(task, ["expert"], "none")
        if full:
            yield Cell("b2", task, "none", reference, full)  # scores are shares of this one
        for setting in shelf.settings(task):
            few = shelf.first(task, "expert", setting, FEW_EPISODES)
            mixed = shelf.parts(task, ["mixed"], setting)
            if not few:
                continue
            yield Cell("b2", task, setting, bc, few)
            if mixed:
                yield Cell("b2", task, setting, bc, few + mixed)
                for agent in encoders:
                    yield Cell("b2", task, setting, agent, few, mixed)


def _b3(shelf: _Shelf, agents: list[Agent]):
    encoders = [agent for agent in agents or map(parse_agent, B3_AGENTS) if agent.pretrain]
    mazes = [task for task in shelf.tasks if is_maze(task)]
    for task in mazes or [f"{ANT_MAZE}-empty7x7"]:
        for level in shelf.levels(task, FIXED) or [B3_LEVEL]:
            fixed, hidden = shelf.find(task, [level], FIXED), shelf.parts(task, [level], HIDDEN)
            if not fixed:
                continue
            for pair in shelf.pairs(fixed[0]):
                ten = (Part(fixed[0], goal_pair=pair),)
                yield Cell("b3", task, FIXED, parse_agent("bc"), ten)
                for agent in encoders if hidden else ():
                    yield Cell("b3", task, FIXED, agent, ten, hidden)


def _distinct_shares(episodes: int) -> list[float]:
    """Shares of a number of episodes, the largest of those that come to the same count."""
    counts = {part_count(share, episodes): share for share in SHARES}
    return [share for count, share in counts.items() if count < episodes]


def _ablations(shelf: _Shelf, agents: list[Agent]):
    agents = agents or [parse_agent(name) for name in ABLATION_AGENTS]
    for task in shelf.tasks:
        for setting in [VISIBLE] if is_maze(task) else shelf.settings(task):
            parts = shelf.parts(task, ["expert"], setting)
            if not parts:
                continue
            for agent in agents:
                yield Cell("ablations", task, setting, agent, parts)
            pictures = [agent for agent in agents if agent.name == "bc"]
            shares = _distinct_shares(len(shelf.release[parts[0].subset].episodes))
            for share, agent in itertools.product(shares, pictures):
                yield Cell("ablations", task, setting, agent, (Part(parts[0].subset, share=share),))
