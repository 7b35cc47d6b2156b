"""The background distractor: each episode draws a video, and every frame shows a frame of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dmcvb_gen.distractors.base import Distractor, Scene

TICKS_A_FRAME = 10
"""Control steps between two frames of the video."""


def ping_pong(start: int, direction: int, moves: np.ndarray, length: int) -> np.ndarray:
    """Frame index after `moves` moves from `start`, turning at both ends of a video of `length` frames."""
    period = max(1, 2 * (length - 1))
    phase = (start if direction > 0 else period - start) + moves
    place = phase % period
    return np.where(place < length, place, period - place)


class Background(Distractor):
    """A video on the sky, from a start frame in a direction; -1 for the model's own sky."""

    kinds = ("static", "dynamic")
    stream = "background"
    names = ("background_video", "background_frame")

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        if scene.backgrounds is None:
            raise ValueError(f"distractor {scene.setting.name!r} needs backgrounds")
        lengths, ticks = scene.backgrounds.lengths, scene.task.action_repeat * np.arange(scene.frames)
        in_play = len(lengths) if scene.setting.videos is None else min(scene.setting.videos, len(lengths))
        moves = ticks // TICKS_A_FRAME if scene.setting.kind == "dynamic" else np.zeros_like(ticks)
        video, index = np.empty((2, len(generators), scene.frames), np.int16)
        for episode, rng in enumerate(generators):
            video[episode] = chosen = int(rng.integers(in_play))
            start, direction = int(rng.integers(lengths[chosen])), int(rng.integers(2)) * 2 - 1
            index[episode] = ping_pong(start, direction, moves, int(lengths[chosen]))
        self.drawn = {"background_video": video, "background_frame": index}

    @classmethod
    def nominal(cls, scene: Scene, physics: np.ndarray) -> Mapping[str, np.ndarray]:
        return {name: np.full(physics.shape[:-1], -1, np.int16) for name in cls.names}
