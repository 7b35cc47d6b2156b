"""Budgets of a validation: `PROFILES["quick"]`; only "paper" is sized as the paper is."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dmcvb_gen.agents.networks import PAPER, PATCHES, Architecture
from dmcvb_gen.errors import UnknownNameError


@dataclass(frozen=True)
class Profile:
    """Sizes of every cell of a benchmark.

    Attributes:
      pixel_steps: Adam steps of a policy that trains its own encoder on pictures.
      pretrain_steps: Adam steps of a pre-trained encoder.
      frozen_steps: Adam steps of a policy on a frozen encoder.
      state_steps: Adam steps of an agent that sees states.
      readout_steps: Adam steps of each decoder on a frozen encoder; 0: no inspection.
      evaluations: online evaluations, evenly over a policy's training. Of several the best one counts, as in the paper,
        which makes the score somewhat too high.
      episodes: episodes of each evaluation.
      episode_steps: agent steps an evaluation's episode is cut to; None: whole episodes.
      batch_size: transitions an Adam step.
      state_batch_size: the same of agents that see states.
      network: the convolutions of every encoder and decoder.
      rate: times the paper's learning rate of 1e-3, of agents that see pictures.
      shift_from: passes over the data from which on a training shifts its pictures at random. 0: always, as the
        paper's. Unshifted pictures are learned several times as fast, and after more than ten passes known by heart.
      frozen_shift: pictures are shifted while a policy or decoder learns on a frozen encoder. Without shifts every
        observation is encoded once, and its latent kept.
      decay: the learning rate falls to zero over each training, instead of staying as the paper's.
      muon: of agents that see pictures, hidden matrices move by `Muon` instead of the paper's Adam.
      scores: True if its scores mean anything.
      note: printed wherever a score stands.
    """

    name: str
    pixel_steps: int
    pretrain_steps: int
    frozen_steps: int
    state_steps: int
    readout_steps: int
    evaluations: int
    episodes: int
    batch_size: int = 256
    state_batch_size: int = 256
    network: Architecture = PAPER
    rate: float = 1.0
    shift_from: float = 0.0
    frozen_shift: bool = True
    decay: bool = False
    muon: bool = False
    episode_steps: int | None = None
    scores: bool = True
    note: str = ""

    def shifts(self, steps: int, transitions: int) -> bool:
        """True if an agent shifts its pictures while it learns for so many steps from so many transitions."""
        return steps * self.batch_size >= self.shift_from * transitions

    def scaled(self, factor: float) -> Profile:
        """The same with every training `factor` times as long, and a name that says so."""
        if factor == 1:
            return self
        steps = {
            name: max(1, round(getattr(self, name) * factor))
            for name in ("pixel_steps", "pretrain_steps", "frozen_steps", "state_steps", "readout_steps")
        }
        name = f"{self.name} x{factor:g}"
        return replace(self, name=name, note=f"{name}: {factor:g} times the steps of {self.note}", **steps)


PROFILES = {
    profile.name: profile
    for profile in (
        Profile(
            "smoke",
            pixel_steps=3,
            pretrain_steps=3,
            frozen_steps=3,
            state_steps=3,
            readout_steps=2,
            evaluations=1,
            episodes=2,
            batch_size=16,
            state_batch_size=16,
            muon=True,
            episode_steps=10,
            scores=False,
            note="smoke: a few steps to see that everything runs; its numbers are not scores",
        ),
        # Encoders and policies take as many steps as BC does end to end, so that agents are compared at equal updates;
        # a policy on a frozen encoder costs a seventh of an update, as its latents are computed once.
        Profile(
            "brief",
            pixel_steps=5_000,
            pretrain_steps=5_000,
            frozen_steps=5_000,
            state_steps=10_000,
            readout_steps=500,
            evaluations=1,
            episodes=30,
            batch_size=64,
            network=PATCHES,
            rate=2.0,
            shift_from=10.0,
            frozen_shift=False,
            decay=True,
            note="brief: a small network of 4x4 patches and frame differences, 0.3 % of the paper's samples (2.5 % of "
            "states), random shifts only from ten passes over the data on, twice the rate, falling; scores are not "
            "comparable with the paper's",
        ),
        Profile(
            "quick",
            pixel_steps=16_000,
            pretrain_steps=16_000,
            frozen_steps=16_000,
            state_steps=40_000,
            readout_steps=500,
            evaluations=1,
            episodes=30,
            batch_size=64,
            network=PATCHES,
            shift_from=10.0,
            frozen_shift=False,
            decay=True,
            muon=True,
            note="quick: a small network of 4x4 patches and frame differences, 1 % of the paper's samples (10 % of "
            "states), Muon instead of Adam, a falling rate, random shifts only from ten passes over the data on; "
            "scores are not comparable with the paper's",
        ),
        Profile(
            "paper",
            pixel_steps=400_000,
            pretrain_steps=400_000,
            frozen_steps=400_000,
            state_steps=400_000,
            readout_steps=400_000,
            evaluations=20,
            episodes=30,
            note="paper: 400k steps, batch 256, 30 episodes every 20k steps, as published",
        ),
    )
}


def facts_of(profile: Profile) -> dict[str, Any]:
    """A profile as JSON has it."""
    return json.loads(json.dumps(dataclasses.asdict(profile)))


def budget(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The facts of a profile that a result carries, but for its note; equal ones are equal budgets.

    Fields that the results of earlier versions lack have their defaults.
    """
    usual = {
        field.name: field.default for field in dataclasses.fields(Profile) if field.default is not dataclasses.MISSING
    }
    known = json.loads(json.dumps(usual | {"network": dataclasses.asdict(PAPER)}))
    return {name: value for name, value in {**known, **facts}.items() if name != "note"}


def get_profile(name: str) -> Profile:
    """The profile of a name.

    Raises:
      UnknownNameError: there is none.
    """
    if name not in PROFILES:
        raise UnknownNameError("profile", name, PROFILES)
    return PROFILES[name]
