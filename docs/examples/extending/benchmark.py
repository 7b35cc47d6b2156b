"""A benchmark: `--benchmark growth` asks how scores grow with the data, of every subset of a release."""

from dmcvb_gen.benchmarks.plan import Benchmark, Cell, Slice, register_benchmark


@register_benchmark("growth")
class Growth(Benchmark):
    """Agents on a tenth, half and all of the episodes."""

    title = "Growth: scores over shares of the data"
    agents = ("state-bc",)  # unless `--agents` names others

    def cells(self, data, agents):
        for name, subset in data.release.subsets.items():
            for share in (0.1, 0.5, 1.0):
                for agent in agents:
                    yield Cell(self.name, subset.task, subset.setting, agent, (Slice(name, share=share),))

    def reference(self, cell):  # what the report sets a score beside
        return "the same agent on all episodes"

    def is_reference(self, other, cell):
        return other.agent == cell.agent and other.policy == (Slice(cell.policy[0].subset),)
