"""How much a validation trains and evaluates: `PROFILES["quick"]`; only "paper" is sized as the paper is."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dmcvb_gen.agents.networks import NARROW, PAPER, Architecture
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
      evaluations: online evaluations, evenly over a policy's training.
      episodes: of each evaluation.
      episode_steps: agent steps an evaluation's episode is cut to; None: whole episodes.
      batch_size: transitions an Adam step.
      network: the convolutions of every encoder and decoder.
      rate: times the paper's learning rate of 1e-3.
      decay: the learning rate falls to zero over each training, instead of staying as the paper's.
      scores: whether its scores mean anything.
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
    network: Architecture = PAPER
    rate: float = 1.0
    decay: bool = False
    episode_steps: int | None = None
    scores: bool = True
    note: str = ""

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
            state_steps=20,
            readout_steps=2,
            evaluations=1,
            episodes=2,
            batch_size=16,
            episode_steps=10,
            scores=False,
            note="smoke: a few steps to see that everything runs; its numbers are not scores",
        ),
        # Ten minutes of one core for a cell with pictures. In so short a time a narrow network learns more than the
        # paper's: it sees 3,100 samples a second instead of 470 (bfloat16, batches of 64). On walker expert, none, 100
        # episodes, it returned 909 +- 11 after 11 minutes on a busy machine (BC from states 945 +- 3); the paper's
        # network had 708 +- 72 after 40,000 batches of 16 and 31 minutes.
        Profile(
            "quick",
            pixel_steps=20_000,
            pretrain_steps=10_000,
            frozen_steps=10_000,
            state_steps=20_000,
            readout_steps=1_000,
            evaluations=2,
            episodes=30,
            batch_size=64,
            network=NARROW,
            decay=True,
            note="quick: a network with a 23rd of the work of the paper's, 1 % of its samples, a falling rate; scores "
            "are not comparable with the paper's",
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


def get_profile(name: str) -> Profile:
    """The profile of a name.

    Raises:
      UnknownNameError: there is none.
    """
    if name not in PROFILES:
        raise UnknownNameError("profile", name, PROFILES)
    return PROFILES[name]
