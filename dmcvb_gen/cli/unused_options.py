"""Refuse options that would have no effect.

`generate.request` checks the options that depend on what is made.
"""

from __future__ import annotations

import click
from click.core import ParameterSource

from dmcvb_gen.storage.remote import is_url


def is_given(context: click.Context, name: str) -> bool:
    """Return True if the command line itself gives an option."""
    return context.get_parameter_source(name) == ParameterSource.COMMANDLINE


def check_exclusive_options(context: click.Context) -> None:
    """Refuse options of `rollout` that say where or how, and that have no effect beside the others.

    Raises:
      click.UsageError: one of them has no effect.
    """
    for parameter in context.command.params:
        if is_given(context, parameter.name or "") and context.params[parameter.name] == "":
            raise click.UsageError(f"{parameter.opts[-1]} is empty: give it a value or remove it.")
    if sum(is_given(context, name) for name in ("init", "part", "finishing")) > 1:
        raise click.UsageError("Give one of --init, --part and --finish.")
    if is_given(context, "slurm_script"):
        only_prints = ("init", "part", "finishing", "dry_run", "as_json")
        refuse(context, only_prints, "--slurm-script only prints a script")
    if is_given(context, "finishing"):
        refuse(context, ("dry_run",), "--finish plans nothing, it writes digests")
    if not is_url(context.params["out"] or ""):
        in_place = ("storage_options", "scratch", "scratch_size")
        refuse(context, in_place, "--out is no URL, so shards are made in place")


def refuse(context: click.Context, names: tuple[str, ...], reason: str) -> None:
    """Refuse those of `names` that the command line itself has.

    Raises:
      click.UsageError: there is one.
    """
    flags = {parameter.name: parameter.opts[-1] for parameter in context.command.params}
    for name in names:
        if is_given(context, name):
            raise click.UsageError(f"{flags[name]} has no effect: {reason}; remove it.")
