"""Render stored arrays: the pictures and labels of episodes, from their physics states and their subset's record.

The engine, the checks and the readers that render on demand share it.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.dataset.pictures import picture_arrays
from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.distractors import Backgrounds, floor_alpha_for, load_backgrounds, sample_distractors
from dmcvb_gen.generate.modalities import Modality, Seen, get_modality
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.rendering import renderer_class
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.seeding import DISTRACTOR_STREAMS, episode_stream
from dmcvb_gen.spec import DistractorSetting
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import Task

PAINT_FRAMES = 2004
"""Frames rendered between two calls of the progress callback."""
MOST_RENDERERS = 4
"""Renderers of a task that a process keeps."""
LABEL_FRAMES = 512
"""Frames of depth, segmentation or flow that are rendered at once."""


def open_renderer(
    task: Task, setting: DistractorSetting, name: str, size: int, samples: Any, backgrounds: str, split: str
) -> tuple[Renderer, Any]:
    """A renderer of a task under a distractor, and its videos (None without distractors).

    Args:
      backgrounds: "builtin" or a folder of videos.

    Raises:
      RenderingError: it cannot start here, or shows no videos on this task.
    """
    videos = videos_of(setting, backgrounds, split)
    floor = floor_alpha_for(task, setting)
    renderer = renderer_class(name)(task, size, backgrounds=videos, floor_alpha=floor, samples=samples)
    if setting.varies("background"):
        renderer.check_sky()
    return renderer, videos


def renderer_for(record: SubsetRecord, backgrounds: str) -> tuple[Renderer, Any]:
    """The renderer of a subset, and its videos, see `open_renderer`."""
    look = (str(record.renderer["name"]), record.size, record.renderer.get("samples"))
    return open_renderer(get_task(record.task), record.distractor, *look, backgrounds, record.split)


def videos_of(setting: DistractorSetting, backgrounds: str, split: str) -> Backgrounds | None:
    """The videos that a distractor draws from; None without distractors."""
    return None if setting.kind == "none" else load_backgrounds(backgrounds, split)


class RendererCache(threading.local):
    """Keeps a thread's last renderers of a task, which are large: the settings of a work take turns."""

    def __init__(self) -> None:
        self._made: dict[tuple, Renderer] = {}

    def get(self, record: SubsetRecord, backgrounds: str) -> Renderer:
        """Return the renderer that `renderer_for` would make, from the cache if it is there."""
        setting = record.distractor
        key: tuple = (record.task, setting.name, record.size, str(sorted(record.renderer.items(), key=str)))
        key += (backgrounds, record.split)
        if key not in self._made:
            if len(self._made) == MOST_RENDERERS or any(task != record.task for task, *_ in self._made):
                self.close()
            self._made[key] = renderer_for(record, backgrounds)[0]
        return self._made[key]

    def close(self) -> None:
        """Free what is held."""
        for renderer in self._made.values():
            renderer.close()
        self._made.clear()


renderers = RendererCache()
"""The renderers of this process, of each thread its own: one thread at a time may use a renderer."""


def distractor_state_of(
    record: SubsetRecord,
    seed: int,
    names: tuple[str, ...],
    episodes: Sequence[int],
    physics: np.ndarray,
    length: np.ndarray,
    backgrounds: Any,
    action: np.ndarray,
) -> DistractorState:
    """Distractor labels of episodes, leading shape (episode, row); rows past an episode's end are zero.

    Args:
      seed, names: seed and names of the episodes' streams.
      episodes: indices in the subset.
      physics: (episode, row, physics) float64.
      length: (episode,) transitions of each.
      backgrounds: the videos, None if the distractor shows none.
      action: (episode, row, action), taken at each row; cues follow the one before a frame.
    """
    task = get_task(record.task).at(record.action_repeat)
    rows = int(length.max()) + 1
    after = np.arange(rows)[None] > length[:, None]
    padded = physics[:, :rows].copy()
    last = physics[np.arange(len(physics)), length]
    padded[after] = np.repeat(last, after.sum(axis=1), axis=0)  # a state that MuJoCo can be put into
    generators = {name: [episode_stream(seed, names, i, name) for i in episodes] for name in DISTRACTOR_STREAMS}
    setting = record.distractor
    before = np.zeros((len(padded), rows, task.action_size))
    before[:, 1:] = action[:, : rows - 1]
    return sample_distractors(task, setting, padded, generators, backgrounds, record.split, before)


