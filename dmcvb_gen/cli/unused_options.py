"""Refuse options that would have no effect."""

from __future__ import annotations

import click
from click.core import ParameterSource


def is_given(context: click.Context, name: str) -> bool:
    """Return True if the command line itself gives an option."""
    return context.get_parameter_source(name) == ParameterSource.COMMANDLINE


def refuse(context: click.Context, names: tuple[str, ...], reason: str) -> None:
    """Refuse those of `names` that the command line itself has.

    Raises:
      click.UsageError: there is one.
    """
    flags = {parameter.name: parameter.opts[-1] for parameter in context.command.params}
    for name in names:
        if is_given(context, name):
            raise click.UsageError(f"{flags[name]} has no effect: {reason}; remove it.")
