"""What is trained: a release's subsets enter, the cells of benchmarks and the budgets of their trainings leave.

A benchmark registers itself by name; `plan_benchmark` gives the cells of one. B1, B2 and B3 are the paper's sections
5.1 to 5.3.
"""

from __future__ import annotations

import abc
import copy
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from dmcvb_gen import spec
from dmcvb_gen.agents.catalog import Agent, parse_agent
from dmcvb_gen.agents.data import HOLD_OUT, Slice
from dmcvb_gen.agents.learners import PARTS
from dmcvb_gen.agents.networks import PATCHES
from dmcvb_gen.agents.trainer import Budget
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.paper import MAZE_GROUPS, paper_task, read_table
from dmcvb_gen.registry import Registry
from dmcvb_gen.tasks import get_task

SHORT = dict(
    readout_steps=500,
    evaluations=1,
    batch_size=64,
    network=PATCHES,
    shift_from=10.0,
    frozen_shift=False,
    decay=True,
)
"""What the budgets for a CPU share. A policy on a frozen encoder costs them a seventh of an update, as its latents are
computed once.
"""
BUDGETS = {
    budget.name: budget
    for budget in (
        Budget(
            "smoke",
            pixel_steps=3,
            state_steps=3,
            readout_steps=2,
            evaluations=1,
            episodes=2,
            batch_size=16,
            state_batch_size=16,
            muon=True,
            episode_steps=10,
            scores=False,
            note="smoke: a few steps to see that everything runs; its numbers are not scores",
        ),
        Budget(
            "brief",
            pixel_steps=5_000,
            state_steps=10_000,
            rate=2.0,
            note="brief: a small network of 4x4 patches and frame differences, 0.3 % of the paper's samples (2.5 % of "
            "states), random shifts only from ten passes over the data on, none on a frozen encoder, twice the rate, "
            "falling; scores are not comparable with the paper's",
            **SHORT,
        ),
        Budget(
            "quick",
            pixel_steps=16_000,
            state_steps=40_000,
            muon=True,
            note="quick: a small network of 4x4 patches and frame differences, 1 % of the paper's samples (10 % of "
            "states), Muon instead of Adam, a falling rate, random shifts only from ten passes over the data on, and "
            "none on a frozen encoder; scores are not comparable with the paper's",
            **SHORT,
        ),
        Budget("paper", note="paper: 400k steps, batch 256, 30 episodes every 20k steps, as published"),
    )
}


# -- cells ------------------------------------------------------------------------------------------

ENCODER = "encoder"
"""The benchmark of cells that train an encoder alone."""


@dataclass(frozen=True)
class Cell:
    """One number of a benchmark: an agent, what its encoder and what its policy learns from.

    Attributes:
      benchmark: its name; `ENCODER` for an encoder alone, which several cells share.
      policy: slices that the policy (of an encoder alone: it) learns from; evaluation is in the first one's setting.
      pretrain: slices that the encoder learns from, the policy's, if empty; of an encoder alone: the labeled ones.
    """

    benchmark: str
    task: str
    setting: str
    agent: Agent
    policy: tuple[Slice, ...]
    pretrain: tuple[Slice, ...] = ()

    @property
    def id(self) -> str:
        """A file name, different for every cell of a release, whose subsets' names leave out a maze's rows, too."""
        parts = [self.benchmark, spec.task_folder(self.task), self.setting, self.agent.name, self.policy_label]
        parts += [f"from {self.pretrain_label}"] if self.pretrain else []
        return "_".join(re.sub(r"[^A-Za-z0-9.+-]+", "-", part.replace("%", "pc")).strip("-") for part in parts)

    @property
    def policy_label(self) -> str:
        return self._labels(self.policy)

    @property
    def pretrain_label(self) -> str:
        """Name the encoder's data, with its setting if that is another one; "" for the policy's data."""
        return self._labels(self.pretrain)

    def _labels(self, parts: Iterable[Slice]) -> str:
        settings = [(part.label, part.subset.split("/")[-1]) for part in parts]
        return "+".join(label if setting == self.setting else f"{label}, {setting}" for label, setting in settings)

    @property
    def place(self) -> str:
        """Task, what the policy learns from and setting, as the report names them."""
        return f"{spec.task_folder(self.task)}/{self.policy_label}/{self.setting}"

    @property
    def label(self) -> str:
        """Its name among the cells of its place: the agent, and what else its encoder learned from."""
        return f"{self.agent.name} (encoder: {self.pretrain_label})" if self.pretrain else self.agent.name

    @property
    def subsets(self) -> tuple[str, ...]:
        encoder = self.pretrain if self.agent.pretrain else ()
        return tuple(dict.fromkeys(part.subset for part in (*encoder, *self.policy)))

    @property
    def encoder(self) -> Cell | None:
        """The cell of its encoder's pre-training; None if it is trained with the policy, or comes from a file."""
        if self.benchmark == ENCODER or self.agent.pretrain is None or self.agent.sees_by_dino:
            return None
        parts = self.pretrain or self.policy
        labels = self.policy if PARTS.get(self.agent.pretrain).needs_labels else ()
        return Cell(ENCODER, self.task, parts[0].subset.split("/")[-1], self.agent.pretraining, parts, labels)

    def facts(self) -> dict[str, Any]:
        """Everything that decides the cell, as plain values."""
        return asdict(self) | {"agent": self.agent.name}

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Cell:
        """The cell of its facts.

        Raises:
          DmcvbError, LookupError, TypeError: they name an agent that is not known here, or are no cell's.
        """
        parts = {name: tuple(Slice(**part) for part in facts[name]) for name in ("policy", "pretrain")}
        return cls(**{**facts, **parts, "agent": parse_agent(facts["agent"])})


