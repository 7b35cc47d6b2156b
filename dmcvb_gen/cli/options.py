"""The options of a command, from the function that it calls.

A function's signature has the types and the defaults, its docstring the help; nothing is written twice::

    def paint(release: Local, *, episodes: Span | None = None, ...):
        \"\"\"...
        Args:
          episodes (RANGE): Use only the shards with episodes A to B - 1.

gives `paint RELEASE --episodes A:B`. What stands in parentheses, or
`METAVARS` has for it, shows how a value is written, and `FORMATS` reads it. A
parameter that takes several names can be repeated and loses its "s" (levels: --level). One that is true by default is
switched off (pixels: --no-pixels).
"""

import functools
import inspect
import re
import typing
from collections.abc import Callable, Sequence
from typing import Any, Literal

import click

from dmcvb_gen.cli.common import GroupedCommand, json_option, parse_options
from dmcvb_gen.options import FLAGS, PLACE, parts_of
from dmcvb_gen.parallel import Ray, Workers

METAVARS = {"RANGE": "A:B", "BEHAVIOUR": "FILE|RUN|MODULE:FUNCTION"}
"""What stands for a metavar with a colon, which would end the name in a docstring."""


def command_of(
    function: Callable,
    *arguments: str,
    groups: dict[str, tuple[str, ...]] | None = None,
    only: Sequence[str] = (),
    epilog: str | None = None,
) -> Callable:
    """Decorator: a click command with the parameters of a function.

    The decorated function gets their values by name, with `as_json` and `progress`. Its docstring is the command's
    help. Options above it are the command's alone.

    Args:
      arguments: parameters that have no flag, by default the first one.
      groups: see `GroupedCommand`.
      only: names of the parameters that the command has, all by default.
      epilog: text below the options.
    """

    def decorate(show: Callable) -> click.Command:
        @functools.wraps(show)
        def callback(as_json: bool, **given: Any) -> Any:
            return show(as_json=as_json, progress=not as_json, **given)

        own = getattr(show, "__click_params__", [])
        callback.__click_params__ = []
        json_option(callback)
        parameters = [each for each in parameters_of(function, arguments) if not only or each.name in only]
        callback.__click_params__ += [*own, *reversed(parameters)]
        name, options = show.__name__.replace("_", "-"), dict(option_groups=groups, epilog=epilog)
        return click.command(name, cls=GroupedCommand, **options)(callback)

    return decorate


def parameters_of(function: Callable, arguments: Sequence[str] = ()) -> list[click.Parameter]:
    """The click parameters of a function, in the order of its signature."""
    helps, signature = help_of(function), inspect.signature(function).parameters
    found: list[click.Parameter] = []
    for name, parameter in signature.items():
        if name not in helps:  # progress and callbacks are no options
            continue
        (metavar, text), (kinds, marks) = helps[name], parts_of(parameter.annotation)
        required = parameter.default is parameter.empty
        several = any(Ellipsis in typing.get_args(kind) for kind in kinds)
        kind = _click_type(kinds, marks)
        if name in (arguments or [next(iter(signature))]):
            form = metavar if required else f"[{metavar}]" + "..." * several
            found.append(click.Argument([name], type=kind, required=required, nargs=-1 if several else 1, metavar=form))
            continue
        flag, default = FLAGS.get(name, name).replace("_", "-"), parameter.default
        metavar = "N|ray" if Ray in kinds else metavar
        given: dict[str, Any] = dict(metavar=metavar, required=required, type=kind)
        if default is True:
            flag, text = f"no-{flag}", text.removeprefix("False: ")
            given = dict(is_flag=True, callback=lambda context, parameter, value: not value)
        elif default is False:
            given = dict(is_flag=True)
        elif metavar in FORMATS:
            given |= dict(callback=_read, type=str)
        elif dict in map(typing.get_origin, kinds):
            given, text = dict(metavar=metavar, multiple=True, callback=parse_options), _repeatable(text)
        elif several:
            flag, text = flag.removesuffix("s"), _repeatable(text)
            given |= dict(multiple=True, default=default or None, show_default=bool(default))
        elif not required and default is not None:
            given |= dict(default=default, show_default=True)
        found.append(click.Option([f"--{flag}", name], help=text, **given))
    return found


