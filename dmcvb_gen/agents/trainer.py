"""Train any agent on its data and record its learning curve; a stopped training resumes.

Every random number of step i (which transitions, shifts, TD3's noise) comes from (seed, i), so a run that is stopped
and resumed draws what it would have drawn.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dmcvb_gen.agents.data import TrainingData, batches
from dmcvb_gen.agents.learners import Batch, Learner
from dmcvb_gen.agents.muon import Muon
from dmcvb_gen.compilation import compiled
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import remove_partial, replacing
from dmcvb_gen.state_file import pack_state, read_state_file

HOLD_OUT_BATCHES, HOLD_OUT_TRANSITIONS = 4, 256
"""At least so many batches, and transitions, of the hold-out are what a test loss is the mean of; but no more batches
than were trained on."""
SAVE_SECONDS = 120.0
"""Seconds of work that a stop may cost."""
RESUME_FILE = "resume.safetensors"

Curve = list[dict[str, Any]]
"""A point: step, seconds since the start, losses, hold-out losses ("test_..."), and what `evaluate` gave."""


@dataclass(frozen=True)
class TrainSettings:
    """Length and settings of a training (paper, table "Hyperparameters").

    Attributes:
      steps: Adam steps.
      batch_size: transitions a step.
      evaluate_every: steps between online evaluations; one at the end in any case.
      points: points of the learning curve.
      half: bfloat16 autocast. Pays for pictures, not for states.
      compile: torch.compile of the losses.
      workers: threads that draw batches ahead; 0 draws them in turn (pictures in a mapped file have two in any case).
      rate: times the learner's own learning rate (1e-3, the paper's).
      shift: pictures are shifted at random, as the paper's; short trainings learn several times as fast without.
      decay: the learning rate falls linearly to zero over the steps; the paper keeps it, short trainings gain by it.
      muon: hidden matrices move by `Muon`, not by the paper's Adam.
    """

    steps: int = 400_000
    batch_size: int = 256
    evaluate_every: int = 20_000
    points: int = 50
    half: bool = True
    compile: bool = False
    workers: int = 0
    rate: float = 1.0
    shift: bool = True
    decay: bool = False
    muon: bool = False


def draw(
    learner: Learner,
    data: TrainingData,
    size: int,
    seed: int,
    step: int,
    hold_out: bool = False,
    shift: bool = True,
    reuse: Batch | None = None,
) -> Batch:
    """The batch of a step, as the learner needs it; over a batch that is no longer needed, if one is given."""
    generator = np.random.default_rng((seed, step, int(hold_out)))
    return data.batch(
        size,
        generator,
        next_observation=learner.needs_next,
        k=learner.k_max,
        sample_k=learner.sample_k,
        hold_out=hold_out,
        shift=shift,
        dtype=torch.bfloat16 if learner.half else torch.float32,
        reuse=reuse,
        pictures=learner.needs_pictures,
    )


def hold_out_losses(learner: Learner, data: TrainingData, size: int, most: int) -> dict[str, float]:
    """Losses on held-out episodes, always on the same, at `most` so many batches; {} if nothing is held out."""
    rows, apart = data.hold_out_rows, learner.k_max if learner.needs_next else 1
    if not (rows + apart <= data.end[rows]).any():  # as few or as short episodes as that
        return {}
    sums: dict[str, float] = {}
    count = min(most, max(HOLD_OUT_BATCHES, -(-HOLD_OUT_TRANSITIONS // size)))
    for index in range(count):
        for name, value in learner.metrics(draw(learner, data, size, 0, index, hold_out=True)).items():
            sums[f"test_{name}"] = sums.get(f"test_{name}", 0.0) + float(value) / count
    return sums


def train(
    learner: Learner,
    data: TrainingData,
    settings: TrainSettings,
    *,
    seed: int = 0,
    folder: Path | None = None,
    evaluate: Callable[[Learner], dict[str, Any]] | None = None,
    tick: Callable[[int], None] = lambda steps: None,
) -> Curve:
    """Train a learner in place.

    Args:
      folder: folder of the state while it trains; a run with such a state resumes from it.
      evaluate: gives scores of the learner, added to the curve.
      tick: called with the number of steps since the last call.

    Raises:
      DmcvbError: the folder holds the state of another learner, or a loss is no longer finite.
    """
    first, curve, spent, means = 0, [], 0.0, _Means()
    path = folder / RESUME_FILE if folder else None
    if settings.muon:
        precision = torch.bfloat16 if settings.half else torch.float32
        learner.optimizers = {name: Muon.instead_of(one, precision) for name, one in learner.optimizers.items()}
    if path is not None and path.exists():
        first, curve, spent, means = _load_state(learner, path)
        tick(first)
    learner.half = settings.half
    if settings.compile:
        for name in learner.compiled:
            setattr(learner, name, compiled(getattr(learner, name)))
    log_every = max(1, settings.steps // settings.points)
    started = saved = time.perf_counter()

    def make(step: int, reuse: Batch | None) -> Batch:
        return draw(learner, data, settings.batch_size, seed, step, shift=settings.shift, reuse=reuse)

    schedule = _Schedule(learner, settings)
    workers = max(settings.workers, 2 if data.frames is not None and data.frames.mapped else 0)
    for step, batch in batches(make, first, settings.steps, workers):
        torch.manual_seed((seed << 32) + step)
        schedule.at(step)
        means.add(learner.update(batch))
        done = step + 1
        tick(1)
        evaluating = done % settings.evaluate_every == 0 or done == settings.steps
        if evaluating or done % log_every == 0:
            held_out = hold_out_losses(learner, data, settings.batch_size, settings.steps)
            point = {"step": done, **means.take(done), **held_out}
            if evaluating and evaluate:
                point |= evaluate(learner)
            curve.append(point | {"seconds": round(spent + time.perf_counter() - started, 2)})
        if path is not None and time.perf_counter() - saved > SAVE_SECONDS:  # the end too: its evaluation may be long
            _save_state(learner, path, done, curve, spent + time.perf_counter() - started, means)
            saved = time.perf_counter()
    schedule.restore()
    return curve


class _Schedule:
    """The learning rates of a learner's optimizers, step by step."""

    def __init__(self, learner: Learner, settings: TrainSettings):
        self._groups = [group for optimizer in learner.optimizers.values() for group in optimizer.param_groups]
        self._own = [group["lr"] for group in self._groups]
        self._settings = settings

    def at(self, step: int) -> None:
        factor = self._settings.rate * (1 - step / self._settings.steps if self._settings.decay else 1.0)
        for group, rate in zip(self._groups, self._own, strict=True):
            group["lr"] = rate * factor

    def restore(self) -> None:
        for group, rate in zip(self._groups, self._own, strict=True):
            group["lr"] = rate


