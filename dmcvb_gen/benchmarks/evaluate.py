"""Online evaluation: a policy and the subset it learned from in, scores of fresh episodes out, all in one batch.

The episodes are those of the subset's task, painted by its renderer at its size, with its kind of distractors: unseen
`val` videos and maze styles, and streams of their own, apart from every release's (paper, section 5). In mazes an agent
has 1,000 steps (`Task.evaluation_steps`), where the authors' evaluation stops; the data were cut at 600.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from dmcvb_gen.agents.data import Normalization, normalize_pixels
from dmcvb_gen.agents.learners import Policy
from dmcvb_gen.dataset import Subset
from dmcvb_gen.dataset.pictures import training_pictures
from dmcvb_gen.distractors import DistractorSampler, load_backgrounds
from dmcvb_gen.generate.jobs import video_source
from dmcvb_gen.generate.recipe import RendererChoice
from dmcvb_gen.generate.render import renderer_for
from dmcvb_gen.names import distractor_of
from dmcvb_gen.seeding import STREAMS, episode_stream
from dmcvb_gen.tasks import ACTION_REPEAT, get_task
from dmcvb_gen.tasks.base import Task

STREAM_NAME = "validate"
"""Of the evaluation's streams: no release is made from it."""
SPLIT = "val"
"""Of videos and maze styles: none of them is in data."""


@dataclass(frozen=True)
class Score:
    """Returns of online episodes.

    Attributes:
      mean, stderr: of the returns; the standard error is std / sqrt(episodes), std with n - 1.
      returns: of each episode.
      success: share of the episodes that the task ended (mazes), else None.
      speed: mean speed towards the goal of the successful episodes, m/s (mazes), else None (`goal_speed`).
      limit: agent steps after which an episode was cut.
      seconds: that it took.
      pictures: (frame, size, size, 3) uint8, the first episode at even intervals; None for agents that see states.
    """

    mean: float
    stderr: float
    returns: tuple[float, ...]
    success: float | None = None
    speed: float | None = None
    limit: int | None = None
    seconds: float = 0.0
    pictures: np.ndarray | None = field(default=None, repr=False)

    def facts(self) -> dict[str, Any]:
        """Everything but the pictures, as plain values."""
        names = ("mean", "stderr", "returns", "success", "speed", "limit", "seconds")
        return {name: getattr(self, name) for name in names}


def evaluation_steps(task: Task, max_steps: int | None = None) -> int:
    """Agent steps after which an evaluation's episode is cut, by its task and (for smoke runs) `max_steps`."""
    return min(max_steps or task.evaluation_steps, task.evaluation_steps)


def protocol(
    subset: Subset,
    pair: tuple | None = None,
    backgrounds: str | None = None,
    pictures: bool = True,
    max_steps: int | None = None,
) -> dict[str, Any]:
    """All that decides an evaluation's episodes but the policy, as plain values; arguments as for `Evaluator`.

    Raises:
      BackgroundError: there are no `val` videos.
    """
    facts: dict[str, Any] = {"steps": evaluation_steps(get_task(subset.task), max_steps), "goals": pair}
    if pictures:
        facts |= {"size": subset.record.size, "renderer": renderer_choice(subset), "backgrounds": None}
        if distractor_of(subset.task, subset.setting).kind != "none":
            facts["backgrounds"] = load_backgrounds(video_source(subset.root, subset.record, backgrounds), SPLIT).digest
    return facts


def renderer_choice(subset: Subset) -> dict[str, Any]:
    """Name and samples of the renderer: the data's own, or the default one where they were painted elsewhere."""
    if subset.record.imported:
        default = RendererChoice()
        return {"name": default.backend, "samples": default.samples}
    return {"name": subset.record.renderer["name"], "samples": subset.record.renderer.get("samples")}


def goal_speed(distance: np.ndarray, length: np.ndarray, reached: np.ndarray, task: Task) -> float | None:
    """Mean speed towards the goal of the episodes that reached it, m/s; None where none did.

    Args:
      distance: (episode,) to the goal at the start in a straight line, meters.
      length: (episode,) agent steps. reached: (episode,) bool.
    """
    seconds = length * ACTION_REPEAT * task.control_timestep
    return float((distance / seconds)[reached].mean()) if reached.any() else None


