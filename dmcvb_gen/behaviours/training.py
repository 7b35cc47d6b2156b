"""Training a behaviour policy online on states: task and settings in, a run folder of checkpoints out.

The package's own SAC is trained here, Stable-Baselines3's algorithms in `sb3`; `open_run` gives the one that is
asked for. What a run folder holds is said in `runs`.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from dmcvb_gen.behaviours.policy_file import load_policy
from dmcvb_gen.behaviours.runs import (
    SAVE_SECONDS,
    Progress,
    Report,
    Run,
    RunConfig,
    Tick,
    check_same,
    command_of,
    read_config,
)
from dmcvb_gen.behaviours.sac import ReplayBuffer, Sac
from dmcvb_gen.behaviours.settings import check_settings
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.store.manifest import write_json_atomically
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import PHYSICS_SPEC, Task

__all__ = ["Progress", "Run", "RunConfig", "SacRun", "command_of", "open_run", "read_config", "standing_states"]


def shaping_of(task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """(n, state) -> (n,) in [0, 1]: a hint that a learner may be given; only humanoid-walk has one.

    Its reward is zero on the floor; the hint is how high and upright it is. It is full once the
    humanoid stands, so it does not change which gait is best.
    """
    if task.id != "humanoid-walk":
        return lambda state: np.zeros(len(state))
    height, vertical = task.state_slices["head_height"].start, task.state_slices["torso_vertical"].start + 2
    return lambda state: np.clip(state[:, height] / 1.4, 0, 1) ** 2 * (1 + state[:, vertical]) / 2


def standing_states(task: Task, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, physics) float64: the model's own pose with a little noise on every joint, at rest."""
    data = mujoco.MjData(task.model)
    rows = np.empty((count, task.physics_size))
    for row in rows:
        mujoco.mj_resetData(task.model, data)
        data.qpos[7:] += rng.normal(0, 0.05, task.model.nq - 7)
        data.qvel[:] = rng.normal(0, 0.05, task.model.nv)
        mujoco.mj_getState(task.model, data, row, PHYSICS_SPEC)
    return rows


