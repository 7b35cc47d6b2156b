"""B1: policies on every level and distractor (paper, section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from dmcvb_gen.benchmarks.claims import NEAR, OPEN, Answer, Scores, above, answer_of
from dmcvb_gen.benchmarks.paper import paper_score
from dmcvb_gen.benchmarks.suites import Benchmark, Cell, SubsetFinder, register_benchmark
from dmcvb_gen.spec import DISTRACTOR_KINDS, MAZE_TRAINED_LEVELS, VISIBLE, is_maze

POLICY_SETS = (("expert",), ("medium",), ("expert", "medium"), ("mixed",), ("random",))
"""Levels of the data that a policy learns from; mazes have the first two, and others if a release has them."""


@register_benchmark("b1")
class PolicyLearning(Benchmark):
    """Every agent on every level and distractor; beside BC(state) on the same data."""

    title = "B1: policies on every level and distractor"
    agents = ("state-bc", "bc", "td3-bc", "id+bc", "lfd+bc", "ae+bc", "state+bc")  # DINO's needs weights: ask for it

    def cells(self, data, agents):
        for task in data.tasks:
            if is_maze(task):
                others = [level for level in data.levels(task, VISIBLE) if level not in MAZE_TRAINED_LEVELS]
                settings, sets = [VISIBLE], [(level,) for level in (*MAZE_TRAINED_LEVELS, *others)]
            else:
                settings, sets = list(dict.fromkeys([*DISTRACTOR_KINDS, *data.settings(task)])), list(POLICY_SETS)
            for levels in sets:
                yield from self._set(data, agents, task, settings, levels)

    def _set(self, data: SubsetFinder, agents, task: str, settings: list[str], levels) -> Iterator[Cell]:
        state_done = False
        for setting in settings:
            parts = data.parts(task, levels, setting)
            if not parts:
                continue
            for agent in agents:
                if not (agent.sees_state and state_done):  # states know of no distractors: one cell serves all
                    yield Cell(self.name, task, setting, agent, parts)
            state_done = True

    def paper_score(self, cell):
        return paper_score(cell.task, cell.policy_label, cell.setting, cell.agent.paper_name)

    def reference(self, cell):
        return "BC(state)"

    def is_reference(self, other, cell):
        return other.agent.name == "state-bc" and other.policy_label == cell.policy_label

    @property
    def claims(self):
        return {
            "order": ("Do stronger distractors cost return (none > static > dynamic)?", _order),
            "state": ("Does BC(state) stay near its data (5 %)?", _state),
            "gap": ("Is BC(state) above BC from images?", _gap),
            "id": ("Does ID+BC beat the other agents under distractors and in mazes?", _encoder),
        }


def _order(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.setting not in DISTRACTOR_KINDS[:-1]:
            continue
        later = DISTRACTOR_KINDS[DISTRACTOR_KINDS.index(place.setting) + 1 :]
        following = next((kind for kind in later if replace(place, setting=kind) in scores), None)
        if following:
            pair = (score, scores[replace(place, setting=following)])
            where = f"{place.task} {place.learns_from}, {place.agent}"
            yield above("order", where, (place.setting, following), pair)


def _state(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.agent != "state-bc":
            continue
        within = NEAR * abs(score.data) - abs(score.mean - score.data)
        answer = answer_of(within, score.stderr)
        numbers = f"{score}, data {score.data:.1f}; difference {score.mean - score.data:+.1f}"
        if not score.like_data:
            answer, numbers = OPEN, f"{numbers}, of episodes that were cut at other lengths"
        yield Answer("state", f"{place.task} {place.learns_from}", answer, numbers)


def _gap(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        states = [s for p, s in scores.items() if p == replace(place, setting=p.setting, agent="state-bc")]
        if place.agent == "bc" and states:
            where = f"{place.task} {place.learns_from}, {place.setting}"
            yield above("gap", where, ("BC(state)", "BC"), (states[0], score))


def _encoder(scores: Scores) -> Iterator[Answer]:
    for place, score in scores.items():
        if place.agent != "id+bc" or place.setting == DISTRACTOR_KINDS[0]:
            continue
        for other, beside in scores.items():
            like = other == replace(place, agent=other.agent) and other.agent != place.agent
            if like and not other.agent.startswith("state-"):
                where = f"{place.task} {place.learns_from}, {place.setting}"
                yield above("id", where, (place.agent, other.agent), (score, beside))
