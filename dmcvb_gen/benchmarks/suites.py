"""Benchmarks, which turn a release's subsets into cells (agent, pre-training set, policy set).

Each benchmark has a file in `definitions`, and registers itself; `plan_benchmark` gives the cells of one.
"""

from __future__ import annotations

import abc
import re
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from dmcvb_gen.agents.catalog import Agent, parse_agent
from dmcvb_gen.agents.data import Slice
from dmcvb_gen.benchmarks.goals import goal_pairs
from dmcvb_gen.dataset import Release
from dmcvb_gen.generate.inputs import BUILTIN, video_source
from dmcvb_gen.policies.bundled import bundled_levels
from dmcvb_gen.policies.paper import MAZE_GROUPS, paper_task
from dmcvb_gen.registry import Registry
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.spec import DISTRACTOR_KINDS, FIXED, LEVELS, VISIBLE, is_maze, subset_name
from dmcvb_gen.tasks import get_task

FIXED_GOALS = 5
"""Fixed (start, goal) pairs a layout, as the paper made them."""
DEFAULT_EPISODES = 100
"""Episodes that a command asks for if the release has none to go by."""
DEFAULT_SIZE = 64
"""Pixels a side if a rollout is not told another size."""


@dataclass(frozen=True)
class Cell:
    """One number of a benchmark: an agent, what its encoder and what its policy learns from.

    Attributes:
      policy: parts that the policy learns from; it is evaluated in the task and setting of the first.
      pretrain: parts that the encoder learns from; the policy's, if empty.
    """

    benchmark: str
    task: str
    setting: str
    agent: Agent
    policy: tuple[Slice, ...]
    pretrain: tuple[Slice, ...] = ()

    @property
    def policy_label(self) -> str:
        return "+".join(part.label for part in self.policy)

    @property
    def pretrain_label(self) -> str:
        """Name the encoder's data, with its setting if that is another one; "" for the policy's data."""
        labels = []
        for part in self.pretrain:
            setting = part.subset.split("/")[-1]
            labels.append(part.label if setting == self.setting else f"{part.label}, {setting}")
        return "+".join(labels)

    @property
    def pretrain_parts(self) -> tuple[Slice, ...]:
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
        return asdict(self) | {"agent": self.agent.facts(), "agent_name": self.agent.name}


@dataclass(frozen=True)
class Missing:
    """Subsets that a part of a benchmark needs besides.

    Attributes:
      subsets: those that the release lacks.
      command: command that gets those.
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


class SubsetFinder:
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
        """Names of the subsets, or None if one is missing (which is then noted)."""
        lacking = [(level, setting) for level in levels if (task, level, setting) not in self._names]
        if lacking:
            self._asked.setdefault(task, []).extend(lacking)
            return None
        return tuple(self._names[task, level, setting] for level in levels)

    def parts(self, task: str, levels: Iterable[str], setting: str, **share: Any) -> tuple[Slice, ...] | None:
        names = self.find(task, levels, setting)
        return names and tuple(Slice(name, **share) for name in names)

    def first(self, task: str, level: str, setting: str, most: int) -> tuple[Slice, ...] | None:
        """Some episodes of a subset, all of them if it has no more than that."""
        names = self.find(task, [level], setting)
        return names and tuple(Slice(name, episodes=min(most, len(self.release[name].episodes))) for name in names)

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
        """Return the command that rolls out a task with what is missing and what the release has of it."""
        have = [(level, setting) for t, level, setting in self._names if t == task]
        levels = dict.fromkeys(level for level, _ in have + lacking)
        settings = dict.fromkeys(setting for _, setting in have + lacking)
        counts = [self._records[self._names[task, *place]].episodes for place in have if place[1] != FIXED]
        count = max(counts, default=DEFAULT_EPISODES)
        shape = self._shape(task) + self._sources(task, levels)
        rollout = f"dmcvb-gen rollout {shlex.quote(task)} " + " ".join(f"--level {level}" for level in levels)
        out = f"--out releases/{slug(benchmark)}"
        if not is_maze(task):
            return f"{rollout}{''.join(f' --distractor {s}' for s in settings)} --episodes {count}{shape} {out}"
        goals = [setting for setting in settings if setting != FIXED]
        asked = [f"--goal {setting}" for setting in goals] + [f"--episodes {count}"] * bool(goals)
        asked += [f"--fixed-goals {FIXED_GOALS}"] * (FIXED in settings)
        return f"{rollout} {' '.join(asked)}{shape} {out}"

    def _sources(self, task: str, levels: Iterable[str]) -> str:
        """Options for policies and videos that the package does not bring, with names to be filled in."""
        sources = {video_source(self.release.root, r) for r in self._records.values() if r.task == task}
        brought = {"random", *bundled_levels(task)}
        return " --behaviour RUN" * (not set(levels) <= brought) + " --backgrounds FOLDER" * bool(sources - {BUILTIN})

    def _shape(self, task: str) -> str:
        """Options that give new subsets the images' size and the time limit of what there is of a task."""
        shapes = {(r.size, r.max_steps) for r in self._records.values() if r.task == task}
        if len(shapes) != 1:
            return ""
        size, limit = shapes.pop()
        options = f" --size {size}" if size != DEFAULT_SIZE else ""
        return options + (f" --max-steps {limit}" if limit != get_task(task).max_steps else "")


