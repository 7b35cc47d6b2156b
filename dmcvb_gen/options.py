"""Types of the arguments that people give: to a Python function, and by the same names to its command.

pydantic checks them. `Annotated` adds what a type alone does not say: bounds, or a place that cannot be a URL.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, ParamSpec, TypeVar

from annotated_types import Ge, Lt

from dmcvb_gen.errors import DmcvbError

if TYPE_CHECKING:
    from dmcvb_gen.progress import ProgressBar

SEVERAL = "several"
"""Mark of names: one may be given alone, or an iterator."""
RANGE = "range"
"""Mark of (A, B) with 0 <= A < B."""

PLACE = "place"
"""Mark of text that may not be empty, as that of an unset variable of a shell is."""

Location = Annotated[str | Path, PLACE]
"""A folder, a file or a URL."""
Local = Location
"""A folder or file to write to, which functions refuse if it is a URL (`storage.places.local_path`)."""
Names = Annotated[tuple[Location, ...], SEVERAL]
"""One name or several."""
Count = Annotated[int, Ge(1)]
Seed = Annotated[int, Ge(0), Lt(2**32)]
Samples = Literal[1, 2, 4, 8]
Span = Annotated[tuple[int, int], RANGE]
"""(first, last + 1)."""
Precision = Literal["auto", "float32", "bfloat16"]
Split = Literal["train", "val"]

at_terminal = contextvars.ContextVar("at_terminal", default=False)
"""Whether a command runs, whose messages name flags; messages of functions name their parameters."""
_FLAG = re.compile(r"`[^`]*`|dmcvb-gen [^;,(]*|--(?P<name>[a-z][a-z-]*)")
FLAGS = {"settings": "set", "storage_options": "option", "everything": "all", "episode_range": "range"}
"""Parameter -> flag, if it has another name."""
_PARAMETERS = {flag: parameter for parameter, flag in FLAGS.items()} | {
    "benchmark": "benchmarks",
    "distractor": "distractors",
    "goal": "goals",
    "label": "labels",
    "level": "levels",
    "no-pixels": "pixels=False",
}
"""Flags whose parameters have other names."""

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: a function takes what pydantic makes of its arguments by their types.

    Raises:
      DmcvbError: at a call, in one line, a value that its type does not allow. Messages of what it calls name the
        function's parameters in place of its command's flags, unless the command runs.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        given = signature.bind(*args, **kwargs)
        for name, value in given.arguments.items():
            given.arguments[name] = _checked(name, value, signature.parameters[name].annotation)
        return naming_parameters()(function)(*given.args, **given.kwargs)

    return call


@contextlib.contextmanager
def naming_parameters() -> Iterator[None]:
    """Messages name parameters in place of flags, unless a command runs."""
    try:
        yield
    except DmcvbError as error:
        if not at_terminal.get():
            error.args = (with_parameters(str(error)), *error.args[1:])
        raise


def with_parameters(message: str) -> str:
    """Replace the flags of a message by the names of parameters, but not within commands."""

    def renamed(found: re.Match[str]) -> str:
        name = found["name"]
        return found[0] if name is None else _PARAMETERS.get(name, name.replace("-", "_"))

    return _FLAG.sub(renamed, message)


def _checked(name: str, value: Any, annotation: Any) -> Any:
    import pydantic  # here, so that --help is quick

    _, marks = parts_of(annotation)
    taken = value
    if SEVERAL in marks and isinstance(value, Path | Iterable):
        taken = (value,) if isinstance(value, str | Path) else tuple(value)
    try:
        taken = pydantic.TypeAdapter(annotation).validate_python(taken)
    except pydantic.ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise DmcvbError(f"{name} is {value!r}: {reason[0].lower()}{reason[1:]}") from None
    if PLACE in marks and (taken == "" or (SEVERAL in marks and taken and "" in taken)):
        raise DmcvbError(f"{name} is empty; give a value, or leave it out")
    if RANGE in marks and taken is not None and not 0 <= taken[0] < taken[1]:
        raise DmcvbError(f"{name} is {value!r}: give (A, B) with 0 <= A < B")
    return taken


def parts_of(annotation: Any) -> tuple[list[Any], list[Any]]:
    """The types of a union but None, and the marks that `Annotated` sets on them or on each of several."""
    if typing.get_origin(annotation) is Annotated:
        inner, *marks = typing.get_args(annotation)
        kinds, more = parts_of(inner)
        return kinds, [*marks, *more]
    if Ellipsis in typing.get_args(annotation):
        return [annotation], parts_of(typing.get_args(annotation)[0])[1]
    if typing.get_origin(annotation) not in (typing.Union, types.UnionType):
        return ([] if annotation is type(None) else [annotation]), []
    parts = [parts_of(part) for part in typing.get_args(annotation)]
    return [kind for kinds, _ in parts for kind in kinds], [mark for _, marks in parts for mark in marks]


def progress_bar(shown: bool, unit: str, name: str | None = None, scaled: bool = True) -> ProgressBar:
    """A bar on standard error; drawn if `shown`."""
    from dmcvb_gen.progress import ProgressBar

    return ProgressBar(shown, unit=unit, unit_scale=scaled, desc=name)


def refuse(reason: str, **given: Any) -> None:
    """Refuse options that have no effect.

    Args:
      given: flag -> value, which refuses nothing if it is false.

    Raises:
      DmcvbError: one of them is given.
    """
    for name, value in given.items():
        if value:
            raise DmcvbError(f"--{name.replace('_', '-')} has no effect: {reason}; remove it")
