"""The style of mazes: each episode draws textures of walls and floor, under every setting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dmcvb_gen.distractors.base import Distractor, Scene


def _draw(rng: np.random.Generator, choices: Sequence) -> Any:
    return choices[int(rng.integers(len(choices)))]


class Style(Distractor):
    """A style of the split for each episode, then one of its looks; -1 for tasks that have no styles."""

    kinds = ()  # a task's styles vary under every setting
    stream = "style"
    names = ("style",)

    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        styles = scene.task.styles(scene.split)
        style = np.full((len(generators), scene.frames), -1, np.int16)
        if styles:
            style[:] = [[_draw(rng, _draw(rng, styles))] for rng in generators]
        self.drawn = {"style": style}