class Benchmark(abc.ABC):
    """A benchmark: which cells a release has the data for, and what their scores are set beside.

    Attributes:
      name: name that it is registered under. title: title of its table in the report.
      agents: names of the agents that it runs unless others are asked for.
      compares_encoders: its agents are those with a pre-trained encoder; it sets BC beside them by itself.
    """

    name: str
    title: str
    agents: tuple[str, ...]
    compares_encoders = False

    @abc.abstractmethod
    def cells(self, data: SubsetFinder, agents: Sequence[Agent]) -> Iterator[Cell]:
        """The cells that the data allow; what `data` is asked for in vain is reported as missing."""

    def paper_score(self, cell: Cell) -> tuple[float, float] | None:
        """(mean, standard error) that the paper has of a cell."""
        return None

    def reference(self, cell: Cell) -> str:
        """Name what a cell's score is compared with; by default the paper's appendix "Dataset size study"."""
        return f"BC on all of expert/{_whole_setting(cell)}"

    def is_reference(self, other: Cell, cell: Cell) -> bool:
        """Return True if another cell of the same task is that reference."""
        return (other.setting, other.agent.name, other.policy_label) == (_whole_setting(cell), "bc", "expert")

    def group(self, task: str, policy_label: str) -> tuple[str, str] | None:
        """(mazes, policy learns from) of the maze cells that the report takes the mean of; None: of others."""
        row = paper_task(task)
        return (row, policy_label) if row in MAZE_GROUPS.values() else None

    def warnings(self, release: Release, cells: Sequence[Cell]) -> Iterator[Issue]:
        """List what makes its scores say less than they seem to."""
        return iter(())

    @property
    def claims(self) -> Mapping[str, tuple[str, Callable]]:
        """Claim -> its words, and a function that answers it from scores (see `claims`)."""
        return {}


def _whole_setting(cell: Cell) -> str:
    return VISIBLE if is_maze(cell.task) else DISTRACTOR_KINDS[0]


BENCHMARKS: Registry[Benchmark] = Registry("benchmark", "dmcvb_gen.benchmarks.definitions", "dmcvb_gen.benchmarks")


def register_benchmark(name: str) -> Callable[[type[Benchmark]], type[Benchmark]]:
    """Class decorator that makes a benchmark known by name.

    Raises:
      DmcvbError: another class has that name already.
    """

    def register(benchmark: type[Benchmark]) -> type[Benchmark]:
        benchmark.name = name
        BENCHMARKS.add(name, benchmark(), code=benchmark)
        return benchmark

    return register


def plan_benchmark(
    name: str, release: Release, agents: Sequence[str] = (), left_out: Collection[str] = ()
) -> tuple[list[Cell], list[Missing]]:
    """The cells that a release has the data for, and what is missing for the others.

    Args:
      name: name of a registered benchmark.
      agents: names instead of the benchmark's own. B2 and B3 compare encoders: of these, they take those that have one
        of their own, beside BC without.
      left_out: subsets that are there but that the user left out of `release`.

    Raises:
      DmcvbError: no such benchmark or agent.
    """
    benchmark, data = BENCHMARKS.get(name), SubsetFinder(release)
    chosen = [parse_agent(agent) for agent in agents or benchmark.agents]
    if benchmark.compares_encoders:
        chosen = [agent for agent in chosen if agent.pretrain]
    cells = list(benchmark.cells(data, chosen))
    return list(dict.fromkeys(cells)), data.missing(name, left_out)