Results = Sequence[tuple[Cell, dict[str, Any]]]
"""Cells with their results."""


@dataclass(frozen=True)
class Missing:
    """Subsets that a benchmark needs of a task and does not find."""

    benchmark: str
    task: str
    subsets: tuple[str, ...]


def only(release: Release, patterns: Sequence[str]) -> Release:
    """A release with the subsets that match, e.g. "walker-walk/expert/*" or both of "walker-walk/medium-expert/none".

    Raises:
      DmcvbError: a pattern matches none.
    """
    names = release.select(patterns)
    records = tuple(record for record in release.manifest.subsets if record.name in names)
    chosen = copy.copy(release)
    chosen.manifest = release.manifest.model_copy(update={"subsets": records})
    return chosen


class SubsetFinder:
    """The subsets of a release by (task, level, setting); remembers what was asked for in vain."""

    def __init__(self, release: Release):
        self.release = release
        self._names = {(s.task, s.level, s.setting): name for name, s in release.subsets.items()}
        self.tasks = tuple(dict.fromkeys(subset.task for subset in release.subsets.values()))
        self._asked: dict[str, list[tuple[str, str]]] = {}

    def settings(self, task: str) -> list[str]:
        """Settings of a task: those there are, in the paper's order, other difficulties last."""
        have = {setting for t, _, setting in self._names if t == task}
        return [*(kind for kind in spec.DISTRACTOR_KINDS if kind in have), *sorted(have - {*spec.DISTRACTOR_KINDS})]

    def levels(self, task: str, setting: str) -> list[str]:
        """Levels that there are of a task and setting, best first."""
        return [level for level in spec.LEVELS if (task, level, setting) in self._names]

    def parts(self, task: str, levels: Iterable[str], setting: str) -> tuple[Slice, ...] | None:
        """All of these subsets, or None if one is missing (which is then noted)."""
        lacking = [(level, setting) for level in levels if (task, level, setting) not in self._names]
        if lacking:
            self._asked.setdefault(task, []).extend(lacking)
            return None
        return tuple(Slice(self._names[task, level, setting]) for level in levels)

    def missing(self, benchmark: str) -> list[Missing]:
        """Requests that nothing in the release fits, by task."""
        return [
            Missing(benchmark, task, tuple(dict.fromkeys(spec.subset_name(task, *place) for place in asked)))
            for task, asked in self._asked.items()
        ]


# -- fixed goals of a maze --------------------------------------------------------------------------


def goal_pairs(subset: Subset) -> tuple[int, ...]:
    """Indices of the (start, goal) pairs whose every episode is there.

    The subset's record decides, never how much of it is at hand: a part of a release is scored on the starts and goals
    of the whole one. If the record does not say it (imported data), the episodes' own labels do.
    """
    per_goal = subset.record.episodes_per_goal
    if per_goal is None:
        return tuple(int(pair) for pair in np.unique(subset.read("goal_pair")) if pair >= 0)
    count, have = subset.record.episodes, set(map(int, subset.episodes))
    firsts = enumerate(range(0, count, per_goal))
    return tuple(pair for pair, first in firsts if have.issuperset(range(first, min(first + per_goal, count))))


