"""Returns of behaviour policies over fresh episodes, beside the paper's."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.options import Location, Names, Seed, checked, refuse
from dmcvb_gen.own_code import is_own
from dmcvb_gen.spec import Level
from dmcvb_gen.text import as_names


@checked
def evaluate_behaviour(
    tasks: Names = (),
    *,
    levels: Names = (),
    behaviour: Location | None = None,
    episodes: Annotated[int, Ge(2)] = 100,
    seed: Seed = 1,
    sample: bool = False,
) -> list[dict[str, Any]]:
    """Measure the returns of behaviour policies over fresh episodes, beside the paper's.

    Args:
      tasks (TASK): Tasks, or text files of mazes; by default those of the policies.
      levels: expert, medium, mixed, random. [default: all bundled]
      behaviour (BEHAVIOUR): What to evaluate instead of the bundled policies, as in rollout.
      episodes: Fresh episodes of each level; mixed rounds up to a multiple of its policies.
      seed: Random seed of the episodes.
      sample: Sample actions instead of using the policy mean.

    Returns:
      A row for each task and level: task, level, episodes, seed, mode ("mean", "sampled", or "own" if a function of
      your own acts), behaviour (that function's name or None), returns (statistics), paper (the same or None); of mazes
      success and speed (m/s) too.

    Raises:
      DmcvbError: an unknown name, or a policy that does not fit.
    """
    from dmcvb_gen.generate.info import return_statistics  # here, so that --help is quick
    from dmcvb_gen.generate.request import behaviour_source
    from dmcvb_gen.policies.archives import bundled_digests
    from dmcvb_gen.policies.bundled import bundled_levels
    from dmcvb_gen.policies.evaluation import goal_scores
    from dmcvb_gen.policies.paper import paper_returns
    from dmcvb_gen.policies.simulate import simulate
    from dmcvb_gen.tasks import get_task, typed_task

    behaviour, typed = behaviour_source(behaviour), tuple(map(typed_task, as_names(tasks)))
    named = tuple(dict.fromkeys(as_names(levels)))
    for level in named:
        Level.parse(level)
    if set(named) == {Level.RANDOM}:
        refuse("level random has no policy", behaviour=behaviour)
        refuse("level random is always drawn", sample=sample)
    refuse("a function of your own draws by itself", sample=sample and is_own(behaviour or ""))
    chosen, asked = _of_behaviour(behaviour, typed, named) if behaviour else (typed, named)
    if not chosen:
        known = dict.fromkeys(name.split("/")[0] for name in bundled_digests())
        chosen = [task for task in known if {*asked, "random"} <= {*bundled_levels(task), "random"}]
    rows = []
    for task_id in chosen:
        task = get_task(task_id)
        for level in asked or (*bundled_levels(task_id), "random"):
            policies = _policies(task, level, behaviour, sample)
            count = -(-episodes // len(policies)) * len(policies)
            out = simulate(task, policies, range(count), seed, (task_id, "evaluation"), deterministic=not sample)
            row = dict(task=task_id, level=level, episodes=count, seed=seed)
            own = is_own(behaviour or "") and level != "random"
            mode = "own" if own else "sampled" if sample or level == "random" else "mean"  # random actions are drawn
            row |= dict(mode=mode, behaviour=behaviour if own else None, returns=return_statistics(out.returns))
            success, speed = goal_scores(task, out.state[:, 0], out.length, out.terminated)
            if success is not None:
                row |= dict(success=success, speed=speed)
            rows.append(row | dict(paper=paper_returns(task_id, level)))
    return rows


def _of_behaviour(behaviour: str, tasks: Sequence[str], levels: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """The tasks and levels to evaluate; those that are not asked for are what the policy says."""
    from dmcvb_gen.policies.bundled import is_foreign, levels_of, resolve_policies
    from dmcvb_gen.policies.policy_file import read_header

    if is_own(behaviour) or is_foreign(Path(behaviour)):
        if len(tasks) != 1:
            raise DmcvbError(f"give the one TASK that {behaviour} is for")
        return tasks, levels or ["expert"]
    levels = levels or levels_of(behaviour)
    named = [level for level in levels if level != "random"]
    files = [path for level in named for path in resolve_policies(next(iter(tasks), ""), level, behaviour)]
    return tasks or sorted({read_header(path).task for path in files}), levels


def _policies(task: Any, level: str, behaviour: str | None, sample: bool) -> list[Any]:
    from dmcvb_gen.policies.actor import RandomPolicy
    from dmcvb_gen.policies.bundled import check_level, resolve_policies
    from dmcvb_gen.policies.policy_file import load_policy

    if level == "random":
        return [RandomPolicy(task)]
    paths = resolve_policies(task.id, level, behaviour)
    policies = [load_policy(path, task, sample) for path in paths]
    for path, policy in zip(paths, policies, strict=True):
        check_level(path, policy.header, level)
    return policies
