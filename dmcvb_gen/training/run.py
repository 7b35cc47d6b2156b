"""A run's folder: its configuration, log, checkpoints and the state that it resumes from, whatever trains it.

A run folder holds

    run.json                              what is trained; only its number of steps changes
    checkpoints/<agent step>.safetensors  a policy file an evaluation, and one where the run was stopped
    progress.jsonl                        a line an evaluation
    resume/state.safetensors              learner, replay buffer, simulations, random states
    selected/, selection.json, curve.png  written by the selection

The state is saved at the start, every ten minutes, at Ctrl-C and at the end, aside and renamed, so that a process that
dies or a disk that fills up leaves the previous one. What was logged after it is dropped when a run goes on, and made
again: with the same versions of torch and numpy, the same processor and one thread, a run of the package's own
algorithms that was stopped or killed gives the same bits as one that never was, unless its task is of one's own and
keeps a state in Python.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shlex
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import torch

from dmcvb_gen.dataset.environment import environment
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import remove_partial, sha256_file, write_bytes, write_json, write_text
from dmcvb_gen.parallel import ignore
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.bundled import checkpoints
from dmcvb_gen.policies.evaluation import evaluate
from dmcvb_gen.policies.header import Evaluation, PolicyHeader
from dmcvb_gen.policies.policy_file import load_policy, save_policy
from dmcvb_gen.spec import ANT_MAZE, LOCOMOTION, is_maze
from dmcvb_gen.state_file import STATE, pack_state, read_state_file
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training.episodes import check_settings_fit
from dmcvb_gen.training.networks import as_arrays, as_tensors
from dmcvb_gen.training.settings import algorithm_module, check_settings

LOG = "progress.jsonl"
EVALUATION_EPISODES = 20
"""Episodes of an evaluation along the way, at most; selection evaluates its picks again on 100."""
EVALUATION_STEPS = {LOCOMOTION: 8.0, ANT_MAZE: 4.0}
"""Agent steps simulated in evaluations for each one trained, at most: about a fifth of a run's time. Counted in steps,
not in seconds, so that a run gives the same bits however busy its machine is."""
SAVE_SECONDS = 600
"""Seconds after which the state to resume from is saved again: a process that is killed loses these."""

Weights = Mapping[str, torch.Tensor]
Report = Callable[[Evaluation], Any]


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Config of a run, in its run.json; a run that goes on must have the same, but for its steps.

    Attributes:
      steps: agent steps (at action repeat 2) to train; a resumed run may have more.
      evaluate_every: agent steps between evaluations, and so between checkpoints.
      init_from: policy file or run whose actor, critics and normalization it starts from.
      init_sha256: of that file, if it is a file.
    """

    task: str
    algorithm: str
    steps: int
    seed: int
    settings: dict[str, Any]
    evaluate_every: int = 2_000
    init_from: str | None = None
    init_sha256: str | None = None

    @property
    def init_name(self) -> str | None:
        """Return the last name of the path that a run starts from; the rest is private to the machine."""
        return self.init_from and Path(os.path.abspath(self.init_from)).name


class Stopped(DmcvbError):
    """A run that was asked to stop, and that saved all it had."""


def command_of(config: RunConfig) -> str:
    """The command line that trains this run again."""
    parts = [f"dmcvb-gen train-behaviour {shlex.quote(config.task)} --algo {config.algorithm} --steps {config.steps}"]
    parts += [f"--seed {config.seed}", f"--evaluate-every {config.evaluate_every}"]
    if config.init_from:
        parts.append(f"--init-from {shlex.quote(config.init_from)}")
    pairs = (f"{name}={json.dumps(value)}" for name, value in sorted(config.settings.items()))
    parts += [f"--set {shlex.quote(pair)}" for pair in pairs]
    return " ".join(parts)


