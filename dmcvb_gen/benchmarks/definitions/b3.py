"""B3: encoders from hidden random goals, policies from ten episodes of one fixed goal (paper, section 5.3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.benchmarks.claims import Answer, Place, Pooled, Scores, above, mean_of, pretrained
from dmcvb_gen.benchmarks.suites import Benchmark, Cell, Slice, register_benchmark
from dmcvb_gen.spec import ANT_MAZE, FIXED, HIDDEN, is_maze, task_folder

LEVEL = "expert"


@register_benchmark("b3")
class FixedGoals(Benchmark):
    """Policies of each (start, goal) pair's episodes, on encoders of hidden random goals and on their own."""

    title = "B3: encoders from hidden random goals, policies from the episodes of one fixed goal"
    agents = ("bc+bc", "id+bc")
    compares_encoders = True

    def cells(self, data, agents):
        mazes = [task for task in data.tasks if is_maze(task)]
        for task in mazes or [f"{ANT_MAZE}-empty7x7"]:
            for level in data.levels(task, FIXED) or [LEVEL]:
                fixed, hidden = data.find(task, [level], FIXED), data.parts(task, [level], HIDDEN)
                for pair in data.pairs(fixed[0]) if fixed else ():
                    ten = (Slice(fixed[0], goal_pair=pair),)
                    yield Cell(self.name, task, FIXED, parse_agent("bc"), ten)
                    for agent in agents if hidden else ():
                        yield Cell(self.name, task, FIXED, agent, ten, hidden)

    def reference(self, cell):
        return "BC on these episodes"

    def is_reference(self, other, cell):
        return other.agent.name == "bc" and other.policy == cell.policy

    def group(self, task, policy_label):
        return task_folder(task), policy_label.partition(" goal ")[0]

    @property
    def claims(self):
        help_ = "Does an encoder of hidden random goals help a policy of one goal's episodes (B3)?"
        better = "Does BC train a better encoder on hidden random goals than ID (B3)?"
        return {
            "goals": (help_, lambda scores: pretrained("goals")(with_means_over_goals(scores))),
            "encoders": (better, _bc_above_id),
        }


def with_means_over_goals(scores: Scores) -> Scores:
    """Scores of single goals, and the mean over each maze's goals; its standard error takes these for independent.

    A mean that lacks goals which others have is called by its own, so that only means over the same goals are compared.
    """
    groups: dict[Place, dict[str, Pooled]] = {}
    known: dict[tuple[str, str, str], set[str]] = {}
    for place, score in scores.items():
        level, mark, rest = place.learns_from.partition(" goal ")
        if mark:
            goal, of_encoder, encoder = rest.partition(" (")
            groups.setdefault(replace(place, learns_from=f"{level}{of_encoder}{encoder}"), {})[goal] = score
            known.setdefault((place.task, place.setting, level), set()).add(goal)
    found = dict(scores)
    for place, goals in groups.items():
        level, mark, encoder = place.learns_from.partition(" (")
        every = goals.keys() == known[place.task, place.setting, level]
        named = f"{len(goals)} goals" if every else f"goals {', '.join(sorted(goals))}"
        if len(goals) > 1:
            mean = _mean(list(goals.values()))
            found[replace(place, learns_from=f"{level}, mean of {named}{mark}{encoder}")] = mean
    return found


def _mean(several: list[Pooled]) -> Pooled:
    mean, stderr = mean_of([score.mean for score in several], [score.stderr for score in several])
    return Pooled(
        mean=mean,
        stderr=stderr,
        seeds=tuple(np.mean([score.seeds for score in several], axis=0).tolist()) if _same_seeds(several) else (),
        data=float(np.mean([score.data for score in several])),
        like_data=all(score.like_data for score in several),
    )


def _same_seeds(several: list[Pooled]) -> bool:
    return len({len(score.seeds) for score in several}) == 1


def _bc_above_id(scores: Scores) -> Iterator[Answer]:
    known = with_means_over_goals(scores)
    for place, score in known.items():
        if place.agent == "bc+bc" and (other := known.get(replace(place, agent="id+bc"))):
            where = f"{place.task} {place.learns_from}, {place.setting}"
            yield above("encoders", where, ("bc+bc", "id+bc"), (score, other))
