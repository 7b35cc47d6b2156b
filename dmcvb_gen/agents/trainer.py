"""Train any agent on its data and record its learning curve.

Every random number of step i (which transitions, shifts, TD3's noise) comes from (seed, i).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from dmcvb_gen.agents.data import TrainingData, batches
from dmcvb_gen.agents.learners import Batch, Learner
from dmcvb_gen.agents.muon import Muon
from dmcvb_gen.agents.networks import PAPER, Architecture
from dmcvb_gen.compilation import compiled
from dmcvb_gen.errors import DmcvbError

HOLD_OUT_BATCHES, HOLD_OUT_TRANSITIONS = 4, 256
"""At least so many batches, and transitions, of the hold-out are what a test loss is the mean of; but no more batches
than were trained on."""
POINTS = 50
"""Points of the learning curve."""
TICK_SECONDS = 0.2
"""Progress is told no more often: an Adam step on states takes less time than telling of it."""

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
) -> Batch:
    """The batch of a step, as the learner needs it."""
    generator = np.random.default_rng((seed, step, int(hold_out)))
    common: dict[str, Any] = dict(shift=shift, dtype=torch.bfloat16 if learner.half else torch.float32)
    batch = data.batch(size, generator, hold_out=hold_out, **learner.draws, **common)
    if not learner.needs_labels or hold_out:
        return batch
    common |= {"next_observation": True} | learner.draws
    return replace(batch, labeled=data.but(train_rows=data.labeled_rows).batch(size, generator, **common))


def hold_out_losses(learner: Learner, data: TrainingData, size: int, most: int) -> dict[str, float]:
    """Losses on held-out episodes, always on the same, at `most` so many batches; {} if nothing is held out."""
    rows, apart = data.hold_out_rows, learner.draws.get("k", 1)
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
    evaluate: Callable[[Learner], dict[str, Any]] | None = None,
    tick: Callable[[int], None] = lambda steps: None,
) -> Curve:
    """Train a learner in place.

    Args:
      data: with pictures, or states alone: the budget differs.
      steps: Adam steps.
      shift: pictures are shifted at random, as the paper's.
      evaluate: gives scores of the learner, added to the curve, at the end and so often as the budget says.
      tick: called with the number of steps since the last call.

    Raises:
      DmcvbError: a loss is no longer finite.
    """
    pixels = data.frames is not None
    size = budget.batch_size if pixels else budget.state_batch_size
    learner.half = pixels and budget.precision == "bfloat16"
    if pixels and budget.muon:
        dtype = torch.bfloat16 if learner.half else torch.float32
        learner.optimizers = {name: Muon.instead_of(one, dtype) for name, one in learner.optimizers.items()}
    if budget.compile:
        for name in learner.compiled:
            setattr(learner, name, compiled(getattr(learner, name)))
    evaluate_every, log_every = -(-steps // (budget.evaluations if evaluate else 1)), max(1, steps // POINTS)
    curve, told = list[dict[str, Any]](), 0
    seen: dict[str, list[torch.Tensor]] = {}
    started = told_at = time.perf_counter()

    def make(step: int) -> Batch:
        return draw(learner, data, size, budget.seed, step, shift=shift)

    groups = [group for optimizer in learner.optimizers.values() for group in optimizer.param_groups]
    rates = [group["lr"] * (budget.rate if pixels else 1.0) for group in groups]
    workers = 2 if pixels and data.frames.mapped else int(data.device.type != "cpu")
    for step, batch in batches(make, steps, workers):
        # A generator of torch's takes 32 bits of what it is given.
        torch.manual_seed(int(np.random.SeedSequence((budget.seed, step)).generate_state(1)[0]))
        for group, rate in zip(groups, rates, strict=True):
            group["lr"] = rate * (1 - step / steps) if budget.decay else rate
        for name, value in learner.update(batch).items():
            seen.setdefault(name, []).append(value)
        done = step + 1
        evaluating = done % evaluate_every == 0 or done == steps
        if evaluating or time.perf_counter() - told_at > TICK_SECONDS:
            tick(done - told)
            told, told_at = done, time.perf_counter()
        if evaluating or done % log_every == 0:
            point = {"step": done, **_means(seen, done), **hold_out_losses(learner, data, size, steps)}
            seen.clear()
            if evaluating and evaluate:
                point |= evaluate(learner)
            curve.append(point | {"seconds": round(time.perf_counter() - started, 2)})
    return curve


def _means(seen: dict[str, list[torch.Tensor]], step: int) -> dict[str, float]:
    """The means of losses, as numbers.

    Raises:
      DmcvbError: one is no longer finite.
    """
    means = {name: float(sum(values)) / len(values) for name, values in seen.items()}
    for name, value in means.items():
        if not np.isfinite(value):
            raise DmcvbError(
                f"{name} is no longer finite at step {step}; look at the agent's losses, and at the data with "
                "`dmcvb-gen verify`"
            )
    return means
