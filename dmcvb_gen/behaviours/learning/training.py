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

import numpy as np
import torch

from dmcvb_gen.behaviours.learning.episodes import Episodes, shaping_of
from dmcvb_gen.behaviours.learning.networks import as_tensors
from dmcvb_gen.behaviours.learning.runs import (
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
from dmcvb_gen.behaviours.learning.sac import ReplayBuffer, Sac
from dmcvb_gen.behaviours.learning.settings import check_settings
from dmcvb_gen.behaviours.policies.policy_file import load_policy
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.store.manifest import write_json_atomically
from dmcvb_gen.tasks import get_task

__all__ = ["Progress", "Run", "RunConfig", "SacRun", "command_of", "open_run", "read_config"]


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
            observation = episodes.restore(saved["episodes"])
        else:
            observation = episodes.start(np.arange(settings.simulations))
        shaping = shaping_of(task)
        last_saved = self._started

        def save() -> None:
            buffer.flush()
            self.save(
                {
                    "learner": learner.state(),
                    "buffer": {"position": buffer.position, "full": buffer.full, "size": buffer.size},
                    "rng": json.dumps(rng.bit_generator.state),
                    "episodes": episodes.saved(observation),
                    "owed": owed,
                    "next_evaluation": next_evaluation,
                }
            )

        while self.step < config.steps:
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
            reached = episodes.batch.behaviour_observation()
            buffer.add(
                observation=observation,
                next_observation=reached,
                action=action,
                reward=reward,
                terminated=result.terminated,
            )
            self.step += settings.simulations
            observation = episodes.restart_ended(reached, result.terminated)
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
    _fit(f"--init-from {source}", learner.actor.load_state_dict, as_tensors(load_policy(path).weights))
    learner.norm.mean = learner.actor.observation_mean.numpy().astype(float)
    learner.norm.count = 1e5
    learner.norm.m2 = learner.actor.observation_std.numpy().astype(float) ** 2 * learner.norm.count


def run_class(algorithm: str) -> type[Run]:
    """The kind of run that trains an algorithm."""
    if algorithm == "sac":
        return SacRun
    if algorithm == "guided":
        from dmcvb_gen.behaviours.learning.guided import GuidedRun

        return GuidedRun
    from dmcvb_gen.behaviours.learning.sb3 import Sb3Run

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
