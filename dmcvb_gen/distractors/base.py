"""Base of all distractors: each varies some labels of the pictures, from a random stream of its own."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.distractors.backgrounds import Backgrounds
from dmcvb_gen.spec import DistractorSetting
from dmcvb_gen.tasks.base import Task


@dataclass(frozen=True)
class Scene:
    """The scene that a distractor draws its labels for.

    Attributes:
      task: the task that is shown.
      setting: kind and difficulty; ranges are multiples of its `scale`.
      frames: frames an episode at most.
      backgrounds: the videos; None if the setting is "none".
      split: "train" or "val", which maze styles.
    """

    task: Task
    setting: DistractorSetting
    frames: int
    backgrounds: Backgrounds | None
    split: str = "train"


class Distractor(abc.ABC):
    """One distractor. An instance holds what it drew for the episodes of a scene.

    Random walks need their stream alone; a label that follows the agent is completed in `labels`.

    Attributes:
      kinds: kinds of settings under which it varies.
      stream: the episode's random stream that it draws from, one of `seeding.STREAMS`.
      names: labels that it gives, fields of `DistractorState`; these are stored, and renderers paint from them.
      drawn: those of them that do not follow the agent, each (episode, frame, ...).
    """

    kinds: ClassVar[tuple[str, ...]]
    stream: ClassVar[str]
    names: ClassVar[tuple[str, ...]]
    drawn: Mapping[str, np.ndarray] = {}

    @abc.abstractmethod
    def __init__(self, scene: Scene, generators: Sequence[np.random.Generator]):
        """Draw whole episodes, one from each generator. A longer episode must begin with the shorter one."""

    def labels(self, physics: np.ndarray, frames: int | slice) -> Mapping[str, np.ndarray]:
        """The labels of some frames, by default what was drawn for them.

        Args:
          physics: (episode, physics) or (episode, frame, physics) float64, the states at these frames.
          frames: one frame of all episodes, or a slice of them; indexes the second axis of what was drawn.

        Returns:
          name -> array with the leading shape of `physics`.
        """
        return {name: values[:, frames] for name, values in self.drawn.items()}

    def adjust(self, found: dict[str, np.ndarray], actions: np.ndarray, frames: int | slice) -> None:  # noqa: B027
        """Change labels that other distractors gave, in place; does nothing by default.

        Args:
          found: all labels by name, with a leading shape of (episode,) or (episode, frame).
          actions: (..., action), the action before each frame; zeros before the first one.
          frames: see `labels`.
        """

    @classmethod
    def nominal(cls, scene: Scene, physics: np.ndarray) -> Mapping[str, np.ndarray]:
        """The task's own labels, which are shown if the setting leaves this distractor out; see `labels`.

        Only distractors whose labels every subset stores (`BUILT_IN`) need it; the others are never left out.
        """
        return {}


def bounded_walk(
    scene: Scene,
    generators: Sequence[np.random.Generator],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    std: float | np.ndarray,
) -> np.ndarray:
    """Walks that stop at the ends of their range; a tick is a control step.

    Args:
      start: (episode, ...), `low` and `high` its range.
      std: standard deviation of a tick's step.

    Returns:
      (episode, frame, ...)
    """
    repeat, ticks = scene.task.action_repeat, scene.task.action_repeat * (scene.frames - 1)
    noise = np.stack([arithmetic.normal(rng, (ticks, *start.shape[1:])) for rng in generators], axis=1)
    out = np.empty((len(start), scene.frames, *start.shape[1:]))
    out[:, 0] = place = start
    for tick in range(ticks):
        place = np.clip(place + std * noise[tick], low, high)
        if (tick + 1) % repeat == 0:
            out[:, (tick + 1) // repeat] = place
    return out


def floor_alpha_for(task: Task, setting: DistractorSetting) -> float:
    """Opacity of the ground plane: under distractors the background shows through humanoid's floor.

    Walker and cheetah 1.0, reacher 0.0, otherwise 0.3 (Distracting Control Suite); untouched if no background is shown.
    """
    return task.floor_alpha if setting.shows_videos else 1.0