def help_of(function: Callable) -> dict[str, tuple[str | None, str]]:
    """Parameter -> (metavar, help), from the "Args:" of its docstring."""
    documented = inspect.getdoc(function)
    if documented is None:
        raise click.UsageError("options are read from docstrings, which python -OO leaves out; unset PYTHONOPTIMIZE=2")
    block = documented.partition("\nArgs:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^  (\w+)(?: \((.+?)\))?: (.+(?:\n   .+)*)", block, re.MULTILINE)
    found = [(name, METAVARS.get(metavar, metavar), text) for name, metavar, text in found]
    return {name: (metavar or None, re.sub(r"\s+", " ", text).replace(" [d", "  [d")) for name, metavar, text in found}


def _click_type(kinds: Sequence[Any], marks: Sequence[Any]) -> Any:
    """The click type of an argument: choices, a number with its bounds, or text."""
    if Literal in map(typing.get_origin, kinds):
        return click.Choice(typing.get_args(kinds[0]))
    if Ray in kinds:
        return WorkersType(min=1)
    if PLACE in marks:
        return PlaceType()
    if not {int, float} & {*kinds}:
        return str
    sides = {"ge": ("min", False), "gt": ("min", True), "le": ("max", False), "lt": ("max", True)}
    bounds: dict[str, Any] = {}
    for limit in marks:
        for name, (side, is_open) in sides.items():
            if hasattr(limit, name):
                bounds |= {side: getattr(limit, name), f"{side}_open": is_open}
    if float in kinds:
        return click.FloatRange(**bounds)
    return click.IntRange(**bounds) if bounds else int


class WorkersType(click.IntRange):
    """A number of processes, or "ray": the cluster that RAY_ADDRESS names, else one on this machine."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Workers:
        try:
            return Ray() if value == "ray" else super().convert(value, param, ctx)
        except click.BadParameter:
            raise click.UsageError(f"--workers is {value!r}; give a number of processes, 1 or more, or ray") from None


class PlaceType(click.ParamType):
    """A folder, file, URL or name; not the empty text of an unset variable."""

    name = "text"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if value == "":
            raise click.UsageError(f"{param.get_error_hint(ctx)} is empty; give a value, or leave it out")
        return value


def _repeatable(text: str) -> str:
    """ "What.  [default: x]" -> "What. Repeatable.  [default: x]"."""
    words, mark, default = text.partition("  [")
    return f"{words} Repeatable.{mark}{default}"


# -- how values are written -----------------------------------------------------------------------


def parse_range(flag: str, text: str) -> tuple[int, int]:
    """ "100:150" -> (100, 150)."""
    first, colon, last = text.partition(":")
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise click.UsageError(f"{flag} {text!r} is not A:B with A < B, e.g. 100:150")
    return int(first), int(last)


def parse_part(flag: str, text: str) -> tuple[int, int]:
    """ "2/8" -> (2, 8)."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise click.UsageError(f"{flag} {text!r} is not K/N with K from 1 to N, e.g. 2/8.")
    return int(number), int(count)


def split_names(flag: str, text: str) -> tuple[str, ...]:
    """ "bc,id+bc" -> ("bc", "id+bc")."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


FORMATS: dict[str | None, Callable[[str, str], Any]] = {"A:B": parse_range, "A,B": split_names}
"""Metavar -> function that reads the value of a flag."""


def _read(context: click.Context, parameter: click.Parameter, text: str | None) -> Any:
    return None if text is None else FORMATS[parameter.metavar](parameter.opts[0], text)
