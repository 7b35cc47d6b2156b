"""Train a behaviour policy online on states, into a run folder of checkpoints.

The package's own SAC and MPO are trained here, Stable-Baselines3's algorithms in `sb3`; `open_run` gives the one that
is asked for. What a run folder holds is said in `runs`.
"""

from __future__ import annotations

import abc
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.state_file import STATE, read_state
from dmcvb_gen.storage.remote import local_path, storage_errors
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training.episodes import Episodes, shaping_of, useless_setting
from dmcvb_gen.training.networks import as_tensors
from dmcvb_gen.training.row_files import check_rows
from dmcvb_gen.training.runs import (
    Progress,
    ProgressCallback,
    Report,
    Run,
    RunConfig,
    check_same,
    command_of,
    policy_to_start_from,
    read_config,
)
from dmcvb_gen.training.sac import ReplayBuffer, ReplayLearner, Sac
from dmcvb_gen.training.settings import check_settings

__all__ = ["Progress", "Run", "RunConfig", "SacRun", "command_of", "open_run", "read_config"]


class ReplayRun(Run):
    """A run of one of the package's learners that learn from a replay buffer."""

    @abc.abstractmethod
    def learner(self) -> ReplayLearner:
        """A new learner."""

    def network(self) -> dict[str, Any]:
        return {"hidden": tuple(self.settings.actor_hidden)}

    def warmup(self) -> int:
        return self.settings.warmup_steps  # also from --init-from: then the policy's own steps fill the buffer

    def problem(self) -> str | None:
        settings = self.settings
        if settings.buffer_size < settings.warmup_steps:
            return (
                f"buffer_size {settings.buffer_size} holds fewer steps than warmup_steps {settings.warmup_steps}, so "
                "nothing would ever be learned; give --set buffer_size of at least that"
            )
        return self.too_few_updates(settings.warmup_steps, getattr(settings, "actor_every", 1))

    def _train(self, saved: dict[str, Any] | None, report: Report, tick: ProgressCallback) -> None:
        loop, next_evaluation = ReplayLoop(self, saved), self.config.evaluate_every
        if saved:
            next_evaluation = saved["next_evaluation"]

        def state() -> dict[str, Any]:
            return loop.state() | {"next_evaluation": next_evaluation}

        while self.step < self.config.steps:
            loop.collect()
            loop.learn()
            tick(self.settings.simulations)
            if self.step >= min(next_evaluation, self.config.steps):
                learner = loop.learner
                progress = self.record(learner.actor.state_dict(), learner.updates, learner.metrics(), report)
                next_evaluation = self.next_evaluation(progress.evaluation, next_evaluation)
            self.between_rounds(state)
        self.save(state())


class SacRun(ReplayRun):
    """A run of the package's own SAC."""

    def learner(self) -> Sac:
        return Sac(self.header, self.settings, self.config.seed)


class MpoRun(ReplayRun):
    """A run of the package's own MPO."""

    def learner(self) -> ReplayLearner:
        from dmcvb_gen.training.mpo import Mpo

        return Mpo(self.header, self.settings, self.config.seed)


class ReplayLoop:
    """Loop of a run: episodes fill the buffer and the learner learns from it; its state can be saved.

    Args:
      saved: `state()` to continue from; None at the start.
    """

    def __init__(self, run: ReplayRun, saved: dict[str, Any] | None):
        settings, task, config = run.settings, run.task, run.config
        self.run, self.learner = run, run.learner()
        rows = max(min(settings.buffer_size, config.steps), settings.simulations)
        sizes = (task.behaviour_size, task.action_size, settings.simulations)
        self.buffer = ReplayBuffer(rows, *sizes, run.folder / "resume")
        self.rng = np.random.default_rng([config.seed, 0xB0FF])
        self._owed = 0.0  # updates
        if saved:
            place = saved["buffer"]
            kept = {"owed", "episodes", "rng", "next_evaluation"} <= saved.keys() and "size" in place
            if not kept:
                raise DmcvbError(f"{run.folder} was trained by an earlier version; start again in another --out")
            check_rows(run.folder, self.buffer.found, place["position"], place["full"], min(place["size"], rows))
            _fit(f"{run.folder} cannot be resumed", self.learner.load_state, saved["learner"])
            self.buffer.restore(place["position"], place["full"], place["size"])
            self.rng.bit_generator.state = json.loads(saved["rng"])
            self._owed = saved["owed"]
        elif config.init_from:
            _start_from(self.learner, run, config.init_from)
        self.episodes = Episodes(run, self.rng)
        self._shaping = shaping_of(task) if settings.shaping else None
        if saved:
            self.observation = self.episodes.restore(saved["episodes"])
        else:
            self.observation = self.episodes.start(np.arange(settings.simulations))

    def state(self) -> dict[str, Any]:
        """Everything that the run continues from."""
        buffer = self.buffer
        buffer.flush()
        return {
            "learner": self.learner.state(),
            "buffer": {"position": buffer.position, "full": buffer.full, "size": buffer.size},
            "rng": json.dumps(self.rng.bit_generator.state),
            "episodes": self.episodes.saved(self.observation),
            "owed": self._owed,
        }

    def _action(self) -> np.ndarray:
        settings = self.run.settings
        if len(self.buffer) < settings.warmup_steps and not self.run.config.init_from:
            return self.rng.uniform(-1, 1, (settings.simulations, self.run.task.action_size)).astype(np.float32)
        return self.learner.act(self.observation)

    def collect(self) -> None:
        """One agent step of every simulation, into the buffer."""
        settings, batch, observation = self.run.settings, self.episodes.batch, self.observation
        self.learner.norm.update(observation)
        action = self._action()
        before = batch.path_length() if settings.progress else 0.0
        result = batch.step(self.run.task.from_unit(action))
        reward = result.reward
        if settings.progress:
            reward = reward + settings.progress * (before - batch.path_length())
        if self._shaping:
            reward = reward + settings.shaping * self._shaping(result.state)
        reached, ended = batch.behaviour_observation(), self.episodes.ending(result)
        self.learner.returns.update(reward, ended)
        self.buffer.add(
            observation=observation,
            next_observation=reached,
            action=action,
            reward=reward,
            terminated=result.terminated,
            ended=ended,
        )
        self.run.step += settings.simulations
        self.observation = self.episodes.restart_ended(reached, result)

    def learn(self) -> None:
        """Make the updates that are due after the steps so far."""
        settings = self.run.settings
        self.learner.begin_round(self.run.step)
        if len(self.buffer) < settings.warmup_steps:
            return
        half_life = getattr(settings, "n_step_half_life", 0)
        share = 1 / (1 + self.run.step / half_life) if half_life else 1.0
        self._owed += settings.updates_per_step * settings.simulations
        while self._owed >= 1:
            self.learner.update(
                self.buffer.sample_steps(self.rng, settings.batch_size, settings.n_step, settings.discount, share)
            )
            self._owed -= 1


