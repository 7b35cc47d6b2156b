"""Types of the arguments that people give: to a Python function, and by the same names to its command.

`Annotated` adds what a type alone does not say: bounds, choices, or a place that cannot be a URL.
"""

from __future__ import annotations

import functools
import inspect
import numbers
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, TypeVar

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.spec import DIFFICULTIES, GOAL_PICTURES, REWARDS, SPLITS

if TYPE_CHECKING:
    from dmcvb_gen.progress import ProgressBar


@dataclass(frozen=True)
class Between:
    """Mark of a number's type: its bounds; with `open`, the lowest one is left out."""

    lowest: float
    highest: float | None = None
    open: bool = False

    def allow(self, value: float) -> bool:
        """Whether a number is within the bounds."""
        above = value > self.lowest if self.open else value >= self.lowest
        return above and (self.highest is None or value <= self.highest)

    def __str__(self) -> str:
        """The bounds in words."""
        lowest = f"above {self.lowest:g}" if self.open else f"of at least {self.lowest:g}"
        return lowest + (f" and at most {self.highest:g}" if self.highest is not None else "")


LOCAL = "local"
"""Mark of a folder or file to write to, which cannot be a URL."""

Names = str | Sequence[str]
"""One name or several."""
Location = str | Path
"""A folder, a file or a URL."""
Local = Annotated[Location, LOCAL]
Count = Annotated[int, Between(1)]
Seed = Annotated[int, Between(0)]
Share = Annotated[float, Between(0, 1, open=True)]
Samples = Annotated[int, Between(1, 8)]
RANGE, PART = "range", "part"
"""Marks of two whole numbers: (A, B) with 0 <= A < B, and (K, N) with 1 <= K <= N."""
Span = Annotated[tuple[int, int], RANGE]
"""(first, last + 1)."""
Part = Annotated[tuple[int, int], PART]
"""(part, parts)."""
Difficulty = Annotated[str, DIFFICULTIES]
GoalPictures = Annotated[str, GOAL_PICTURES]
Precision = Annotated[str, ("auto", "float32", "bfloat16")]
Reward = Annotated[str, REWARDS]
Split = Annotated[str, SPLITS]

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: a function refuses arguments that its types do not allow, as its command does.

    Numbers become Python's own, and iterators tuples, so that they can be read more than once.

    Raises:
      DmcvbError: at a call, a number or range that is none or out of bounds, or None for what has to be given.
      UnknownNameError: a word that is no choice.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        given = signature.bind(*args, **kwargs)
        for name, value in given.arguments.items():
            parameter = signature.parameters[name]
            if value is None and parameter.default is parameter.empty:
                raise DmcvbError(f"{name} is None; give {_wanted(parameter.annotation)}")
            given.arguments[name] = _checked(name, value, parameter.annotation)
        return function(*given.args, **given.kwargs)

    return call


def _checked(name: str, value: Any, annotation: Any) -> Any:
    kinds, marks = parts_of(annotation)
    if value is None:
        return value
    if any(typing.get_origin(kind) is Sequence for kind in kinds):
        return value if isinstance(value, str | Path) or not hasattr(value, "__iter__") else tuple(value)
    if RANGE in marks or PART in marks:
        return _pair(name, value, is_range=RANGE in marks)
    choices = next((mark for mark in marks if isinstance(mark, tuple)), None)
    if choices and value not in choices:
        raise UnknownNameError(name, value, choices)
    numeric = {int, float} & set(kinds)
    if not numeric or any(isinstance(kind, type) and isinstance(value, kind) for kind in set(kinds) - numeric):
        return value
    bounds = next((mark for mark in marks if isinstance(mark, Between)), None)
    return _number(name, value, float not in numeric, bounds)


def _wanted(annotation: Any) -> str:
    """What a parameter takes, for people."""
    kinds, marks = parts_of(annotation)
    if Path in kinds:
        return "a folder" if LOCAL in marks else "a folder or a URL"
    return "text"


def _pair(name: str, value: Any, is_range: bool) -> tuple[int, int]:
    given = value if isinstance(value, tuple | list) else ()
    if len(given) == 2 and all(isinstance(n, numbers.Integral) and not isinstance(n, bool) for n in given):
        first, last = map(int, given)
        if 0 <= first < last if is_range else 1 <= first <= last:
            return first, last
    form = "(A, B), whole numbers with 0 <= A < B" if is_range else "(K, N), whole numbers with 1 <= K <= N"
    raise DmcvbError(f"{name} is {value!r}; give {form}")


def _number(name: str, value: Any, whole: bool, bounds: Between | None) -> int | float:
    wanted = "a whole number" if whole else "a number"
    fits = isinstance(value, numbers.Integral if whole else numbers.Real) and not isinstance(value, bool)
    if not fits:
        raise DmcvbError(f"{name} is {value!r}; give {wanted}")
    number = int(value) if whole else float(value)
    if bounds and not bounds.allow(number):
        raise DmcvbError(f"{name} is {number}; give {wanted} {bounds}")
    return number


def parts_of(annotation: Any) -> tuple[list[Any], list[Any]]:
    """The types of a union but None, and the marks that `Annotated` sets on them."""
    if typing.get_origin(annotation) is Annotated:
        inner, *marks = typing.get_args(annotation)
        kinds, more = parts_of(inner)
        return kinds, [*marks, *more]
    if typing.get_origin(annotation) not in (typing.Union, types.UnionType):
        return ([] if annotation is type(None) else [annotation]), []
    parts = [parts_of(part) for part in typing.get_args(annotation)]
    return [kind for kinds, _ in parts for kind in kinds], [mark for _, marks in parts for mark in marks]


@contextmanager
def progress_bar(shown: bool, unit: str, name: str | None = None, scaled: bool = True) -> Iterator[ProgressBar]:
    """A bar on standard error; drawn if `shown`."""
    from dmcvb_gen.progress import ProgressBar

    with ProgressBar(shown, unit=unit, unit_scale=scaled, desc=name) as bar:
        yield bar
