"""The background distractor: each episode draws a video, and every frame shows a frame of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dmcvb_gen.distractors.base import Distractor, DistractorSetting, Scene

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
    lengths: Sequence[int],
    setting: DistractorSetting,
    ticks: np.ndarray,
    generators: Sequence[np.random.Generator],
) -> tuple[np.ndarray, np.ndarray]:
    """Draw videos, start frames and directions.

    Args:
      lengths: frames of each video; the first `setting.videos` of them are in play.
      ticks: (frame,) int, control steps before each frame.

    Returns:
      video and frame, each (episode, frame) int16.
    """
    in_play = len(lengths) if setting.videos is None else min(setting.videos, len(lengths))
    video = np.empty((len(generators), len(ticks)), np.int16)
    index = np.empty((len(generators), len(ticks)), np.int16)
    moves = ticks // TICKS_A_FRAME if setting.kind == "dynamic" else np.zeros_like(ticks)
    for episode, rng in enumerate(generators):
        chosen = int(rng.integers(in_play))
        start, direction = int(rng.integers(lengths[chosen])), int(rng.integers(2)) * 2 - 1
        video[episode] = chosen
        index[episode] = ping_pong(start, direction, moves, int(lengths[chosen]))
    return video, index


class Background(Distractor):
    """A video on the sky, from a start frame in a direction; -1 for the model's own sky."""

    kinds = ("static", "dynamic")
    stream = "background"
    names = ("background_video", "background_frame")

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        if scene.backgrounds is None:
            raise ValueError(f"distractor {scene.setting.name!r} needs backgrounds")
        lengths, ticks = scene.backgrounds.lengths, scene.task.action_repeat * np.arange(scene.frames)
        self._video, self._index = background_walk(lengths, scene.setting, ticks, generators)

    def labels(self, physics: np.ndarray, frames: int | slice) -> Mapping[str, np.ndarray]:
        return {"background_video": self._video[:, frames], "background_frame": self._index[:, frames]}

    @classmethod
    def nominal(cls, scene: Scene, physics: np.ndarray) -> Mapping[str, np.ndarray]:
        return {name: np.full(physics.shape[:-1], -1, np.int16) for name in cls.names}