def goal_cells(subset: Subset, pair: int | None) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """(row, column) of a pair's start and of its goal, as its first episode shows them; None without a pair.

    Raises:
      DmcvbError: no episode of the pair is there.
    """
    if pair is None:
        return None
    task = get_task(subset.task)
    known = subset.episodes[subset.read("goal_pair") == pair]
    if not len(known):
        raise DmcvbError(f"{subset.name} has no episodes of goal pair {pair}; fetch or roll them out")
    state = subset.read("state", known[:1])[0, 0]

    def cell(field: str) -> tuple[int, int]:
        row, column = np.rint(task.layout.grid(state[task.state_slices[field]][:2]))
        return int(row), int(column)

    return cell("walker_position"), cell("target_position")


# -- the paper's scores -----------------------------------------------------------------------------


def paper_score(task: str, level: str, setting: str, agent: str) -> tuple[float, float] | None:
    """(mean, standard error) of the published score of B1; None if the paper has none.

    Args:
      level: "expert", ..., or "expert+medium".
      setting: "none", "static" or "dynamic" at the paper's difficulty; BC(state) and data have one row for all.
      agent: a column of the paper's table, `Agent.paper_name`, or "data".
    """
    table = read_table("dmcvb_gen.benchmarks", "paper_benchmark1_locomotion.csv", 4)
    row = table.get((task, level, setting, agent)) or table.get((task, level, "any", agent))
    return row and (row["mean"], row["stderr"])


# -- benchmarks -------------------------------------------------------------------------------------


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
        """Name what a cell's score is compared with; by default what the paper's section 5.2 has."""
        return "BC on all of expert/none"

    def is_reference(self, other: Cell, cell: Cell) -> bool:
        """Return True if another cell of the same task is that reference."""
        return (other.setting, other.agent.name, other.policy_label) == ("none", "bc", "expert")

    def group(self, cell: Cell) -> tuple[str, str] | None:
        """(mazes, policy learns from) of the maze cells that the report takes the mean of; None: of others."""
        row = paper_task(cell.task)
        return (row, cell.policy_label) if row in MAZE_GROUPS.values() else None


BENCHMARKS: Registry[Benchmark] = Registry("benchmark", "dmcvb_gen.benchmarks.plan", "dmcvb_gen.benchmarks")


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


def plan_benchmark(name: str, release: Release, agents: Sequence[str] = ()) -> tuple[list[Cell], list[Missing]]:
    """The cells that a release has the data for, and what is missing for the others.

    Args:
      name: name of a registered benchmark.
      agents: names instead of the benchmark's own. B2 and B3 compare encoders: of these, they take those that have one
        of their own, beside BC without.

    Raises:
      DmcvbError: no such benchmark or agent, or an agent's labels are not of its encoder's subsets.
    """
    benchmark, data = BENCHMARKS.get(name), SubsetFinder(release)
    chosen = [parse_agent(agent) for agent in agents or benchmark.agents]
    if benchmark.compares_encoders:
        chosen = [agent for agent in chosen if agent.pretrain]
    # An encoder of DINO learned elsewhere.
    cells = [replace(cell, pretrain=()) if cell.agent.sees_by_dino else cell for cell in benchmark.cells(data, chosen)]
    for encoder in [cell.encoder for cell in cells if cell.encoder]:
        images, labels = ({part.subset for part in parts} for parts in (encoder.policy, encoder.pretrain))
        if not labels <= images:
            raise DmcvbError(
                f"{name}: agent {encoder.agent.name} learns from labels among its encoder's episodes, which are of "
                f"{', '.join(sorted(images))}; remove it, or ask for --benchmark b4"
            )
    return list(dict.fromkeys(cells)), data.missing(name)


@register_benchmark("b1")
class PolicyLearning(Benchmark):
    """Every agent on every level and distractor; beside BC(state) on the same data (section 5.1)."""

    title = "B1: policies on every level and distractor"
    agents = ("state-bc", "bc", "td3-bc", "id+bc", "lfd+bc", "ae+bc", "state+bc")  # DINO's needs weights: ask for it
    level_sets = (("expert",), ("medium",), ("expert", "medium"), ("mixed",), ("random",))

    def cells(self, data, agents):
        for task in data.tasks:
            if spec.is_maze(task):
                others = [level for level in data.levels(task, spec.VISIBLE) if level not in spec.MAZE_TRAINED_LEVELS]
                settings, sets = [spec.VISIBLE], [(level,) for level in (*spec.MAZE_TRAINED_LEVELS, *others)]
            else:
                settings = list(dict.fromkeys([*spec.DISTRACTOR_KINDS, *data.settings(task)]))
                sets = list(self.level_sets)
            for levels in sets:
                found = {setting: data.parts(task, levels, setting) for setting in settings}
                there = [(setting, parts) for setting, parts in found.items() if parts]
                for number, (setting, parts) in enumerate(there):
                    for agent in agents:
                        if number == 0 or not agent.sees_state:  # states know of no distractors: one cell serves all
                            yield Cell(self.name, task, setting, agent, parts)

    def paper_score(self, cell):
        return paper_score(cell.task, cell.policy_label, cell.setting, cell.agent.paper_name)

    def reference(self, cell):
        return "BC(state)"

    def is_reference(self, other, cell):
        return other.agent.name == "state-bc" and other.policy_label == cell.policy_label


