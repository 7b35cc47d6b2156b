"""The errors that a person at a terminal is meant to read: what was given, what was expected, what to do."""

from __future__ import annotations

import copyreg
import difflib
from collections.abc import Iterable

MOST_LISTED = 24
"""Names that a message lists at most; of more, it lists the nearest."""


class DmcvbError(Exception):
    """A mistake in the request or its surroundings; the CLI prints it in one line and exits with 2."""


class UnknownNameError(DmcvbError, KeyError):
    """A name that is not among the known ones; the message lists those and the nearest match.

    Args:
      kind: what is named.
      known: all names; of those that begin with `name`, the first one is the nearest.
      cure: what lists all of them, or adds one, if there is such a thing.
    """

    def __init__(self, kind: str, name: object, known: Iterable[str], cure: str = ""):
        known = list(dict.fromkeys(map(str, known)))
        longer = [other for other in known if name and other.startswith(str(name))]
        known = sorted(known)
        near = longer or difflib.get_close_matches(str(name), known, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        listed, rest = known, ""
        if len(known) > MOST_LISTED:
            listed = difflib.get_close_matches(str(name), known, n=MOST_LISTED // 3, cutoff=0)
            rest = f" and {len(known) - len(listed)} more"
        super().__init__(f"unknown {kind} {str(name)!r}.{hint} Known: {', '.join(listed)}{rest}{cure and f'; {cure}'}.")

    def __str__(self) -> str:  # KeyError would print the repr
        return str(self.args[0])

    def __reduce__(self) -> tuple:  # to come back from a worker process, made anew from its message
        return copyreg.__newobj__, (type(self), *self.args)  # type: ignore[attr-defined]  # typeshed lacks it


def first_line(error: BaseException) -> str:
    """The first line of what an error says; the name of its kind if it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]


class PolicyFileError(DmcvbError):
    """A policy file that cannot be trusted or does not fit the task."""


class StoreError(DmcvbError):
    """A release or store that is damaged, foreign or cannot be written."""


class RenderingError(DmcvbError):
    """A renderer that cannot start here."""


class BackgroundError(DmcvbError):
    """A background folder or video that cannot be used."""


class RecipeError(DmcvbError):
    """A recipe that does not make sense."""


class LayoutError(DmcvbError):
    """A maze layout, or a place in one, that cannot be used."""