def _fit(what: str, load: Callable[[Any], None], state: Any) -> None:
    """Load networks of another run, or say that their shapes differ."""
    try:
        load(state)
    except (RuntimeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DmcvbError(f"{what}: its networks do not fit these settings and task ({reason})") from None


def _start_from(learner: ReplayLearner, run: ReplayRun, source: str) -> None:
    """Take networks and normalization from another run, or the actor alone from a policy file."""
    path, algorithm = Path(source), run.config.algorithm
    if path.is_dir():
        config = read_config(path)
        saved = read_state(path) if config and config.algorithm == algorithm else None
        if not saved:
            raise DmcvbError(
                f"--init-from {source}: no run of {algorithm} is saved there; give its folder or a policy file"
            )
        _fit(f"--init-from {source}", learner.load_networks, saved["learner"])
        return
    _fit(f"--init-from {source}", learner.load_actor, as_tensors(policy_to_start_from(source, run.header).weights))
    learner.norm.mean = learner.actor.observation_mean.numpy().astype(float)
    learner.norm.count = 1e5
    learner.norm.m2 = learner.actor.observation_std.numpy().astype(float) ** 2 * learner.norm.count


def run_class(algorithm: str) -> type[Run]:
    """The kind of run that trains an algorithm."""
    if algorithm in ("sac", "mpo"):
        return {"sac": SacRun, "mpo": MpoRun}[algorithm]
    if algorithm == "guided":
        from dmcvb_gen.training.guided import GuidedRun

        return GuidedRun
    from dmcvb_gen.training.sb3 import Sb3Run

    return Sb3Run


def _digest(path: str | None) -> str | None:
    """Return the digest of the policy file that a run starts from; None if it starts from none."""
    return sha256_file(path) if path and Path(path).is_file() else None


def open_run(folder: str | Path, config: RunConfig, resume: bool) -> Run:
    """A run in a folder: a new one, or the one that is there with `resume`.

    Raises:
      DmcvbError: the folder holds another configuration, or a run and `resume` was not asked for; settings are
        unknown or wrong; there is too little room on the disk.
    """
    folder = local_path(folder)
    check_settings(config.algorithm, config.settings)
    get_task(config.task)
    found = read_config(folder)
    if found:
        if not resume:
            raise DmcvbError(f"{folder} holds a run already; go on with --resume, or choose another --out")
        check_same(folder, found, config)
    elif folder.is_file() or (folder.exists() and any(folder.iterdir())):
        raise DmcvbError(f"{folder} is not empty and holds no run; choose another --out")
    begun = found is not None and (folder / "resume" / STATE).exists()  # never reads again what it started from
    if config.init_from and not begun and not Path(config.init_from).is_file() and not read_config(config.init_from):
        raise DmcvbError(f"--init-from {config.init_from} is neither a run folder nor a policy file")
    digest = _digest(config.init_from)
    if found and not begun and digest and found.init_sha256 not in (None, digest):
        raise DmcvbError(f"{config.init_from} is no longer the file that {folder} began with; choose another --out")
    config = dataclasses.replace(config, init_sha256=found.init_sha256 if found else digest)
    run = run_class(config.algorithm)(folder, config)
    if problem := useless_setting(run.task, run.settings):
        raise DmcvbError(problem)
    if config.steps <= run.warmup():
        raise DmcvbError(
            f"{config.steps} steps are all warm-up ({run.warmup()} steps), nothing would be learned; give more "
            f"--steps, or less warm-up: --set {run.warmup_setting}=N"
        )
    if problem := run.problem():
        raise DmcvbError(problem)
    if config.init_from and not begun and isinstance(run, ReplayRun):
        _start_from(run.learner(), run, config.init_from)  # refused before anything is written
    with storage_errors(folder, "write to"):
        folder.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(folder).free < 1e9:
            raise DmcvbError(f"less than 1 GB is free at {folder}; make room, a run needs it for its replay buffer")
        if not found:  # a run that goes on writes it once it is alone in the folder
            run.write_config()
    return run
