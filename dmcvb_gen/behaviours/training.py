"""Training a behaviour policy online on states: task and settings in, a run folder of checkpoints out.

A run folder holds `run.json` (what is trained, never changed), `checkpoints/<agent step>.safetensors`
(a policy file an evaluation), `progress.csv`, and `resume/` (learner, replay buffer,
random states), from which a killed run goes on.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import shlex
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from dmcvb_gen.behaviours.evaluation import evaluate
from dmcvb_gen.behaviours.paper import paper_returns
from dmcvb_gen.behaviours.policy_file import Evaluation, Policy, PolicyHeader, load_policy, save_policy
from dmcvb_gen.behaviours.sac import ReplayBuffer, Sac, SacSettings
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.store.manifest import environment, write_json_atomically
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import PHYSICS_SPEC, Task

EVALUATION_EPISODES = 20
"""Episodes of the evaluations along the way; selection evaluates its picks again on 100."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What a run trains; written once to run.json, a resumed run must have the same.

    Attributes:
      evaluate_every: agent steps between evaluations (and policy files) while the return is low, where medium and
        mixed checkpoints are picked from.
      evaluate_sparse: the same once 60 % of the paper's expert return is reached.
      init_from: policy file or run whose actor, critics and normalization it starts from.
    """

    task: str
    algorithm: str
    steps: int
    seed: int
    settings: dict[str, Any]
    evaluate_every: int = 2_000
    evaluate_sparse: int = 10_000
    init_from: str | None = None


@dataclasses.dataclass(frozen=True)
class Progress:
    """One evaluation along the way."""

    step: int
    evaluation: Evaluation
    seconds: float
    steps_per_second: float


def command_of(config: RunConfig) -> str:
    """The command line that trains this run again."""
    parts = [f"dmcvb-gen train-behaviour {config.task} --algo {config.algorithm} --steps {config.steps}"]
    parts.append(f"--seed {config.seed}")
    parts.append(f"--evaluate-every {config.evaluate_every}")
    if config.init_from:
        parts.append(f"--init-from {shlex.quote(config.init_from)}")
    pairs = (f"{name}={json.dumps(value)}" for name, value in sorted(config.settings.items()))
    parts += [f"--set {shlex.quote(pair)}" for pair in pairs]
    return " ".join(parts)


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


class Run:
    """A SAC run in a folder; `Run(...).train()` starts or goes on."""

    def __init__(self, folder: Path, config: RunConfig):
        self.folder, self.config = Path(folder), config
        self.task = get_task(config.task)
        self.settings = SacSettings(**config.settings)
        self.header = PolicyHeader(
            task=self.task.id,
            observation_size=self.task.behaviour_size,
            action_size=self.task.action_size,
            algorithm=config.algorithm,
            agent_step=0,
            hidden=tuple(self.settings.actor_hidden),
            training={
                "settings": dataclasses.asdict(self.settings),
                "seed": config.seed,
                "init_from": config.init_from,
                "environment": environment(),
            },
            command=command_of(config),
        )
        self.step, self.seconds = 0, 0.0

    def train(self, report: Callable[[Progress], None] = lambda progress: None, tick=lambda steps: None) -> None:
        """Train until `config.steps` agent steps; told of every evaluation and of every few steps."""
        settings, task, config = self.settings, self.task, self.config
        learner = Sac(self.header, settings, config.seed)
        resume = self.folder / "resume"
        (self.folder / "checkpoints").mkdir(parents=True, exist_ok=True)
        resume.mkdir(exist_ok=True)
        buffer_size = min(settings.buffer_size, config.steps)
        buffer = ReplayBuffer(buffer_size, task.behaviour_size, task.action_size, resume)
        rng = np.random.default_rng([config.seed, 0xB0FF])
        if (resume / "state.pt").exists():
            self._load(learner, buffer, rng)
            tick(self.step)
        elif config.init_from:
            _start_from(learner, config.init_from)
        batch = task.batch(settings.simulations)
        columns, shaping = task.behaviour_indices, shaping_of(task)
        episodes = np.zeros(settings.simulations, int)

        def generator(simulation: int) -> np.random.Generator:
            episode = self.step * settings.simulations + simulation  # never the same stream twice in a run
            return episode_stream(config.seed, (task.id, "training"), episode, "initial_state")

        def start(ids: np.ndarray) -> np.ndarray:
            batch.reset([generator(int(i)) for i in ids], ids)
            standing = ids[rng.random(len(ids)) < settings.standing_starts]
            if len(standing):
                batch.set_physics(standing_states(task, rng, len(standing)), standing)
            return batch.state()

        limit = settings.train_episode_steps or task.max_steps
        state = start(np.arange(settings.simulations))
        # The first episodes are cut short at different steps, so that ends do not fall together.
        elapsed = (np.arange(settings.simulations) * limit) // settings.simulations
        owed, since_saved, started = 0.0, time.time(), time.time()
        expected = (paper_returns(task.id, "expert") or {"mean": 0.0})["mean"]
        next_evaluation = (self.step // config.evaluate_every + 1) * config.evaluate_every
        while self.step < config.steps:
            observation = state[:, columns].astype(np.float32)
            learner.norm.update(observation)
            if len(buffer) < settings.warmup_steps and not config.init_from:
                action = rng.uniform(-1, 1, (settings.simulations, task.action_size)).astype(np.float32)
            else:
                action = learner.act(observation)
            result = batch.step(action)
            elapsed += 1
            reward = result.reward
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
            state = result.state
            ended = np.flatnonzero(result.terminated | (elapsed >= limit))
            if len(ended):
                episodes[ended] += 1
                state = start(ended)
                elapsed[ended] = 0
            learner.sync_norm()
            if len(buffer) >= settings.warmup_steps:
                owed += settings.updates_per_step * settings.simulations
                while owed >= 1:
                    learner.update(buffer.sample(rng, settings.batch_size))
                    owed -= 1
            tick(settings.simulations)
            if self.step >= next_evaluation:
                now = time.time()
                self.seconds += now - started
                progress = self._evaluate(learner)
                report(progress)
                started = time.time()  # evaluations are not training time
                low = expected <= 0 or progress.evaluation.mean < 0.6 * expected
                next_evaluation = self.step + (config.evaluate_every if low else config.evaluate_sparse)
                if time.time() - since_saved > 240 or self.step >= config.steps:
                    self._save(learner, buffer, rng)
                    since_saved = time.time()
        self._save(learner, buffer, rng)

    def _evaluate(self, learner: Sac) -> Progress:
        header = self.header.model_copy(update={"agent_step": self.step})
        learner.actor.header = header
        weights = {name: value.clone() for name, value in learner.actor.state_dict().items()}
        actor = type(learner.actor)(header)
        actor.load_state_dict(weights)
        evaluation, _ = evaluate(Policy(header, actor, ""), self.task, EVALUATION_EPISODES, seed=self.step)
        header = header.model_copy(
            update={
                "evaluation": evaluation,
                "training": header.training | {"seconds": round(self.seconds, 1)},
            }
        )
        save_policy(self.folder / "checkpoints" / f"{self.step:010d}.safetensors", header, weights)
        progress = Progress(self.step, evaluation, self.seconds, self.step / max(self.seconds, 1e-9))
        path = self.folder / "progress.csv"
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(["step", "seconds", "return_mean", "return_std", "success", "alpha", "updates"])
            writer.writerow(
                [
                    self.step,
                    round(self.seconds, 1),
                    round(evaluation.mean, 3),
                    round(evaluation.std, 3),
                    "" if evaluation.success is None else evaluation.success,
                    round(float(learner.log_alpha.detach().exp()), 5),
                    learner.updates,
                ]
            )
        return progress

    def _save(self, learner: Sac, buffer: ReplayBuffer, rng: np.random.Generator) -> None:
        for array in buffer.arrays.values():
            array.flush()
        state = {
            "learner": learner.state(),
            "buffer": {"position": buffer.position, "full": buffer.full},
            "rng": json.dumps(rng.bit_generator.state),
            "step": self.step,
            "seconds": self.seconds,
        }
        path = self.folder / "resume" / "state.pt"
        temporary = path.with_suffix(".partial")
        try:
            torch.save(state, temporary)
            temporary.replace(path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise DmcvbError(
                f"cannot save the run in {self.folder}: {error.strerror or error}; the previous checkpoint is whole, "
                "make room and use --resume"
            ) from None

    def _load(self, learner: Sac, buffer: ReplayBuffer, rng: np.random.Generator) -> None:
        state = torch.load(self.folder / "resume" / "state.pt", weights_only=True)  # tensors and numbers only
        learner.load_state(state["learner"])
        buffer.position, buffer.full = state["buffer"]["position"], state["buffer"]["full"]
        rng.bit_generator.state = json.loads(state["rng"])
        self.step, self.seconds = state["step"], state["seconds"]


def _start_from(learner: Sac, source: str) -> None:
    """Take actor, critics and normalization from another run (or the actor alone from a policy file)."""
    path = Path(source)
    if path.is_dir():
        state_path = path / "resume" / "state.pt"
        if not state_path.exists():
            raise DmcvbError(f"--init-from {source}: no run is saved there; give a run folder or a policy file")
        state = torch.load(state_path, weights_only=True)["learner"]
        learner.load_state(state)
        return
    learner.actor.load_state_dict(load_policy(path).weights)
    learner.norm.mean = learner.actor.observation_mean.numpy().astype(float)
    learner.norm.count = 1e5
    learner.norm.m2 = learner.actor.observation_std.numpy().astype(float) ** 2 * learner.norm.count


def open_run(folder: str | Path, config: RunConfig, resume: bool) -> Run:
    """A run in a folder: a new one, or the one that is there with `resume`.

    Raises:
      DmcvbError: the folder holds another configuration, or a run and `resume` was not asked for.
    """
    folder = Path(folder)
    path = folder / "run.json"
    asked = json.loads(json.dumps(dataclasses.asdict(config)))
    if path.exists():
        found = json.loads(path.read_text())
        if not resume:
            raise DmcvbError(f"{folder} holds a run already; go on with --resume, or choose another --out")
        different = [key for key in asked if key != "steps" and found.get(key) != asked[key]]
        if different:
            key = different[0]
            raise DmcvbError(
                f"{folder} holds a run with {key} {found.get(key)!r}, asked for {asked[key]!r}; "
                "choose another --out, or repeat its settings"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise DmcvbError(f"{folder} is not empty and holds no run; choose another --out")
    folder.mkdir(parents=True, exist_ok=True)
    if shutil.disk_usage(folder).free < 1e9:
        raise DmcvbError(f"less than 1 GB is free at {folder}; make room, a run needs it for its replay buffer")
    write_json_atomically(path, asked)
    return Run(folder, config)
