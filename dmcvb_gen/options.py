"""Types of the arguments that people give: to a Python function, and by the same names to its command.

`Annotated` adds what a type alone does not say: bounds, choices, or a place that cannot be a URL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from dmcvb_gen.spec import DIFFICULTIES, GOAL_PICTURES, REWARDS, SPLITS


@dataclass(frozen=True)
class Between:
    """Mark of a number's type: its bounds; with `open`, the lowest one is left out."""

    lowest: float
    highest: float | None = None
    open: bool = False


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
Span = tuple[int, int]
"""(first, last + 1), or (part, parts)."""
Difficulty = Annotated[str, DIFFICULTIES]
GoalPictures = Annotated[str, GOAL_PICTURES]
Precision = Annotated[str, ("auto", "float32", "bfloat16")]
Reward = Annotated[str, REWARDS]
Split = Annotated[str, SPLITS]
