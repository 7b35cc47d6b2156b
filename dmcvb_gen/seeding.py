"""Random streams: independent numpy generators for each (seed, names, episode).

Every random number of a release comes from here. An episode's streams depend on the
recipe's seed, on names (task, level, ...) and on the episode's index alone, never on
worker count, order or machine, so any episode can be made again by itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import random
from collections.abc import Iterator

import numpy as np

STREAMS = ("initial_state", "policy", "camera", "color", "background", "style", "cue", "shake", "light")
"""The streams of an episode, in the order of their spawn keys. Append only: an index is part of the data.

No distractor draws from "shake" any more."""
DISTRACTOR_STREAMS = tuple(name for name in STREAMS if name not in ("initial_state", "policy"))
"""Those that the simulation leaves to distractors."""


@contextlib.contextmanager
def generators_kept() -> Iterator[None]:
    """Put the generators of Python, numpy and torch back as they were. A training seeds them."""
    import torch

    python, legacy = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng(range(torch.cuda.device_count())):
            yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)


def name_key(*names: str) -> tuple[int, ...]:
    """Four 32-bit words that stand for `names` (a SHA-256 prefix, the same on every machine)."""
    digest = hashlib.sha256("\0".join(names).encode()).digest()
    return tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))


def episode_stream(seed: int, names: tuple[str, ...], episode: int, stream: str) -> np.random.Generator:
    """The generator of one stream of one episode.

    Args:
      seed: the recipe's seed, >= 0.
      names: names of what the stream belongs to, e.g. ("walker-walk", "expert").
      episode: index of the episode in its subset, >= 0.
      stream: one of `STREAMS`.
    """
    key = (*name_key(*names), episode, STREAMS.index(stream))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def episode_seed(seed: int, names: tuple[str, ...], episode: int) -> int:
    """A 64-bit number that labels the episode's streams, stored beside the data."""
    sequence = np.random.SeedSequence(seed, spawn_key=(*name_key(*names), episode))
    return int(sequence.generate_state(1, np.uint64)[0])
