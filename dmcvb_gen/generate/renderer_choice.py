"""Choose a task's renderer: native where it draws what MuJoCo's own draws, else MuJoCo's own."""

from __future__ import annotations

import functools
import logging

import numpy as np

from dmcvb_gen.distractors import DistractorSetting, sample_distractors
from dmcvb_gen.errors import RenderingError
from dmcvb_gen.generate.recipe import NATIVE
from dmcvb_gen.own_code import is_own
from dmcvb_gen.rendering.native import NativeRenderer
from dmcvb_gen.rendering.opengl import OpenglRenderer
from dmcvb_gen.spec import task_folder
from dmcvb_gen.tasks.base import Task

LARGEST_MEAN, LARGEST_BLOCK = 3.0, 25.0
"""Grey levels of 255 that native may be off on average, and in the worst block of a picture."""
BLOCK = 8
"""Pixels a side of a block."""
SIZE = 64
"""Pixels a side of the pictures that are compared."""
STEPS = 500
"""Agent steps of the episode that is looked at, at most."""
_log = logging.getLogger(__name__)


@functools.lru_cache(maxsize=32)
def default_renderer(task: Task) -> str:
    """The renderer of a task unless another one is asked for; why it is not native is logged in one line.

    Tests compare native with MuJoCo's renderer on every task of the package and of dm_control's suite. On a user's own
    task both draw the start, the middle and the end of an episode of random actions here.
    """
    name = task_folder(task.id)
    try:
        NativeRenderer.check_task(task)
    except RenderingError as error:
        _log.warning("%s is rendered by opengl: %s", name, error)
        return "opengl"
    if not is_own(task.id):
        return NATIVE
    if reason := OpenglRenderer.unavailable():
        _log.warning("%s is rendered by native, without a comparison with MuJoCo's own renderer: %s", name, reason)
        return NATIVE
    mean, block = disagreement(task)
    if mean <= LARGEST_MEAN and block <= LARGEST_BLOCK:
        return NATIVE
    _log.warning(
        f"{name} is rendered by opengl: native's pictures are {mean:.1f} grey levels off on average (at most "
        f"{LARGEST_MEAN:g} are allowed) and {block:.0f} in a block of {BLOCK} x {BLOCK} (at most {LARGEST_BLOCK:g})"
    )
    return "opengl"


def disagreement(task: Task) -> tuple[float, float]:
    """How far native is from MuJoCo's renderer: of the worst picture on average, and in the worst block of any."""
    physics = _moments(task)
    labels = sample_distractors(task, DistractorSetting(), physics[None], {"style": [np.random.default_rng(0)]}).flat()
    pictures = []
    for renderer in (NativeRenderer(task, SIZE), OpenglRenderer(task, SIZE)):
        pictures.append(renderer.render(physics, labels).astype(float))
        renderer.close()
    off = np.abs(pictures[0] - pictures[1]).mean(axis=-1)  # frame, view, row, column
    blocks = off.reshape(*off.shape[:2], SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK).mean(axis=(3, 5))
    return float(off.mean(axis=(2, 3)).max()), float(blocks.max())


def _moments(task: Task) -> np.ndarray:
    """(3, physics): the start, the middle and the end of an episode of random actions."""
    batch, rng = task.batch(1), np.random.default_rng(0)
    batch.reset([np.random.default_rng(0)])
    states = [batch.physics()[0]]
    for _ in range(min(task.max_steps, STEPS)):
        step = batch.step(task.from_unit(rng.uniform(-1, 1, (1, task.action_size))))
        states.append(batch.physics()[0])
        if step.terminated[0] or step.truncated[0]:
            break
    return np.stack([states[0], states[len(states) // 2], states[-1]])