@register_benchmark("b2")
class FewEpisodes(Benchmark):
    """Encoders from all mixed episodes beside BC on 20 experts, alone and with the mixed; beside BC on all experts."""

    title = "B2: encoders from mixed data, policies from few expert episodes"
    agents = ("id+bc", "bc+bc", "lfd+bc", "ae+bc")
    compares_encoders = True
    few = 20  # 1 % of the paper's expert subset of 2,000 episodes

    def cells(self, data, agents):
        bc = parse_agent("bc")
        for task in [task for task in data.tasks if not spec.is_maze(task)]:
            full = data.parts(task, ["expert"], "none")
            if full:
                yield Cell(self.name, task, "none", bc, full)  # scores are shares of this one
            for setting in data.settings(task):
                expert, mixed = (data.parts(task, [level], setting) for level in ("expert", "mixed"))
                if not expert:
                    continue
                there = len(data.release[expert[0].subset].episodes)
                few = (replace(expert[0], episodes=min(self.few, there)),)
                yield Cell(self.name, task, setting, bc, few)
                if mixed:
                    yield Cell(self.name, task, setting, bc, few + mixed)
                    for agent in agents:
                        yield Cell(self.name, task, setting, agent, few, mixed)


@register_benchmark("b3")
class FixedGoals(Benchmark):
    """Policies of each (start, goal) pair's episodes, on encoders of hidden random goals and on their own."""

    title = "B3: encoders from hidden random goals, policies from the episodes of one fixed goal"
    agents = ("bc+bc", "id+bc")
    compares_encoders = True

    def cells(self, data, agents):
        mazes = [task for task in data.tasks if spec.is_maze(task)]
        for task in mazes or [f"{spec.ANT_MAZE}-empty7x7"]:
            for level in data.levels(task, spec.FIXED) or ["expert"]:
                fixed, hidden = (data.parts(task, [level], setting) for setting in (spec.FIXED, spec.HIDDEN))
                for pair in goal_pairs(data.release[fixed[0].subset]) if fixed else ():
                    ten = (replace(fixed[0], goal_pair=pair),)
                    yield Cell(self.name, task, spec.FIXED, parse_agent("bc"), ten)
                    for agent in agents if hidden else ():
                        yield Cell(self.name, task, spec.FIXED, agent, ten, hidden)

    def reference(self, cell):
        return "BC on these episodes"

    def is_reference(self, other, cell):
        return other.agent.name == "bc" and other.policy == cell.policy

    def group(self, cell):
        return spec.task_folder(cell.task), cell.policy_label.partition(" goal ")[0]


@register_benchmark("b4")
class LabelBudgets(Benchmark):
    """Latent actions of all expert images decoded by few labeled episodes, beside BC on those and on all.

    The protocol of LAOM (Nikulin et al. 2025). The seed of the trainings draws the episodes; a smaller budget is a part
    of a larger one, whatever the agent, so scores of one budget are of the same labels.
    """

    title = "B4: label budgets, latent actions from all images and few labeled episodes"
    agents = ("lapo+bc", "laom+bc", "laom-labels+bc")
    compares_encoders = True
    budgets = (2, 8, 32, 128)

    def cells(self, data, agents):
        bc = parse_agent("bc")
        for task in data.tasks:
            for setting in [spec.VISIBLE] if spec.is_maze(task) else data.settings(task):
                whole = data.parts(task, ["expert"], setting)
                if not whole:
                    continue
                yield Cell(self.name, task, setting, bc, whole)  # scores are shares of this one
                there = len(data.release[whole[0].subset].episodes)
                for budget in [budget for budget in self.budgets if budget < there - math.ceil(HOLD_OUT * there)]:
                    labeled = (replace(whole[0], episodes=budget),)
                    yield Cell(self.name, task, setting, bc, labeled)
                    for agent in agents:
                        yield Cell(self.name, task, setting, agent, labeled, whole)

    def reference(self, cell):
        return "BC on all labels"

    def is_reference(self, other, cell):
        return other.agent.name == "bc" and (other.setting, other.policy_label) == (cell.setting, "expert")