def paint(
    task: Task,
    renderer: Renderer,
    physics: np.ndarray,
    exogenous: DistractorState,
    length: np.ndarray,
    rows: int,
    progress: ProgressCallback = ignore,
    arrays: Collection[str] | None = None,
) -> Iterator[tuple[str, np.ndarray]]:
    """Pictures of episodes, one array at a time; the next one may be written over it.

    Args:
      arrays: only these, by name; all of the task's views, with the goal and without it, by default.

    Yields:
      (name, (episode, rows, size, size, 3) uint8); rows past an episode's end stay zero.
    """
    episode, row = np.nonzero(np.arange(physics.shape[1])[None] <= length[:, None])
    shape = (len(physics), rows, renderer.size, renderer.size, 3)
    names = zip(picture_arrays(task.views), picture_arrays(task.views, hide_goal=True), strict=True)
    memory = {hides: np.zeros(shape, np.uint8) for hides in (False, True)[: 1 + bool(task.goal_geoms)]}
    for view, (name, hidden_name) in zip(task.views, names, strict=True):
        shown = arrays is None or name in arrays
        hidden = bool(task.goal_geoms) and (arrays is None or hidden_name in arrays)
        images = {name: memory[False]} if shown else {}
        images |= {hidden_name: memory[True]} if hidden else {}
        for first in range(0, len(episode) * bool(images), PAINT_FRAMES):
            e, r = (index[first : first + PAINT_FRAMES] for index in (episode, row))
            states, labels = physics[e, r], exogenous[e, r]
            painted = (
                renderer.render_pair(states, labels, [view])
                if shown and hidden
                else (renderer.render(states, labels, [view], hide_goal=hidden),)
            )
            for image, frames in zip(images.values(), painted, strict=True):
                image[e, r] = frames[:, 0]
            progress(len(e))
        yield from images.items()


def label_arrays(exogenous: DistractorState, length: np.ndarray, rows: int) -> Iterator[tuple[str, np.ndarray]]:
    """The labels under their stored names, rows past an episode's end zero."""
    for name, value in exogenous.items():
        full = np.zeros((value.shape[0], rows, *value.shape[2:]), value.dtype)
        full[:, : value.shape[1]] = value
        full[np.arange(rows)[None] > length[:, None]] = 0
        yield f"exogenous/{name}", full


def look(
    renderer: Renderer,
    physics: np.ndarray,
    labels: DistractorState,
    views: Sequence[str],
    hide_goal: bool = False,
    next_physics: np.ndarray | None = None,
    next_labels: DistractorState | None = None,
) -> list[Seen]:
    """Frames as modalities are computed from them, one for each view; see `Seen` for the arguments.

    Raises:
      RenderingError: the renderer has no depth and segmentation.
    """
    found = renderer.render_labels(physics, labels, views, hide_goal)
    after, depth, geom = (next_physics, next_labels), found["depth"], found["segmentation"]
    return [
        Seen(renderer.task, view, renderer.size, depth[:, place], geom[:, place], physics, labels, *after)
        for place, view in enumerate(views)
    ]


def paint_modality(
    renderer: Renderer,
    physics: np.ndarray,
    exogenous: DistractorState,
    length: np.ndarray,
    rows: int,
    name: str,
    hide_goal: bool,
    view: str,
) -> np.ndarray:
    """A modality of what the subset's pictures of a view show.

    Args:
      name: of the modality.

    Returns:
      (episode, rows, size, size, ...); rows past an episode's end stay zero.
    """
    modality = get_modality(name)
    last = length[:, None] - modality.needs_next  # whose next frame is there
    episode, row = np.nonzero(np.arange(physics.shape[1])[None] <= last)
    size = (renderer.size, renderer.size, *modality.shape)
    out = np.zeros((len(physics), rows, *size), modality.dtype)
    for first in range(0, len(episode), LABEL_FRAMES):
        at = (episode[first : first + LABEL_FRAMES], row[first : first + LABEL_FRAMES])
        out[at] = modality_of_frames(renderer, modality, physics, exogenous, at, view, hide_goal)
    return out


def modality_of_frames(
    renderer: Renderer,
    modality: Modality,
    physics: np.ndarray,
    exogenous: DistractorState,
    at: tuple[np.ndarray, ...],
    view: str,
    hide_goal: bool,
) -> np.ndarray:
    """(frame, size, size, ...): a modality of some frames.

    Args:
      at: indices of the frames in `physics` and `exogenous`, those of the rows last.
    """
    after = (*at[:-1], at[-1] + 1)
    following = (physics[after], exogenous[after]) if modality.needs_next else (None, None)
    return modality.compute(look(renderer, physics[at], exogenous[at], [view], hide_goal, *following)[0])
