"""Behaviours of your own: "<module>:<function>" names a function of observations and a generator that gives actions.

::

    def behaviour(observations, generator):  # (n, observation) float32 in; (n, action) out, in the task's bounds
        return generator.uniform(-1, 1, size=(len(observations), 6))

Data from such code are marked: they are not regenerable without it. Its source file's digest stands in the manifest.
The code runs only if a person named it, see `own_code`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dmcvb_gen.errors import PolicyFileError, first_line
from dmcvb_gen.own_code import BEHAVIOURS, find_function, source_digest
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.header import OWN_CODE, PolicyHeader
from dmcvb_gen.tasks.base import Task

MARK = "not regenerable without that code"
ROUNDING = 1e-4
"""Actions of a row may differ by so much with the rows beside it: products of matrices round by their sizes."""
PROBES = [0, 1], [1, 0], [1]
"""Rows of the two observations that a function is asked for, again and again."""


class RowGenerator:
    """A numpy `Generator` for a batch: row i of what it draws comes from the stream of episode i alone.

    Every method of `numpy.random.Generator` that takes `size` is there; `size` is named, and begins with the number of
    rows: `generator.normal(size=(n, 6))`.
    """

    def __init__(self, streams: Sequence[np.random.Generator]):
        self._streams = streams

    def __getattr__(self, name: str) -> Callable[..., np.ndarray]:
        def draw(*args: Any, size: tuple[int, ...] = (), **kwargs: Any) -> np.ndarray:
            if not isinstance(size, tuple) or not size or size[0] != len(self._streams):
                raise ValueError(f"draw with {name}(..., size=({len(self._streams)}, ...)), one row an observation")
            try:
                rows = [getattr(stream, name)(*args, size=size[1:], **kwargs) for stream in self._streams]
            except ValueError as error:
                cure = "its numbers are those of every row: mean + 0.1 * generator.normal(size=...)"
                raise ValueError(f"{name}: {error}; {cure}") from None
            return np.stack(rows)

        return draw


class OwnPolicy(Policy):
    """A behaviour policy that is a function of the user's; the function draws its own noise, if it wants any.

    Two known observations are shown to it again before its calls number 1, 2, 4, ... 64, 128, 192 and so on, and after
    the last, in another order and alone: an action must follow from its row alone, not from calls before it, the clock
    or its neighbors.

    Args:
      seen: (2, observation) float32, these observations.
    """

    unit = False

    def __init__(self, name: str, function: Callable[..., Any], task: Task, digest: str, seen: np.ndarray):
        header = PolicyHeader(
            task=task.id,
            observation=task.observation,
            observation_size=task.behaviour_size,
            action_size=task.action_size,
            algorithm=OWN_CODE,
            agent_step=0,
            hidden=(),
            training={"behaviour": name, "source_sha256": digest, "note": MARK},
        )
        super().__init__(header, {}, digest)
        self._name, self._function, self._bounds = name, function, (task.action_low, task.action_high)
        self._seen, self._calls = seen, 0
        self._known = self._probe(PROBES[0])
        self.check()
        self.digest = hashlib.sha256(digest.encode() + (self._known.round(3) + 0.0).tobytes()).hexdigest()

    def _probe(self, rows: Sequence[int]) -> np.ndarray:
        return self._ask(self._seen[rows], [np.random.default_rng(row) for row in rows])

    def check(self) -> None:
        for rows in PROBES:
            if not np.allclose(self._probe(rows), self._known[rows], atol=ROUNDING):
                raise PolicyFileError(
                    f"behaviour {self._name} gave other actions for the same observation; let each row follow from its "
                    "own observation and from what its generator draws, and keep nothing from call to call"
                )

    def act(self, observation, generators=None, deterministic=False):
        self._calls += 1
        if self._calls.bit_count() == 1 or self._calls % 64 == 0:
            self.check()
        return self._ask(observation, generators or ())

    def _ask(self, observation: np.ndarray, generators: Sequence[np.random.Generator]) -> np.ndarray:
        asked = (len(observation), self.header.action_size)
        try:
            action = np.asarray(self._function(np.array(observation, np.float32), RowGenerator(generators)))
        except Exception as error:  # the user's code
            told = f"behaviour {self._name} failed ({type(error).__name__}: {first_line(error)})"
            raise PolicyFileError(told) from error
        if action.shape != asked or action.dtype.kind not in "fiu":
            raise PolicyFileError(
                f"behaviour {self._name} gave {action.dtype} of shape {action.shape}, {self.header.task} takes numbers "
                f"of shape {asked}; return one row of {asked[1]} actions an observation"
            )
        if not np.isfinite(action).all():
            raise PolicyFileError(
                f"behaviour {self._name} gave actions that are not finite; return numbers in the task's bounds"
            )
        return np.clip(action.astype(np.float32), *self._bounds)


def own_policy(name: str, task: Task) -> OwnPolicy:
    """The behaviour policy of a function "<module>:<function>", tried on observations of the task.

    Raises:
      DmcvbError: its code may not run, cannot be found, fails, or gives no actions of the task.
    """
    function = find_function(name, BEHAVIOURS, "behaviour")
    digest = source_digest(name.partition(":")[0])
    if not digest or not callable(function):
        raise PolicyFileError(
            f"behaviour {name} is no function of a module with a source file; give <module>:<function>"
        )
    batch, generators = task.batch(2), [np.random.default_rng(row) for row in range(2)]
    batch.reset(generators)
    actions = [generator.uniform(task.action_low, task.action_high) for generator in generators]
    batch.step(np.stack(actions))  # as some tasks always start alike
    return OwnPolicy(name, function, task, digest, batch.behaviour_observation())
