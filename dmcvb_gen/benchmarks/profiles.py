"""How much a validation trains and evaluates: `PROFILES["quick"]`; only "paper" is sized as the paper is."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dmcvb_gen.agents.networks import PAPER, Architecture
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
        # Sized so that BC, BC(state) and ID+BC on one subset take under an hour on two cores. For so short a training
        # small batches and a falling rate pay: after 175 s of one CPU, BC's loss on walker expert was 0.048 with 4,000
        # batches of 16 and 0.053 with 1,000 of 64; 5,500 of 64 at a constant rate had returned 517. On walker expert,
        # none, 100 episodes, one thread each: BC 31 min (return 708 +- 72), ID and BC on its encoder 28 (571 +- 56; 104
        # with 10,000 steps of each), BC(state) 1.3 (948 +- 6, all of the data's mean).
        Profile(
            "quick",
            pixel_steps=40_000,
            pretrain_steps=15_000,
            frozen_steps=30_000,
            state_steps=30_000,
            readout_steps=600,
            evaluations=2,
            episodes=30,
            batch_size=16,
            decay=True,
            note="quick: under 1 % of the paper's training; scores are not comparable with the paper's",
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
