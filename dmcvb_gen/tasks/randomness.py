"""Random numbers of a user's own code: what it draws follows from an episode's seed, or is refused."""

from __future__ import annotations

import contextlib
import gc
import random
import threading
import types
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.random import bit_generator

OBJECTS = 100_000
"""Objects of a task that are searched for generators, at most."""
_ALONE = threading.RLock()
"""Held while the global generators are seeded, which all threads share."""
_NUMPY: Any = bit_generator  # whose name for `secrets.randbits` gives generators without a seed their entropy
_entropy: ContextVar[Callable[[int], int]] = ContextVar("entropy", default=_NUMPY.randbits)
_NUMPY.randbits = lambda bits: _entropy.get()(bits)


@contextlib.contextmanager
def _entropy_from(bits: Callable[[int], int]) -> Iterator[None]:
    """This thread's generators that are made without a seed take it from `bits`, not from the operating system."""
    token = _entropy.set(bits)
    try:
        yield
    finally:
        _entropy.reset(token)


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """The global generators, and those of numpy that are made without a seed meanwhile, follow from `seed`."""
    with _ALONE:
        kept, source = (np.random.get_state(legacy=False), random.getstate()), random.Random(seed)
        np.random.seed(source.getrandbits(32))
        random.seed(source.getrandbits(64))
        try:
            with _entropy_from(source.getrandbits):
                yield
        finally:
            np.random.set_state(kept[0])
            random.setstate(kept[1])


def seed_task(task: Any, seed: int) -> None:
    """Seed the generator of a dm_control task, `task.random`, in place: whatever shares it follows."""
    generator = getattr(task, "random", None)
    if isinstance(generator, np.random.RandomState):
        fresh = np.random.RandomState(type(generator._bit_generator)(seed))
        generator.set_state(fresh.get_state(legacy=False))
    elif isinstance(generator, np.random.Generator):
        generator.bit_generator.state = type(generator.bit_generator)(seed).state
    elif isinstance(generator, random.Random):
        generator.seed(seed)


@contextlib.contextmanager
def watched(complain: Callable[[str], Exception], alone: bool = True) -> Iterator[None]:
    """Raise what `complain` makes of a reason if code draws from a global generator, or makes one without a seed.

    Args:
      alone: False if other threads may draw from the global generators meanwhile. These are not compared then.
    """

    def refuse(count: int) -> int:
        raise complain("made a random generator without a seed in a step; draw from self.random")

    before = np.random.get_state(legacy=False)["state"], random.getstate()
    with _entropy_from(refuse):
        yield
    after = np.random.get_state(legacy=False)["state"], random.getstate()
    same = before[0]["pos"] == after[0]["pos"] and np.array_equal(before[0]["key"], after[0]["key"])
    if alone and (not same or before[1] != after[1]):
        raise complain("drew from a global random generator in a step; draw from self.random")


def held_states(task: Any) -> list[str]:
    """States of the generators that a task holds besides `task.random`, in the order in which they are found."""
    known, found, seen, left = getattr(task, "random", None), [], set[int](), [task]
    while left and len(seen) < OBJECTS:
        one = left.pop()
        if id(one) in seen or one is known or isinstance(one, type | types.ModuleType):
            continue
        seen.add(id(one))
        if isinstance(one, np.random.Generator):
            found.append(str(one.bit_generator.state))
        elif isinstance(one, np.random.RandomState):
            found.append(str(one.get_state(legacy=False)))
        elif isinstance(one, random.Random):
            found.append(str(one.getstate()))
        elif isinstance(one, types.FunctionType):  # its globals are not the task's
            cells = (cell for cell in one.__closure__ or () if gc.get_referents(cell))  # some are empty
            left += [cell.cell_contents for cell in cells] + list(one.__defaults__ or ())
        else:
            left += gc.get_referents(one)
    return found
