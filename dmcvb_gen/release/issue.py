"""One issue that a check found: the check, the place, and what is wrong."""

from __future__ import annotations

from dataclasses import dataclass

NOT_PART = "is not part of the release"
"""Message about a file that the index does not list."""
UNCHECKED = "unchecked"
"""Check of issues that this machine lacks something to look for; nothing is known to be damaged."""


@dataclass(frozen=True)
class Issue:
    """Something wrong: which check, where, and what."""

    check: str
    subset: str
    message: str
    episode: int | None = None
    step: int | None = None

    def __str__(self) -> str:
        place = self.subset
        if self.episode is not None:
            place += f", episode {self.episode}"
        if self.step is not None:
            place += f", step {self.step}"
        return f"{self.check}: {place}: {self.message}"
