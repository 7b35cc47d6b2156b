"""Progress bars, on a terminal, in a notebook and in a log."""

from __future__ import annotations

import sys
import time
from typing import Any

from tqdm.auto import tqdm

LOG_SECONDS = 60.0  # between two lines of progress in a log, which has no bar


class ProgressBar(tqdm):
    """tqdm's bar on a terminal or in a notebook; in a log (a batch job's file, a pipe) a line a minute.

    A log keeps every state of a bar, so there it has to be rare, and ends in a newline instead of a carriage return.

    Args:
      shown: False draws nothing.
      options: options of tqdm.
    """

    def __init__(self, shown: bool = True, **options: Any) -> None:
        self._logged = not sys.stderr.isatty() and "ipykernel" not in sys.modules
        self._told = time.monotonic()
        if self._logged:
            line = "{l_bar} {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
            options |= dict(file=_Lines(), delay=LOG_SECONDS, mininterval=LOG_SECONDS, miniters=1, bar_format=line)
        super().__init__(disable=not shown, **options)

    def __call__(self, done: int | str = 1, steps: int = 1) -> None:
        """Progress callback: how much was done since the last call; or the name of the item in progress, and how much.

        With nothing done, the name alone is shown.
        """
        if isinstance(done, str):
            self.set_description(done, refresh=not steps)
            done = steps
        self.update(done)

    def expect(self, count: float) -> None:
        """Set the expected total, which may change later."""
        self.total = count

    def refresh(self, *args: Any, **options: Any) -> bool | None:
        if self._logged:
            if time.monotonic() < self._told + LOG_SECONDS:
                return None
            self._told = time.monotonic()
        return super().refresh(*args, **options)


class _Lines:
    """A stream that turns each state of a bar into a line of standard error."""

    def write(self, text: str) -> None:
        if text.strip():
            print(text.strip(), file=sys.stderr, flush=True)

    def flush(self) -> None:
        sys.stderr.flush()
