"""Run folders: what every training run has, whatever trains it.

A run folder holds

    run.json                              what is trained; only its number of steps changes
    checkpoints/<agent step>.safetensors  a policy file an evaluation, thinned if there are many
    progress.csv, tensorboard/            a row, a point an evaluation
    resume/                               learner, replay buffer, simulations, random states: a killed run goes on
    selected/, selection.json, curve.png  written by the selection

The saved state is written aside and renamed, so that a process that dies, or a disk that fills up, leaves the
previous one. All that was logged after the saved state is dropped when a run goes on from it, and made again: with
the same versions of torch and numpy, the same processor and one thread, a run that was killed and resumed gives the
same bits as one that never was, as long as its replay buffer did not wrap around between save and kill (the rows
written over by then are newer ones of the same run).
"""

from __future__ import annotations

import abc
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

from dmcvb_gen.dataset.manifest import environment, write_json_atomically
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import write_bytes
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.evaluation import evaluate
from dmcvb_gen.policies.header import Evaluation, PolicyHeader
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.policies.policy_file import load_policy, save_policy
from dmcvb_gen.spec import ANT_MAZE, LOCOMOTION, MazeName
from dmcvb_gen.state_file import STATE, pack_state, read_state
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training.networks import as_arrays
from dmcvb_gen.training.pruning import prunable_checkpoints
from dmcvb_gen.training.run_log import RunLog, read_rows
from dmcvb_gen.training.settings import check_settings

EVALUATION_EPISODES = 20
"""Episodes of an evaluation along the way, at most; selection evaluates its picks again on 100."""
EVALUATION_STEPS = {LOCOMOTION: 8.0, ANT_MAZE: 4.0}
"""Agent steps simulated in evaluations for each one trained, at most: about a fifth of a run's time. Counted in steps,
not in seconds, so that a run gives the same bits however busy its machine is."""
DENSE_SHARE = 0.2
"""Share of the way from the paper's medium return to its expert's below which evaluations are dense: medium and mixed
are picked from there."""
RISEN = 5
"""Evaluations whose median must be above that."""
SAVE_SECONDS = 30
"""Seconds after which the state to resume from is saved again: a process that is killed loses these, and at most the
evaluation that it was at."""

FREE = ("steps", "settings", "init_sha256")
"""Fields of a run's configuration in which one that goes on need not be written as it was."""

