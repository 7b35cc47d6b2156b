"""The background distractor: an episode's own stream in, a video and one of its frames for every frame out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dmcvb_gen.distractors.base import Distractor
from dmcvb_gen.tasks.base import ACTION_REPEAT

TICKS_A_FRAME = 10
"""Control steps between two frames of the video."""


def ping_pong(start: int, direction: int, moves: np.ndarray, length: int) -> np.ndarray:
    """Frame index after `moves` moves from `start`, turning at both ends of a video of `length` frames."""
    if length == 1:
        return np.zeros_like(moves)
    period = 2 * (length - 1)
    phase = (start if direction > 0 else period - start) + moves
    place = phase % period
    return np.where(place < length, place, period - place)


def background_walk(
    lengths: Sequence[int], setting: Distractor, frames: int, generators: Sequence[np.random.Generator]
) -> tuple[np.ndarray, np.ndarray]:
    """Draw videos, start frames and directions.

    Args:
      lengths: frames of each video; the first `setting.videos` of them are in play.

    Returns:
      video and frame, each (episode, frame) int16.
    """
    in_play = len(lengths) if setting.videos is None else min(setting.videos, len(lengths))
    video = np.empty((len(generators), frames), np.int16)
    index = np.empty((len(generators), frames), np.int16)
    moves = ACTION_REPEAT * np.arange(frames) // TICKS_A_FRAME if setting.kind == "dynamic" else np.zeros(frames, int)
    for episode, rng in enumerate(generators):
        chosen = int(rng.integers(in_play))
        start, direction = int(rng.integers(lengths[chosen])), int(rng.integers(2)) * 2 - 1
        video[episode] = chosen
        index[episode] = ping_pong(start, direction, moves, int(lengths[chosen]))
    return video, index