def read_config(folder: str | Path) -> RunConfig | None:
    """Return the config of the run in a folder; None if there is no run.

    Raises:
      DmcvbError: run.json is damaged, or an older version's.
    """
    path = Path(folder) / "run.json"
    if not path.exists():
        return None
    try:
        return RunConfig(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise DmcvbError(
            f"{path} is not a run's configuration ({error}); choose another --out, or go on with "
            "the version that began it"
        ) from None


def read_state(folder: str | Path) -> dict[str, Any] | None:
    """Read the state that a run saved in its folder; None if it has saved nothing yet.

    Raises:
      DmcvbError: the file is damaged.
    """
    path = Path(folder) / "resume" / STATE
    return read_state_file(path, "start over with another --out") if path.exists() else None


def read_rows(folder: str | Path) -> list[dict[str, Any]]:
    """The lines of a run's log; without one that a killed process left half written, or that is being written.

    A line has step (agent steps), seconds (of training), updates (of gradients), return_mean and return_std, of mazes
    success and speed, and the learner's own numbers.
    """
    path, rows = Path(folder) / LOG, []
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(ValueError):
            rows.append(json.loads(line))
    return rows


def check_same(folder: Path, found: RunConfig, asked: RunConfig) -> None:
    """Refuse to mix two configurations in one folder; only `steps` may differ.

    Settings are compared with their defaults filled in, so that naming a default is no difference.
    """
    was, now = (
        dataclasses.asdict(dataclasses.replace(config, steps=0, init_sha256=None, settings={}))
        | dataclasses.asdict(check_settings(config.algorithm, config.settings))
        for config in (found, asked)
    )
    for name in was | now:
        if was.get(name) != now.get(name):
            raise DmcvbError(
                f"{folder} holds a run with {name} {was.get(name)!r}, asked for {now.get(name)!r}; "
                "choose another --out, or repeat its settings"
            )


class Run:
    """A run in a folder; `train` starts it or goes on.

    Attributes:
      settings: the algorithm's checked settings.
      header: header of its policy files, without evaluation and agent step.
      step: agent steps so far.
      seconds: seconds of training so far, without evaluations.
      tick: called with the agent steps made since the last call.
      episodes_at_most, evaluation_steps: of an evaluation; agent steps simulated in evaluations for each one trained.
    """

    def __init__(self, folder: str | Path, config: RunConfig):
        self.folder, self.config = Path(folder), config
        self.task = get_task(config.task)
        self.algorithm = algorithm_module(config.algorithm)
        self.settings = check_settings(config.algorithm, config.settings)
        self.evaluation_steps = getattr(self.algorithm, "EVALUATION_STEPS", EVALUATION_STEPS[self.task.family])
        self.episodes_at_most = EVALUATION_EPISODES * getattr(self.algorithm, "TIMES_MORE_EPISODES", 1)
        network = self.algorithm.network(self)
        training = {"settings": dataclasses.asdict(self.settings), "seed": config.seed, "init_from": config.init_name}
        if config.init_sha256:
            training["init_sha256"] = config.init_sha256
        self.header = PolicyHeader(
            task=self.task.id,
            observation=self.task.observation,
            observation_size=self.task.behaviour_size,
            action_size=self.task.action_size,
            algorithm=config.algorithm,
            agent_step=0,
            training=training | {"environment": environment()} | network.pop("training", {}),
            command=command_of(dataclasses.replace(config, init_from=config.init_name)),
            **network,
        )
        self.step, self.seconds, self._step_before = 0, 0.0, 0
        self._began = self._last_saved = time.time()
        self._asked_to_stop = False
        self._report: Report = ignore
        self.tick: Callable[[int], Any] = ignore

    @property
    def begun(self) -> bool:
        """True if there is a state to resume from; such a run never reads again what it started from."""
        return (self.folder / "resume" / STATE).exists()

    def saved(self) -> dict[str, Any] | None:
        """The state to resume from (tensors, numbers and texts only), None if nothing is saved yet."""
        return read_state(self.folder)

    # -- what callers use -------------------------------------------------------------------

    def train(
        self, report: Report = ignore, tick: Callable[[int], Any] = ignore, stopping: Callable[[], Any] = ignore
    ) -> None:
        """Train until `config.steps` agent steps, or until Ctrl-C or SIGTERM, which save the run.

        Args:
          report: called with every evaluation.
          tick: called with the agent steps made since the last call.
          stopping: called when a signal asks the run to stop; it saves after the step that it is at.

        Raises:
          Stopped: a signal asked for it; everything is saved.
          DmcvbError: another process trains in the folder, or its disk is full (the last saved state is whole).
        """
        self._report, self.tick = report, tick
        with self._alone():
            self.write_config()
            saved = self.saved()
            if not saved and checkpoints(self.folder):
                raise DmcvbError(
                    f"{self.folder} has checkpoints, but nothing to resume from (resume/{STATE} is gone); choose "
                    "another --out"
                )
            self.step, self.seconds = (saved["step"], saved["seconds"]) if saved else (0, 0.0)
            self._drop_what_came_later()
            self._began = self._last_saved = time.time()
            with self._stopping_on_signals(stopping):
                self.algorithm.train(self)

    def write_config(self) -> None:
        """Write run.json."""
        write_json(self.folder / "run.json", json.loads(json.dumps(dataclasses.asdict(self.config))))

    def resume_command(self) -> str:
        """The command line that resumes this run; a maze of one's own has a long name."""
        what = [] if is_maze(self.config.task) else [self.config.task]
        return shlex.join(["dmcvb-gen", "train-behaviour", *what, "--out", str(self.folder), "--resume"])

    # -- what algorithms use ----------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Count agent steps that were just made."""
        self._step_before, self.step = self.step, self.step + steps
        self.tick(steps)

    def evaluation_is_due(self) -> bool:
        """True if the last steps passed a multiple of `evaluate_every`, or the end."""
        every = self.config.evaluate_every
        return self.step >= self.config.steps or self.step // every > self._step_before // every

    def record(self, weights: Weights, updates: int, metrics: Mapping[str, float]) -> None:
        """Evaluate the actor's `weights`, write them as a checkpoint, log; evaluations are not training time."""
        self.seconds += time.time() - self._began
        policy = Policy(self.header, as_arrays(weights), "")
        evaluation = evaluate(policy, self.task, self.evaluation_episodes(), seed=self.step)
        self._write_checkpoint(policy, evaluation)
        row = {"step": self.step, "seconds": round(self.seconds, 1), "updates": updates}
        row |= {"return_mean": evaluation.mean, "return_std": evaluation.std}
        row |= {"success": evaluation.success, "speed": evaluation.speed, **metrics}
        with (self.folder / LOG).open("a") as file:
            file.write(json.dumps({name: value for name, value in row.items() if value is not None}) + "\n")
        self._report(evaluation)
        self._began = time.time()

    def evaluation_episodes(self) -> int:
        """Episodes of an evaluation, so that all keep to their share of the steps."""
        fit = self.evaluation_steps * self.config.evaluate_every / self.task.max_steps
        return int(np.clip(fit, 1, self.episodes_at_most))

    def save(self, state: dict[str, Any]) -> None:
        """Put the state to resume from in place of the previous one, whole or not at all."""
        seconds = self.seconds + time.time() - self._began
        write_bytes(self.folder / "resume" / STATE, pack_state(state | {"step": self.step, "seconds": seconds}))
        self._last_saved = time.time()

    def checkpoint_if_due(self, state: Callable[[], dict[str, Any]], weights: Callable[[], Weights]) -> None:
        """Save the run if it is time to, or if it was asked to stop; called where a resumed run can begin.

        Args:
          state: gives what `save` takes. weights: gives the actor's weights.

        Raises:
          Stopped: it was asked to stop; its state is saved, and a checkpoint of this step is there.
        """
        if not self._asked_to_stop:
            if time.time() - self._last_saved > SAVE_SECONDS:
                self.save(state())
            return
        self.save(state())
        if not self._checkpoint(self.step).exists():
            self._write_checkpoint(Policy(self.header, as_arrays(weights()), ""), None)
        command = f"--behaviour {shlex.quote(str(self.folder))}@latest"
        raise Stopped(
            f"stopped at step {self.step:,}, and saved; resume: {self.resume_command()}; "
            f"{command} takes this checkpoint"
        )

    # -- the folder -------------------------------------------------------------------------

    def _checkpoint(self, step: int) -> Path:
        return self.folder / "checkpoints" / f"{step:010d}.safetensors"

    def _write_checkpoint(self, policy: Policy, evaluation: Evaluation | None) -> None:
        trained = policy.header.training | {"seconds": round(self.seconds, 1)}
        facts = {"agent_step": self.step, "evaluation": evaluation, "training": trained}
        save_policy(self._checkpoint(self.step), policy.header.model_copy(update=facts), policy.weights)

    def _drop_what_came_later(self) -> None:
        kept = [row for row in read_rows(self.folder) if row["step"] <= self.step]
        write_text(self.folder / LOG, "".join(json.dumps(row) + "\n" for row in kept))
        for step, path in checkpoints(self.folder).items():
            if step > self.step:
                path.unlink()
        for folder in (".", "checkpoints", "resume"):
            remove_partial(self.folder / folder)

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """One process a folder; the lock ends with the process, however that ends."""
        try:
            for name in ("checkpoints", "resume"):
                (self.folder / name).mkdir(parents=True, exist_ok=True)
            with filelock.FileLock(self.folder / "resume" / "lock", timeout=0):
                yield
        except filelock.Timeout:
            raise DmcvbError(f"another process trains in {self.folder}; wait for it, or choose another --out") from None
        except OSError as error:
            raise DmcvbError(
                f"cannot write the run in {self.folder}: {error.strerror or error}; the previous saved state is whole, "
                "make room and go on with --resume"
            ) from None

    @contextlib.contextmanager
    def _stopping_on_signals(self, stopping: Callable[[], Any]) -> Iterator[None]:
        """Ctrl-C and SIGTERM ask the run to stop; more of them change nothing, so a save is never cut off."""

        def stop(*_: Any) -> None:
            if not self._asked_to_stop:
                stopping()
            self._asked_to_stop = True

        in_main = threading.current_thread() is threading.main_thread()  # another thread gets no signals
        numbers = (signal.SIGINT, signal.SIGTERM) if in_main else ()
        before = {number: signal.signal(number, stop) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def start_from(learner: Any, run: Run) -> None:
    """Take networks and normalization of the run that `init_from` names, or the actor alone of a policy file.

    Raises:
      DmcvbError: their shapes differ, the policy's network computes something else, or nothing is saved there.
    """
    source = str(run.config.init_from)
    try:
        if Path(source).is_dir():
            config, saved = read_config(source), read_state(source)
            if not (config and saved and config.algorithm == run.config.algorithm):
                raise DmcvbError(
                    f"--init-from {source}: no run of {run.config.algorithm} is saved there; give its folder or a "
                    "policy file"
                )
            return learner.load_networks(saved["learner"])
        policy = load_policy(source)
        for name in ("activation", "clip_observation"):
            own, expected = getattr(policy.header, name), getattr(run.header, name)
            if own != expected:
                raise RuntimeError(f"{name} {own}, expected {expected}")
        learner.load_actor(as_tensors(policy.weights))
    except (RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DmcvbError(f"--init-from {source}: its networks do not fit these settings and task ({reason})") from None


def open_run(folder: str | Path, config: RunConfig, resume: bool) -> Run:
    """A run in a folder: a new one, or the one that is there with `resume`.

    Raises:
      DmcvbError: the folder holds another configuration, or a run and `resume` was not asked for; settings are
        unknown or wrong.
    """
    folder = local_path(folder)
    found = read_config(folder)
    if found:
        if not resume:
            raise DmcvbError(f"{folder} holds a run already; go on with --resume, or choose another --out")
        check_same(folder, found, config)
    elif folder.is_file() or (folder.exists() and any(folder.iterdir())):
        raise DmcvbError(f"{folder} is not empty and holds no run; choose another --out")
    source = Path(config.init_from) if config.init_from and not found else None
    if source and not source.is_file() and not read_config(source):
        raise DmcvbError(f"--init-from {source} is neither a run folder nor a policy file")
    digest = found.init_sha256 if found else sha256_file(source) if source and source.is_file() else None
    run = Run(folder, dataclasses.replace(config, init_sha256=digest))
    check_settings_fit(run.task, run.settings)
    run.algorithm.check(run)
    with storage_errors(folder, "write to"):
        folder.mkdir(parents=True, exist_ok=True)
        if not found:  # a run that goes on writes it once it is alone in the folder
            run.write_config()
    return run
