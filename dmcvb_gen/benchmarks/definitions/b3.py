"""B3: encoders from hidden random goals, policies from ten episodes of one fixed goal (paper, section 5.3)."""

from __future__ import annotations

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.benchmarks.claims import pretrained
from dmcvb_gen.benchmarks.suites import Benchmark, Cell, Part, register_benchmark
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
                    ten = (Part(fixed[0], goal_pair=pair),)
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
        words = "Does an encoder of hidden random goals help a policy of one goal's episodes (B3)?"
        return {"goals": (words, pretrained("goals"))}
