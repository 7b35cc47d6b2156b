"""B2: encoders from mixed data, policies from few expert episodes (paper, section 5.2)."""

from __future__ import annotations

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.benchmarks.claims import pretrained
from dmcvb_gen.benchmarks.suites import Benchmark, Cell, register_benchmark
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.spec import is_maze

FEW_EPISODES = 20
"""1 % of the paper's expert subset of 2,000 episodes."""


@register_benchmark("b2")
class FewEpisodes(Benchmark):
    """Encoders from all mixed episodes beside BC on 20 experts, alone and with the mixed; beside BC on all experts."""

    title = "B2: encoders from mixed data, policies from few expert episodes"
    agents = ("id+bc", "bc+bc", "lfd+bc", "ae+bc")
    compares_encoders = True

    def cells(self, data, agents):
        bc = parse_agent("bc")
        for task in [task for task in data.tasks if not is_maze(task)]:
            full = data.parts(task, ["expert"], "none")
            if full:
                yield Cell(self.name, task, "none", bc, full)  # scores are shares of this one
            for setting in data.settings(task):
                few = data.first(task, "expert", setting, FEW_EPISODES)
                mixed = data.parts(task, ["mixed"], setting)
                if not few:
                    continue
                yield Cell(self.name, task, setting, bc, few)
                if mixed:
                    yield Cell(self.name, task, setting, bc, few + mixed)
                    for agent in agents:
                        yield Cell(self.name, task, setting, agent, few, mixed)

    def warnings(self, release, cells):
        for name in dict.fromkeys(p.subset for cell in cells for p in cell.policy if p.episodes is not None):
            there = len(release[name].episodes)
            if there <= FEW_EPISODES:
                text = f"b2 learns from {FEW_EPISODES} expert episodes, and {there} are all there are; roll out more"
                yield Issue("learning", name, text)

    @property
    def claims(self):
        return {"mixed": ("Does an encoder of mixed data help a policy of few episodes (B2)?", pretrained("mixed"))}
