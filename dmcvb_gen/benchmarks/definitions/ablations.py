"""Ablations: frames of a stack, k of inverse dynamics, share of the data (paper, appendix)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

from dmcvb_gen.agents.data import part_count
from dmcvb_gen.benchmarks.claims import Answer, Place, Pooled, Scores, above
from dmcvb_gen.benchmarks.suites import Benchmark, Cell, Slice, register_benchmark
from dmcvb_gen.spec import VISIBLE, is_maze

SHARES = (0.01, 0.05, 0.1, 0.25, 0.5)


@register_benchmark("ablations")
class Ablations(Benchmark):
    """Agents on expert data, and BC on shares of it; beside BC on all of expert/none."""

    title = "Ablations"
    # Inverse dynamics over more steps stand beside pre-training by BC, which the paper sees them tend to.
    agents = ("bc:frames=1", "bc", "bc+bc", "id+bc", "id+bc:k=5", "id+bc:k=10", "id+bc:k=10,sample")

    def cells(self, data, agents):
        for task in data.tasks:
            for setting in [VISIBLE] if is_maze(task) else data.settings(task):
                parts = data.parts(task, ["expert"], setting)
                if not parts:
                    continue
                for agent in agents:
                    yield Cell(self.name, task, setting, agent, parts)
                by_pictures = [agent for agent in agents if agent.name == "bc"]
                shares = _distinct_shares(len(data.release[parts[0].subset].episodes))
                for share, agent in itertools.product(shares, by_pictures):
                    yield Cell(self.name, task, setting, agent, (Slice(parts[0].subset, share=share),))

    @property
    def claims(self):
        return {"share": ("Does more data give more return?", _share)}


def _distinct_shares(episodes: int) -> list[float]:
    """Shares of a number of episodes, the largest of those that come to the same count."""
    counts = {part_count(share, episodes): share for share in SHARES}
    return [share for count, share in counts.items() if count < episodes]


def _share(scores: Scores) -> Iterator[Answer]:
    groups: dict[Place, list[tuple[float, Pooled]]] = {}
    for place, score in scores.items():
        share, percent, level = place.learns_from.rpartition("% ")
        key = replace(place, learns_from=level)
        groups.setdefault(key, []).append((float(share) if percent else 100.0, score))
    for place, shares in groups.items():
        for (few, less), (many, more) in itertools.pairwise(sorted(shares, key=lambda entry: entry[0])):
            where = f"{place.task} {place.learns_from}, {place.setting}, {place.agent}"
            yield above("share", where, (f"{many:g} %", f"{few:g} %"), (more, less))