Report = Callable[["Progress"], None]
ProgressCallback = Callable[[int], Any]


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Config of a run, in its run.json; a run that goes on must have the same, but for `FREE`.

    Attributes:
      steps: agent steps (at action repeat 2) to train; a resumed run may have more.
      evaluate_every: agent steps between evaluations (and policy files) while the return is low, where medium and
        mixed checkpoints are picked from.
      evaluate_sparse: the same once a fifth of the way from the paper's medium return to its expert's is behind.
      init_from: policy file or run whose actor, critics and normalization it starts from.
      init_sha256: of that file as it was when the run began, if it is a file.
    """

    task: str
    algorithm: str
    steps: int
    seed: int
    settings: dict[str, Any]
    evaluate_every: int = 2_000
    evaluate_sparse: int = 10_000
    init_from: str | None = None
    init_sha256: str | None = None

    @property
    def init_name(self) -> str | None:
        """Return the last name of the path that a run starts from; the rest is private to the machine."""
        return self.init_from and Path(os.path.abspath(self.init_from)).name


@dataclasses.dataclass(frozen=True)
class Progress:
    """One evaluation along the way; seconds are of training, evaluations left out."""

    step: int
    evaluation: Evaluation
    seconds: float
    steps_per_second: float
    updates_per_second: float = 0.0


class Stopped(DmcvbError):
    """A run that was asked to stop, and that saved all it had."""


def command_of(config: RunConfig) -> str:
    """The command line that trains this run again."""
    parts = [f"dmcvb-gen train-behaviour {shlex.quote(config.task)} --algo {config.algorithm} --steps {config.steps}"]
    parts.append(f"--seed {config.seed}")
    parts.append(f"--evaluate-every {config.evaluate_every}")
    if config.init_from:
        parts.append(f"--init-from {shlex.quote(config.init_from)}")
    pairs = (f"{name}={json.dumps(value)}" for name, value in sorted(config.settings.items()))
    parts += [f"--set {shlex.quote(pair)}" for pair in pairs]
    return " ".join(parts)


def policy_to_start_from(source: str | Path, header: PolicyHeader) -> Policy:
    """The policy file that a run starts from.

    Args:
      header: of the run's own policies.

    Raises:
      DmcvbError: its network computes something else than the run's, though its weights may fit.
    """
    policy = load_policy(source)
    for field in ("activation", "layer_norm", "way"):
        theirs, ours = getattr(policy.header, field), getattr(header, field)
        if theirs != ours:
            raise DmcvbError(
                f"--init-from {source}: its network has {field} {theirs} and that of {header.algorithm} {ours}, so it "
                "would act otherwise; start from a policy of the same kind"
            )
    return policy


def read_config(folder: str | Path) -> RunConfig | None:
    """Return the config of the run in a folder; None if there is no run.

    Raises:
      DmcvbError: run.json is damaged.
    """
    path = Path(folder) / "run.json"
    if not path.exists():
        return None
    try:
        return RunConfig(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise DmcvbError(f"{path} is not a run's configuration ({error}); choose another --out") from None


def check_same(folder: Path, found: RunConfig, asked: RunConfig) -> None:
    """Refuse to mix two configurations in one folder; only `steps` may differ.

    What the run started from is as it was then, whatever lies there by now. Settings are compared with their defaults
    filled in, so that naming a default is no difference.
    """
    was, now = (
        {name: value for name, value in vars(config).items() if name not in FREE}
        | dataclasses.asdict(check_settings(config.algorithm, config.settings))
        for config in (found, asked)
    )
    for name in was | now:
        if was.get(name) != now.get(name):
            raise DmcvbError(
                f"{folder} holds a run with {name} {was.get(name)!r}, asked for {now.get(name)!r}; "
                "choose another --out, or repeat its settings"
            )


class Run(abc.ABC):
    """A run in a folder; `train` starts it or goes on.

    Attributes:
      settings: the algorithm's checked settings.
      header: header of its policy files, without evaluation and agent step.
      step: agent steps so far.
      seconds: seconds of training so far, without evaluations.
      warmup_setting: the setting that says how long nothing is learned.
    """

    warmup_setting = "warmup_steps"

    def __init__(self, folder: Path, config: RunConfig):
        self.folder, self.config = Path(folder), config
        self.task = get_task(config.task)
        self.settings = check_settings(config.algorithm, config.settings)
        self.header = PolicyHeader(
            task=self.task.id,
            observation=self.task.observation,
            observation_size=self.task.behaviour_size,
            action_size=self.task.action_size,
            algorithm=config.algorithm,
            agent_step=0,
            training={
                "settings": dataclasses.asdict(self.settings),
                "seed": config.seed,
                "init_from": config.init_name,
                "environment": environment(),
            }
            | ({"init_sha256": config.init_sha256} if config.init_sha256 else {})
            | self.describe(),
            command=command_of(dataclasses.replace(config, init_from=config.init_name)),
            **self.network(),
        )
        self.step, self.seconds = 0, 0.0
        self._started = self._last_saved = time.time()
        self._asked_to_stop = False

    # -- what an algorithm must say ---------------------------------------------------------

    @abc.abstractmethod
    def network(self) -> dict[str, Any]:
        """The header's fields that say how the actor is built."""

    def describe(self) -> dict[str, Any]:
        """Return further facts for the header's `training`."""
        return {}

    @abc.abstractmethod
    def warmup(self) -> int:
        """Agent steps before anything is learned."""

    def evaluation_steps(self) -> float:
        """Agent steps simulated in evaluations for each one trained, at most."""
        return EVALUATION_STEPS[self.task.family]

    def most_evaluation_episodes(self) -> int:
        """Episodes of an evaluation along the way, at most."""
        return EVALUATION_EPISODES

    def problem(self) -> str | None:
        """Say why a run with these settings would learn nothing, and the cure; None if nothing is wrong."""
        return None

    def too_few_updates(self, warmup: int, needed: int = 1) -> str | None:
        """A problem if the updates of all steps come to less than the policy needs to change once.

        Args:
          warmup: agent steps before the first update; `updates_per_step` come for every one after.
          needed: updates until the policy changes.
        """
        together, rate = self.settings.simulations, self.settings.updates_per_step
        rounds = -(-self.config.steps // together) - max(-(-warmup // together), 1) + 1
        if rounds * together * rate >= needed:
            return None
        return (
            f"{self.config.steps} steps come to {rounds * together * rate:.3g} updates and the policy changes after "
            f"{needed}, so nothing would be learned; give more --steps, or a higher --set updates_per_step"
        )

    @abc.abstractmethod
    def _train(self, saved: dict[str, Any] | None, report: Report, tick: ProgressCallback) -> None:
        """Train until `config.steps`, from a saved state if there is one."""

    # -- what callers use -------------------------------------------------------------------

    def train(
        self,
        report: Report = lambda progress: None,
        tick: ProgressCallback = lambda steps: None,
        stopping: Callable[[], Any] = lambda: None,
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
        with self._writing():
            for name in ("checkpoints", "resume"):
                (self.folder / name).mkdir(parents=True, exist_ok=True)
            with self._alone():
                self.write_config()
                saved = self.saved()
                if not saved:
                    self._refuse_lost_state()
                self.step, self.seconds = (saved["step"], saved["seconds"]) if saved else (0, 0.0)
                self._drop_later_checkpoints()
                self._log = RunLog(self.folder, self.step)
                self._started = self._last_saved = time.time()
                try:
                    with self._stopping_on_signals(stopping):
                        self._train(saved, report, tick)
                finally:
                    self._log.close()

    def write_config(self) -> None:
        """Write run.json.

        Raises:
          DmcvbError: another process has begun another run in the folder.
        """
        if found := read_config(self.folder):
            check_same(self.folder, found, self.config)
        write_json_atomically(self.folder / "run.json", json.loads(json.dumps(dataclasses.asdict(self.config))))

    def _refuse_lost_state(self) -> None:
        """Raise if a run has trained for longer than it takes to save it, and its saved state is gone."""
        rows = read_rows(self.folder)
        if rows and float(rows[-1]["seconds"] or 0) > 2 * SAVE_SECONDS:
            raise DmcvbError(
                f"{self.folder} has checkpoints, but nothing to resume from (resume/{STATE} is gone); choose another "
                "--out, or delete checkpoints/ and progress.csv to begin anew"
            )

    def saved(self) -> dict[str, Any] | None:
        """The state to resume from (tensors, numbers and texts only), None if nothing is saved yet."""
        return read_state(self.folder)

    # -- what algorithms use ----------------------------------------------------------------

    def record(
        self, weights: Mapping[str, torch.Tensor], updates: int, metrics: Mapping[str, float], report: Report
    ) -> Progress:
        """Evaluate the actor's `weights`, export them as a policy file, log; evaluations are not training time."""
        self.seconds += time.time() - self._started
        header = self.header.model_copy(update={"agent_step": self.step})
        arrays = as_arrays(weights)
        evaluation, _ = evaluate(Policy(header, arrays, ""), self.task, self.evaluation_episodes(), seed=self.step)
        trained = header.training | {"seconds": round(self.seconds, 1)}
        header = header.model_copy(update={"evaluation": evaluation, "training": trained})
        save_policy(self._checkpoint(self.step), header, arrays)
        self._log.add(self.step, evaluation, self.seconds, updates, metrics)
        self._thin()
        seconds = max(self.seconds, 1e-9)
        progress = Progress(self.step, evaluation, self.seconds, self.step / seconds, updates / seconds)
        report(progress)
        self._started = time.time()
        return progress

    def evaluation_episodes(self) -> int:
        """Episodes of the evaluation after the steps trained since the one before, so that all keep to their share."""
        since = self.step - max((step for step in self._log.curve if step < self.step), default=0)
        affordable = self.evaluation_steps() * since / self.task.max_steps
        return int(np.clip(affordable, 1, self.most_evaluation_episodes()))

    def next_evaluation(self, evaluation: Evaluation, planned: int) -> int:
        """The agent step of the evaluation after this one: the planned one, if the run ended before it."""
        if self.step < planned:
            return planned
        config = self.config
        expert, medium = (paper_returns(self.task.id, level) for level in ("expert", "medium"))
        dense = True
        if expert and medium:
            # One lucky evaluation must not end it: a maze's twenty episodes have a standard error of half its medium.
            latest = [*list(self._log.curve.values())[-RISEN:-1], evaluation.mean]
            dense = np.median(latest) < medium["mean"] + DENSE_SHARE * (expert["mean"] - medium["mean"])
        return self.step + (config.evaluate_every if dense else config.evaluate_sparse)

    def save(self, state: dict[str, Any]) -> None:
        """Put the state to resume from in place of the previous one, whole or not at all."""
        seconds = self.seconds + time.time() - self._started
        write_bytes(self.folder / "resume" / STATE, pack_state(state | {"step": self.step, "seconds": seconds}))
        self._last_saved = time.time()

    def between_rounds(self, state: Callable[[], dict[str, Any]]) -> None:
        """Save the run if it is time to, or if it was asked to stop; called where a resumed run can begin.

        Args:
          state: gives what `save` takes.

        Raises:
          Stopped: it was asked to stop, and is saved.
        """
        if self._asked_to_stop or time.time() - self._last_saved > SAVE_SECONDS:
            self.save(state())
        if self._asked_to_stop:
            raise Stopped(f"stopped at step {self.step:,}, and saved; resume: {self.resume_command()}")

    def resume_command(self) -> str:
        """The command line that resumes this run."""
        what = [self.config.task]
        maze = MazeName.parse(self.config.task)
        if maze and maze.rows and not maze.reward:  # the layout's name is short, its rows are not
            path = self.folder / f"{maze.layout}.txt"
            path.write_text(maze.rows.replace("/", "\n").replace(".", " ") + "\n")
            what = ["--layout", str(path)]
        return shlex.join(["dmcvb-gen", "train-behaviour", *what, "--out", str(self.folder), "--resume"])

    @contextlib.contextmanager
    def _stopping_on_signals(self, stopping: Callable[[], Any]) -> Iterator[None]:
        """Ctrl-C and SIGTERM ask the run to stop; more of them change nothing, so a save is never cut off."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(*_: Any) -> None:
            if not self._asked_to_stop:
                stopping()
            self._asked_to_stop = True

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    # -- the folder -------------------------------------------------------------------------

    def _checkpoint(self, step: int) -> Path:
        return self.folder / "checkpoints" / f"{step:010d}.safetensors"

    def _checkpoints(self) -> dict[int, Path]:
        files = (self.folder / "checkpoints").glob("[0-9]*.safetensors")
        return {int(path.stem): path for path in files if path.stem.isdigit()}

    def _drop_later_checkpoints(self) -> None:
        for step, path in self._checkpoints().items():
            if step > self.step:
                path.unlink()
        for folder in ("checkpoints", "resume"):
            for path in (self.folder / folder).glob("*.partial"):
                path.unlink()

    def _thin(self) -> None:
        files = self._checkpoints()
        curve = {step: self._log.curve[step] for step in files if step in self._log.curve}
        picked = self._picked()
        for step in prunable_checkpoints(curve, self.task.return_range):
            if files[step].name not in picked:
                files[step].unlink()

    def _picked(self) -> set[str]:
        """Names of the checkpoints that the last selection picked."""
        try:
            levels = json.loads((self.folder / "selection.json").read_text())["levels"]
            return {Path(pick["path"]).name for level in levels.values() for pick in level["picks"]}
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            return set()

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """One process a folder; the lock ends with the process, however that ends."""
        lock = filelock.FileLock(self.folder / "resume" / "lock", timeout=0)
        try:
            lock.acquire()
        except filelock.Timeout:
            raise DmcvbError(f"another process trains in {self.folder}; wait for it, or choose another --out") from None
        try:
            yield
        finally:
            lock.release()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DmcvbError(
                f"cannot write the run in {self.folder}: {error.strerror or error}; the previous saved state is whole, "
                "make room and go on with --resume"
            ) from None
