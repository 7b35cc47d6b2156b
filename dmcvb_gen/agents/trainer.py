"""Train any agent on its data and record its learning curve; a stopped training resumes.

Every random number of step i (which transitions, shifts, TD3's noise) comes from (seed, i), so a run that is stopped
and resumed draws what it would have drawn.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dmcvb_gen.agents.data import TrainingData, batches
from dmcvb_gen.agents.learners import Batch, Learner
from dmcvb_gen.agents.muon import Muon
from dmcvb_gen.agents.networks import PAPER, Architecture
from dmcvb_gen.compilation import compiled
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import remove_partial, replacing
from dmcvb_gen.state_file import pack_state, read_state_file

HOLD_OUT_BATCHES, HOLD_OUT_TRANSITIONS = 4, 256
"""At least so many batches, and transitions, of the hold-out are what a test loss is the mean of; but no more batches
than were trained on."""
POINTS = 50
"""Points of the learning curve."""
SAVE_SECONDS = 120.0
"""Seconds of work that a stop may cost."""
TICK_SECONDS = 0.2
"""Progress is told no more often: an Adam step on states takes less time than telling of it."""
RESUME_FILE = "resume.safetensors"

Curve = list[dict[str, Any]]
"""A point: step, seconds since the start, losses, hold-out losses ("test_..."), and what `evaluate` gave."""


@dataclass(frozen=True)
class Budget:
    """All that a training is told besides its agent and its data; the defaults are the paper's.

    Attributes:
      name: e.g. "quick". note: printed wherever a score stands. scores: True if its scores mean anything.
      pixel_steps: Adam steps of an encoder, and of a policy that sees pictures, on its own or on a frozen encoder.
      state_steps: Adam steps of an agent that sees states.
      readout_steps: Adam steps of each decoder on a frozen encoder; 0: no inspection.
      evaluations: online evaluations, evenly over a policy's training. Of several the best one counts, as in the paper,
        which makes the score somewhat too high.
      episodes: episodes of each evaluation.
      episode_steps: agent steps an evaluation's episode is cut to; None: whole episodes.
      batch_size: transitions an Adam step. state_batch_size: the same of agents that see states.
      network: the convolutions of every encoder and decoder.
      rate: times the learner's own learning rate (1e-3, the paper's), of agents that see pictures.
      shift_from: passes over the data from which on a training shifts its pictures at random. 0: always, as the
        paper's. Unshifted pictures are learned several times as fast, and after more than ten passes known by heart.
      frozen_shift: pictures are shifted while a policy or decoder learns on a frozen encoder. Without shifts every
        observation is encoded once, and its latent kept.
      decay: the learning rate falls linearly to zero over each training, instead of staying as the paper's.
      muon: of agents that see pictures, hidden matrices move by `Muon` instead of the paper's Adam.
      precision: "float32" or "bfloat16" (autocast), of agents that see pictures.
      seed: of the trainings.
      device: "cpu" or "cuda". threads: of torch and physics in one process. compile: torch.compile the losses.
      memory: bytes of pictures held at most, over all workers (on a cluster: by each cell); None: half of what is free
        (on a cluster: of a cell's share of its node).
      dino_weights: file of DINO's weights. backgrounds: folder of the background videos, if it has moved.
    """

    name: str
    pixel_steps: int = 400_000
    state_steps: int = 400_000
    readout_steps: int = 400_000
    evaluations: int = 20
    episodes: int = 30
    episode_steps: int | None = None
    batch_size: int = 256
    state_batch_size: int = 256
    network: Architecture = PAPER
    rate: float = 1.0
    shift_from: float = 0.0
    frozen_shift: bool = True
    decay: bool = False
    muon: bool = False
    precision: str = "float32"
    seed: int = 0
    scores: bool = True
    note: str = ""
    device: str = "cpu"
    threads: int = 1
    compile: bool = False
    memory: int | None = None
    dino_weights: str | None = None
    backgrounds: str | None = None

    def shifts(self, steps: int, transitions: int) -> bool:
        """True if an agent shifts its pictures while it learns for so many steps from so many transitions."""
        return steps * self.batch_size >= self.shift_from * transitions

    def scaled(self, factor: float) -> Budget:
        """The same with every training `factor` times as long, and a name that says so."""
        if factor == 1:
            return self
        kinds = ("pixel_steps", "state_steps", "readout_steps")
        steps = {name: max(1, round(getattr(self, name) * factor)) for name in kinds}
        name = f"{self.name} x{factor:g}"
        return replace(self, name=name, note=f"{name}: {factor:g} times the steps of {self.note}", **steps)

    def facts(self) -> dict[str, Any]:
        """What of it decides numbers, as JSON has it."""
        machine = ("note", "device", "threads", "compile", "memory", "dino_weights", "backgrounds")
        return json.loads(json.dumps({name: value for name, value in asdict(self).items() if name not in machine}))


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
        later=learner.needs_later,
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
    budget: Budget,
    steps: int,
    *,
    shift: bool = True,
    folder: Path | None = None,
    evaluate: Callable[[Learner], dict[str, Any]] | None = None,
    tick: Callable[[int], None] = lambda steps: None,
) -> Curve:
    """Train a learner in place.

    Args:
      data: with pictures, or states alone: the budget differs.
      steps: Adam steps.
      shift: pictures are shifted at random, as the paper's.
      folder: folder of the state while it trains; a run with such a state resumes from it.
      evaluate: gives scores of the learner, added to the curve, at the end and so often as the budget says.
      tick: called with the number of steps since the last call.

    Raises:
      DmcvbError: the folder holds the state of another learner, or a loss is no longer finite.
    """
    pixels = data.frames is not None
    size, learner.half = budget.state_batch_size, pixels and budget.precision == "bfloat16"
    if pixels:
        size = budget.batch_size
    if pixels and budget.muon:
        dtype = torch.bfloat16 if learner.half else torch.float32
        learner.optimizers = {name: Muon.instead_of(one, dtype) for name, one in learner.optimizers.items()}
    first, curve, spent, means = 0, [], 0.0, _Means()
    path = folder / RESUME_FILE if folder else None
    if path is not None and path.exists():
        first, curve, spent, means = _load_state(learner, path)
        tick(first)
    if budget.compile:
        for name in learner.compiled:
            setattr(learner, name, compiled(getattr(learner, name)))
    evaluate_every, log_every = -(-steps // (budget.evaluations if evaluate else 1)), max(1, steps // POINTS)
    started = saved = told_at = time.perf_counter()
    told = first

    def make(step: int, reuse: Batch | None) -> Batch:
        return draw(learner, data, size, budget.seed, step, shift=shift, reuse=reuse)

    schedule = _Schedule(learner, budget.rate if pixels else 1.0, steps if budget.decay else None)
    workers = 2 if pixels and data.frames.mapped else int(data.device.type != "cpu")
    for step, batch in batches(make, first, steps, workers):
        torch.manual_seed((budget.seed << 32) + step)
        schedule.at(step)
        means.add(learner.update(batch))
        done = step + 1
        evaluating = done % evaluate_every == 0 or done == steps
        if evaluating or time.perf_counter() - told_at > TICK_SECONDS:
            tick(done - told)
            told, told_at = done, time.perf_counter()
        if evaluating or done % log_every == 0:
            point = {"step": done, **means.take(done), **hold_out_losses(learner, data, size, steps)}
            if evaluating and evaluate:
                point |= evaluate(learner)
            curve.append(point | {"seconds": round(spent + time.perf_counter() - started, 2)})
        if path is not None and time.perf_counter() - saved > SAVE_SECONDS:  # the end too: its evaluation may be long
            _save_state(learner, path, done, curve, spent + time.perf_counter() - started, means)
            saved = time.perf_counter()
    schedule.restore()
    return curve


class _Schedule:
    """The learning rates of a learner's optimizers, step by step: `rate` times their own, falling to 0 after `end`."""

    def __init__(self, learner: Learner, rate: float, end: int | None):
        self._groups = [group for optimizer in learner.optimizers.values() for group in optimizer.param_groups]
        self._own = [group["lr"] for group in self._groups]
        self._rate, self._end = rate, end

    def at(self, step: int) -> None:
        factor = self._rate * (1 - step / self._end if self._end else 1.0)
        for group, own in zip(self._groups, self._own, strict=True):
            group["lr"] = own * factor

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


def _save_state(learner: Learner, path: Path, step: int, curve: Curve, seconds: float, means: _Means) -> None:
    optimizers = {name: optimizer.state_dict()["state"] for name, optimizer in learner.optimizers.items()}
    state = {"step": step, "seconds": seconds, "curve": curve, "means": means.state()}
    content = pack_state(state | {"weights": learner.state_dict(), "optimizers": optimizers})
    remove_partial(path.parent)  # of a process that was killed
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
