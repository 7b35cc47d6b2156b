"""Rollouts that take a moment: episodes of a few steps and a painter that is only arithmetic, for many faults an hour.

What is painted does not matter to a campaign of faults; that the same state gives the same picture does.
"""

from __future__ import annotations

import zlib

import numpy as np

from dmcvb_gen.rendering.base import Renderer, check_frames

STEPS = 12
"""Agent steps an episode."""


class Painter(Renderer):
    """Pictures whose every byte follows from the bytes of the state, the labels and the view."""

    name = "warp"

    def __init__(self, task, size, **settings):
        self.task, self.size = task, size

    def render(self, physics, exogenous, views=None, hide_goal=False):
        indices = check_frames(self.task, physics, exogenous, views)
        labels = [np.ascontiguousarray(value) for _, value in exogenous.items()]
        out = np.empty((len(physics), len(indices), self.size, self.size, 3), np.uint8)
        ramp = np.arange(self.size * self.size * 3, dtype=np.uint64).reshape(self.size, self.size, 3)
        for frame in range(len(physics)):
            state = zlib.crc32(b"".join([physics[frame].tobytes(), *(value[frame].tobytes() for value in labels)]))
            for place, view in enumerate(indices):
                out[frame, place] = (ramp * np.uint64(7 + view) + np.uint64(state)) % np.uint64(251)
        return out

    def describe(self):
        return {"version": "quick"}


def shrink() -> None:
    """Have every task of this process (and of those that are forked from it) be of that kind."""
    from dmcvb_gen.rollout import plan
    from dmcvb_gen.tasks.ant_maze.task import AntMaze
    from dmcvb_gen.tasks.locomotion import CheetahRun, HumanoidWalk, WalkerWalk

    for task in (WalkerWalk, CheetahRun, HumanoidWalk, AntMaze):
        task.max_steps = STEPS
    plan.make_renderer = lambda name, task, size, **settings: Painter(task, size)