class Evaluator:
    """Evaluates policies on one subset's task; a renderer is started once and kept.

    Args:
      subset: what the policy learned from; its setting, size and renderer are evaluated on.
      pixels: the policies see pictures; else states.
      normalization: of the states, for policies that see them.
      stack: frames an observation.
      episodes: run side by side, each once.
      seed: of the evaluation's streams.
      pair: the fixed (start, goal) cells of a maze's episodes, instead of random ones.
      max_steps: cut episodes short (for tests and smoke runs).
      backgrounds: where the `val` videos are, if not where the manifest says.
      device: of policy and renderer.

    Raises:
      DmcvbError: the renderer cannot start here, or there are no `val` videos.
    """

    def __init__(
        self,
        subset: Subset,
        *,
        pixels: bool = True,
        normalization: Normalization | None = None,
        stack: int = 3,
        episodes: int = 30,
        seed: int = 1,
        pair: tuple | None = None,
        max_steps: int | None = None,
        backgrounds: str | None = None,
        device: str = "cpu",
        threads: int = 1,
        shots: int = 8,
    ):
        self.subset, self.task = subset, get_task(subset.task)
        self.setting = distractor_of(subset.task, subset.setting)
        self.episodes, self.seed, self.threads, self.shots = episodes, seed, threads, shots
        self.steps = evaluation_steps(self.task, max_steps)
        self.device, self.normalization, self.stack = torch.device(device), normalization, stack
        self.pair, self.renderer = pair, None
        if pixels:
            choice, source = renderer_choice(subset), video_source(subset.root, subset.record, backgrounds)
            on = "cuda" if self.device.type == "cuda" and choice["name"] == "warp" else "cpu"
            self.renderer, self._videos = renderer_for(subset.record, source, SPLIT, on, **choice)
            if hasattr(self.renderer, "worlds"):
                self.renderer.worlds = episodes  # frames a launch: more would only be padding
            pictures = training_pictures(subset)
            self.hide_goal, self.views = pictures.hide_goal, list(pictures.views)

    def close(self) -> None:
        """Free the renderer."""
        if self.renderer is not None:
            self.renderer.close()

    def streams(self, name: str) -> list[np.random.Generator]:
        """The evaluation's own streams; the same for every policy, so that scores are compared on like episodes."""
        names = (STREAM_NAME, self.subset.task, self.subset.setting)
        return [episode_stream(self.seed, names, episode, name) for episode in range(self.episodes)]

    def __call__(self, policy: Policy) -> Score:
        """Roll the policy out. It is asked for one action a step, for all episodes at once."""
        started = time.perf_counter()
        task, count = self.task, self.episodes
        batch = task.batch(count, self.threads)
        starts = self.streams("initial_state")
        state = batch.reset(starts) if self.pair is None else batch.reset_fixed(starts, [self.pair] * count)
        distance = _distance(task, state)
        walk, stack, pictures = self._walk(), None, []
        returns, length = np.zeros(count), np.full(count, self.steps)
        active, ended = np.ones(count, bool), np.zeros(count, bool)
        for step in range(self.steps):
            if walk is None:
                observation = self.normalization(torch.from_numpy(state).float()).to(self.device)
            else:
                stack = self._see(stack, batch.physics(), walk, step, active)
                if step % max(1, self.steps // self.shots) == 0:
                    pictures.append(stack[0, -1, :3].transpose(1, 2, 0).copy())
                observation = normalize_pixels(torch.from_numpy(stack).to(self.device).flatten(1, 2))
            with torch.no_grad(), policy.precision():
                action = policy.act(observation).float().clamp(-1, 1).cpu().numpy()
            result = batch.step(action, active)
            state = result.state
            returns += result.reward  # episodes that are over earn nothing
            length[result.terminated & active] = step + 1
            ended |= result.terminated
            active &= ~result.terminated
            if not active.any():
                break
        return Score(
            mean=float(returns.mean()),
            stderr=float(returns.std(ddof=1) / math.sqrt(count)) if count > 1 else 0.0,
            returns=tuple(float(value) for value in returns),
            success=None if distance is None else float(ended.mean()),
            speed=None if distance is None else goal_speed(distance, length, ended, task),
            limit=self.steps,
            seconds=time.perf_counter() - started,
            pictures=np.stack(pictures) if pictures else None,
        )

    def _walk(self) -> DistractorSampler | None:
        """The distractors of the episodes; None for policies that see states."""
        if self.renderer is None:
            return None
        generators = {name: self.streams(name) for name in STREAMS if name not in ("initial_state", "policy")}
        return DistractorSampler(self.task, self.setting, self.steps + 1, generators, self._videos, split=SPLIT)

    def _see(self, stack, physics, walk: DistractorSampler, step: int, active: np.ndarray) -> np.ndarray:
        """(episode, frame, channel, size, size) uint8 with the newest frame last; only running episodes are painted."""
        rows = np.flatnonzero(active)
        labels = walk.frame(step, physics)[rows]
        painted = self.renderer.render(physics[rows], labels, self.views, hide_goal=self.hide_goal)
        frames = painted.transpose(0, 1, 4, 2, 3).reshape(len(rows), -1, *painted.shape[2:4])
        if stack is None:
            return np.repeat(frames[:, None], self.stack, axis=1)
        stack[:, :-1] = stack[:, 1:].copy()
        stack[rows, -1] = frames
        return stack


def _distance(task, state: np.ndarray) -> np.ndarray | None:
    """(episode,) meters to the goal in a straight line, for tasks that have one."""
    part = task.state_slices.get("target_vector")
    return None if part is None else np.linalg.norm(state[:, part], axis=1)
