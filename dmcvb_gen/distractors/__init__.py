"""Distractors: what varies in the picture and nowhere else.

`sample_distractors` expands a setting into per-frame labels, from random streams that physics never touches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dmcvb_gen.distractor_state import LABEL_DTYPES, DistractorState
from dmcvb_gen.distractors.backgrounds import Backgrounds, load_backgrounds
from dmcvb_gen.distractors.base import Distractor, DistractorSetting, Scene, floor_alpha_for
from dmcvb_gen.distractors.registry import BUILT_IN, distractors_of
from dmcvb_gen.tasks.base import Task


class DistractorSampler:
    """An episode batch's distractors, drawn ahead of the trajectory.

    The random walks need only the streams. The states of the agent come frame by frame when an agent is evaluated, or
    for whole episodes at once.

    Args:
      generators: stream name -> one generator an episode; "camera", "color", "background", "style", "cue" are used.
      frames: frames an episode at most.
    """

    def __init__(
        self,
        task: Task,
        setting: DistractorSetting,
        frames: int,
        generators: Mapping[str, Sequence[np.random.Generator]],
        backgrounds: Backgrounds | None,
        split: str = "train",
    ):
        self.task, self.setting, self.frames = task, setting, frames
        self._scene = Scene(task, setting, len(generators["style"]), frames, backgrounds, split)
        self._drawn = [distractor(self._scene, generators[distractor.stream]) for distractor in distractors_of(setting)]
        given = {name for distractor in self._drawn for name in distractor.names}
        self._left_out = [distractor for distractor in BUILT_IN if not given.issuperset(distractor.names)]

    def labels(
        self, physics: np.ndarray, actions: np.ndarray | None = None, frame: int | None = None
    ) -> DistractorState:
        """Labels of whole episodes, leading shape (episode, frame), or of one frame of all of them, (episode,).

        Args:
          physics: (episode, frame, physics) float64, or (episode, physics) at that frame.
          actions: (..., action), those before each frame; zeros before the first one, or if None.
        """
        frames = slice(physics.shape[1]) if frame is None else frame
        found: dict[str, np.ndarray] = {}
        for nominal in self._left_out:
            found.update(nominal.nominal(self._scene, physics))
        for distractor in self._drawn:
            found.update(distractor.labels(physics, frames))
        if actions is None:
            actions = np.zeros((*physics.shape[:-1], self.task.action_size))
        for distractor in self._drawn:
            distractor.adjust(found, actions, frames)
        return DistractorState(
            **{name: found[name].astype(LABEL_DTYPES[name]) for name in LABEL_DTYPES if name in found}
        )


def sample_distractors(
    task: Task,
    setting: DistractorSetting,
    physics: np.ndarray,
    generators: Mapping[str, Sequence[np.random.Generator]],
    backgrounds: Backgrounds | None = None,
    split: str = "train",
    actions: np.ndarray | None = None,
) -> DistractorState:
    """Per-frame labels of whole episodes (Distracting Control Suite; DMC-VB, section 3.1).

    Args:
      physics: (episode, frame, physics) float64 states.
      generators: stream name -> one generator an episode.
      backgrounds: the videos, needed unless the setting is "none".
      split: "train" or "val", which maze styles.
      actions: (episode, frame, action), the one before each frame, which cues follow; zeros if None.

    Returns:
      Labels with leading shape (episode, frame); an episode's labels depend on its own streams and states only,
      and a longer episode begins with the labels of a shorter one.
    """
    return DistractorSampler(task, setting, physics.shape[1], generators, backgrounds, split).labels(physics, actions)


__all__ = [
    "Backgrounds",
    "Distractor",
    "DistractorSampler",
    "DistractorSetting",
    "Scene",
    "floor_alpha_for",
    "load_backgrounds",
    "sample_distractors",
]
