"""Refuse options that would have no effect.

`generate.recipe` checks the options that depend on the subsets of a recipe.
"""

from __future__ import annotations

import click
from click.core import ParameterSource

from dmcvb_gen.spec import FIXED, MazeName, is_maze
from dmcvb_gen.storage.remote import is_url


def is_given(context: click.Context, name: str) -> bool:
    """Whether the command line itself has an option, not its default."""
    return context.get_parameter_source(name) == ParameterSource.COMMANDLINE


def given_options(context: click.Context) -> set[str]:
    """Names of the options that the command line itself has."""
    return {
        parameter.name for parameter in context.command.params if parameter.name and is_given(context, parameter.name)
    }


def check_exclusive_options(context: click.Context) -> None:
    """Refuse options that say where or how, and that have no effect beside the others.

    Raises:
      click.UsageError: one of them has no effect.
    """
    values, given = context.params, given_options(context)
    for name in sorted(given):
        if values[name] == "":
            raise click.UsageError(f"{_flag(context, name)} is empty: give it a value or remove it.")
    if sum(name in given for name in ("init", "part", "finishing")) > 1:
        raise click.UsageError("Give one of --init, --part and --finish.")
    if "slurm_script" in given:
        refuse(
            context, given, ("init", "part", "finishing", "dry_run", "as_json"), "--slurm-script only prints a script"
        )
    if "finishing" in given:
        refuse(context, given, ("dry_run",), "--finish plans nothing, it writes digests")
    if not is_url(values["out"] or ""):
        refuse(context, given, ("options", "scratch", "scratch_size"), "--out is no URL, so shards are made in place")
    if "no_pixels" in given:
        refuse(context, given, ("device",), "--no-pixels paints nothing; name the renderer by --renderer")


def refuse(context: click.Context, given: set[str], names: tuple[str, ...], reason: str) -> None:
    """Refuse those of `names` that the command line itself has.

    Raises:
      click.UsageError: there is one.
    """
    for name in names:
        if name in given:
            raise click.UsageError(f"{_flag(context, name)} has no effect: {reason}; remove it.")


def _flag(context: click.Context, name: str) -> str:
    return next(parameter.opts[-1] for parameter in context.command.params if parameter.name == name)


def check_maze_options(tasks: tuple[str, ...], options: dict, given: set[str]) -> None:
    """Refuse options of mazes that nothing in a command line without a recipe takes up, and those not for mazes.

    Args:
      tasks: of one family.
      options: all of the command line, `given` of them by itself.

    Raises:
      click.UsageError: one of them has no effect.
    """
    if all(is_maze(task) for task in tasks):
        if options["settings"]:
            raise click.UsageError(
                "--distractor has no effect in mazes, which vary in style: use --goal visible|hidden."
            )
        if "difficulty" in given:
            raise click.UsageError("--difficulty has no effect in mazes, which have no distractors: remove it.")
        fixed = bool(options["fixed_goals"]) or FIXED in options["goals"]
        if "episodes_per_goal" in given and not fixed:
            raise click.UsageError(
                "--episodes-per-goal has no effect without --fixed-goals: add it, or use --episodes."
            )
        if fixed and not set(options["goals"]) - {FIXED} and (options["episodes"] or options["steps"]):
            raise click.UsageError("--episodes and --steps have no effect with fixed goals: use --episodes-per-goal.")
        return
    if options["goals"] or options["fixed_goals"]:
        raise click.UsageError("--goal and --fixed-goals have no effect outside mazes: remove them.")
    for name, flag in (("episodes_per_goal", "--episodes-per-goal"), ("reward", "--reward")):
        if name in given:
            raise click.UsageError(f"{flag} has no effect outside mazes: remove it.")
    if "difficulty" in given and all("_" in name or name == "none" for name in options["settings"]):
        raise click.UsageError("--difficulty is for --distractor static or dynamic without one of their own; give one.")


def rewarded(task: str, reward: str | None) -> str:
    """A maze's task id with the reward of --reward.

    Raises:
      click.UsageError: the id names another one.
    """
    maze = MazeName.parse(task)
    if maze is None or reward is None or maze.reward == reward:
        return task
    if maze.reward:
        raise click.UsageError(f"{task} names its own reward: remove --reward, or the task's @{maze.reward}.")
    return f"{task}@{reward}" if reward == "geodesic" else task