class Episodes:
    """Training episodes side by side, restarted when they end; all of their state can be saved.

    Args:
      rng: draws which episodes start standing.
    """

    def __init__(self, run: SacRun, rng: np.random.Generator):
        self._run, self._rng, self._task = run, rng, run.task
        settings = run.settings
        self.size, self._limit = settings.simulations, settings.train_episode_steps or run.task.max_steps
        self.batch = run.task.batch(self.size)
        if getattr(settings, "progress", 0):
            if not hasattr(self.batch, "track_paths"):
                raise DmcvbError(f"setting progress is for ant-maze tasks; {run.task.id} has no path to a goal")
            self.batch.track_paths()
        # The first episodes are cut short at different steps, so that ends do not fall together.
        self.elapsed = (np.arange(self.size) * self._limit) // self.size

    def start(self, ids: np.ndarray) -> np.ndarray:
        """Begin new episodes; (size, state) of all."""
        run = self._run
        numbers = run.step * self.size + ids  # never the same stream twice in a run
        names = (self._task.id, "training")
        self.batch.reset([episode_stream(run.config.seed, names, int(i), "initial_state") for i in numbers], ids)
        standing = ids[self._rng.random(len(ids)) < getattr(run.settings, "standing_starts", 0.0)]
        if len(standing):
            self.batch.set_physics(standing_states(self._task, self._rng, len(standing)), standing)
        return self.batch.state()

    def restart_ended(self, state: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        """Count a step; begin anew where the task, or the limit, ended an episode."""
        self.elapsed += 1
        ended = np.flatnonzero(terminated | (self.elapsed >= self._limit))
        if len(ended):
            state = self.start(ended)
            self.elapsed[ended] = 0
        return state

    def saved(self, state: np.ndarray) -> dict[str, torch.Tensor]:
        """The episodes where they are; `state` too, as touch sensors do not follow from the physics."""
        parts = {"physics": self.batch.physics(), "elapsed": self.elapsed, "state": state}
        return {name: torch.from_numpy(part.copy()) for name, part in parts.items()}

    def restore(self, saved: dict[str, torch.Tensor]) -> np.ndarray:
        """Put the episodes where they were; gives the state."""
        self.elapsed = saved["elapsed"].numpy().copy()
        self.batch.set_physics(saved["physics"].numpy())
        return saved["state"].numpy().copy()


class SacRun(Run):
    """A run of the package's own SAC."""

    def network(self) -> dict[str, Any]:
        return {"hidden": tuple(self.settings.actor_hidden)}

    def warmup(self) -> int:
        return 0 if self.config.init_from else self.settings.warmup_steps

    def _train(self, saved: dict[str, Any] | None, report: Report, tick: Tick) -> None:
        settings, task, config = self.settings, self.task, self.config
        learner = Sac(self.header, settings, config.seed)
        rows = max(min(settings.buffer_size, config.steps), settings.simulations)
        buffer = ReplayBuffer(rows, task.behaviour_size, task.action_size, self.folder / "resume")
        rng = np.random.default_rng([config.seed, 0xB0FF])
        owed, next_evaluation = 0.0, config.evaluate_every
        if saved:
            _fit(f"{self.folder} cannot be resumed", learner.load_state, saved["learner"])
            buffer.restore(saved["buffer"]["position"], saved["buffer"]["full"], saved["buffer"].get("size"))
            rng.bit_generator.state = json.loads(saved["rng"])
            next_evaluation = (self.step // config.evaluate_every + 1) * config.evaluate_every
            owed, next_evaluation = saved.get("owed", 0.0), saved.get("next_evaluation", next_evaluation)
        elif config.init_from:
            _start_from(learner, config.init_from)
        episodes = Episodes(self, rng)
        if saved and "episodes" in saved:
            state = episodes.restore(saved["episodes"])
        else:
            state = episodes.start(np.arange(settings.simulations))
        columns, shaping = task.behaviour_indices, shaping_of(task)
        last_saved = self._started

        def save() -> None:
            buffer.flush()
            self.save(
                {
                    "learner": learner.state(),
                    "buffer": {"position": buffer.position, "full": buffer.full, "size": buffer.size},
                    "rng": json.dumps(rng.bit_generator.state),
                    "episodes": episodes.saved(state),
                    "owed": owed,
                    "next_evaluation": next_evaluation,
                }
            )

        while self.step < config.steps:
            observation = state[:, columns].astype(np.float32)
            learner.norm.update(observation)
            if len(buffer) < settings.warmup_steps and not config.init_from:
                action = rng.uniform(-1, 1, (settings.simulations, task.action_size)).astype(np.float32)
            else:
                action = learner.act(observation)
            before = episodes.batch.path_length() if settings.progress else 0.0
            result = episodes.batch.step(action)
            reward = result.reward
            if settings.progress:
                reward = reward + settings.progress * (before - episodes.batch.path_length())
            if settings.shaping:
                reward = reward + settings.shaping * shaping(result.state)
            buffer.add(
                observation=observation,
                next_observation=result.state[:, columns].astype(np.float32),
                action=action,
                reward=reward,
                terminated=result.terminated,
            )
            self.step += settings.simulations
            state = episodes.restart_ended(result.state, result.terminated)
            learner.sync_norm()
            learner.sharpen(self.step)
            if len(buffer) >= settings.warmup_steps:
                owed += settings.updates_per_step * settings.simulations
                while owed >= 1:
                    learner.update(buffer.sample(rng, settings.batch_size))
                    owed -= 1
            tick(settings.simulations)
            if self.step >= min(next_evaluation, self.config.steps):
                progress = self.record(learner.actor.state_dict(), learner.updates, learner.metrics(), report)
                next_evaluation = self.next_evaluation(progress.evaluation, next_evaluation)
                if self._started - last_saved > SAVE_SECONDS:
                    save()
                    last_saved = self._started
        save()


def _fit(what: str, load: Callable[[Any], None], state: Any) -> None:
    """Load networks of another run, or say that their shapes differ."""
    try:
        load(state)
    except (RuntimeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DmcvbError(f"{what}: its networks do not fit these settings and task ({reason})") from None


def _start_from(learner: Sac, source: str) -> None:
    """Take networks and normalization from another run, or the actor alone from a policy file."""
    path = Path(source)
    if path.is_dir():
        saved, config = path / "resume" / "state.pt", read_config(path)
        if not config or config.algorithm != "sac" or not saved.exists():
            raise DmcvbError(f"--init-from {source}: no run of sac is saved there; give its folder or a policy file")
        _fit(f"--init-from {source}", learner.load_networks, torch.load(saved, weights_only=True)["learner"])
        return
    _fit(f"--init-from {source}", learner.actor.load_state_dict, load_policy(path).weights)
    learner.norm.mean = learner.actor.observation_mean.numpy().astype(float)
    learner.norm.count = 1e5
    learner.norm.m2 = learner.actor.observation_std.numpy().astype(float) ** 2 * learner.norm.count


def run_class(algorithm: str) -> type[Run]:
    """The kind of run that trains an algorithm."""
    if algorithm == "sac":
        return SacRun
    if algorithm == "guided":
        from dmcvb_gen.behaviours.guided import GuidedRun

        return GuidedRun
    from dmcvb_gen.behaviours.sb3 import Sb3Run

    return Sb3Run


def open_run(folder: str | Path, config: RunConfig, resume: bool) -> Run:
    """A run in a folder: a new one, or the one that is there with `resume`.

    Raises:
      DmcvbError: the folder holds another configuration, or a run and `resume` was not asked for; settings are
        unknown or wrong; there is too little room on the disk.
    """
    folder = Path(folder)
    check_settings(config.algorithm, config.settings)
    get_task(config.task)
    found = read_config(folder)
    if found:
        if not resume:
            raise DmcvbError(f"{folder} holds a run already; go on with --resume, or choose another --out")
        check_same(folder, found, config)
    elif folder.is_file() or (folder.exists() and any(folder.iterdir())):
        raise DmcvbError(f"{folder} is not empty and holds no run; choose another --out")
    if config.init_from and not Path(config.init_from).is_file() and not read_config(config.init_from):
        raise DmcvbError(f"--init-from {config.init_from} is neither a run folder nor a policy file")
    run = run_class(config.algorithm)(folder, config)
    if config.steps <= run.warmup():
        raise DmcvbError(
            f"{config.steps} steps are all warm-up ({run.warmup()} steps), nothing would be learned; give more --steps"
        )
    folder.mkdir(parents=True, exist_ok=True)
    if shutil.disk_usage(folder).free < 1e9:
        raise DmcvbError(f"less than 1 GB is free at {folder}; make room, a run needs it for its replay buffer")
    write_json_atomically(folder / "run.json", json.loads(json.dumps(dataclasses.asdict(config))))
    return run