class _Means:
    """Means of named losses since they were last taken."""

    def __init__(self, sums: dict[str, torch.Tensor] | None = None, counts: dict[str, int] | None = None):
        self._sums, self._counts = sums or {}, counts or {}

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, int]]:
        """Return the state that it was made from, with what was added since."""
        return dict(self._sums), dict(self._counts)

    def add(self, losses: dict[str, torch.Tensor]) -> None:
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
            self._counts[name] = self._counts.get(name, 0) + 1

    def take(self, step: int) -> dict[str, float]:
        """The means, as numbers.

        Raises:
          DmcvbError: one is no longer finite.
        """
        means = {name: float(value) / self._counts[name] for name, value in self._sums.items()}
        for name, value in means.items():
            if not np.isfinite(value):
                raise DmcvbError(f"{name} is no longer finite at step {step}; look at the data with `dmcvb-gen verify`")
        self._sums, self._counts = {}, {}
        return means


def forget(folder: Path) -> None:
    """Remove the state of a training that is through."""
    (folder / RESUME_FILE).unlink(missing_ok=True)


def _save_state(learner: Learner, path: Path, step: int, curve: Curve, seconds: float, means: _Means) -> None:
    optimizers = {name: optimizer.state_dict()["state"] for name, optimizer in learner.optimizers.items()}
    state = {"step": step, "seconds": seconds, "curve": curve, "means": means.state()}
    content = pack_state(state | {"weights": learner.state_dict(), "optimizers": optimizers})
    remove_partial(path.parent, below=False)  # of a process that was killed
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _load_state(learner: Learner, path: Path) -> tuple[int, Curve, float, _Means]:
    cure = "delete it to start that training again"
    state = read_state_file(path, cure)
    try:
        learner.load_state_dict(state["weights"])
        for name, optimizer in learner.optimizers.items():
            optimizer.load_state_dict(optimizer.state_dict() | {"state": state["optimizers"][name]})
            _lay_out(optimizer)
        sums, counts = state["means"]
        device = next(learner.parameters()).device
        means = _Means({name: value.to(device) for name, value in sums.items()}, counts)
        return state["step"], state["curve"], state["seconds"], means
    except (RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise DmcvbError(f"cannot resume from {path} ({reason}); {cure}") from None


def _lay_out(optimizer: torch.optim.Optimizer) -> None:
    """Put a loaded state into its parameters' order in memory: Adam's fused kernel walks both as they lie there."""
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            if torch.is_tensor(value) and value.shape == parameter.shape:
                state[key] = torch.empty_like(parameter, dtype=value.dtype, requires_grad=False).copy_(value)
