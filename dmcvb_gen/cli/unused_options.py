"""Refuse options that would have no effect.

`generate.request` checks the options that depend on what is made.
"""

from __future__ import annotations

import click
from click.core import ParameterSource

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
