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
      state_batch_size: the same of agents that see states.
      network: the convolutions of every encoder and decoder.
      rate: times the paper's learning rate of 1e-3, of agents that see pictures.
      shift: pictures are shifted at random while agents learn, as the paper's.
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
    state_batch_size: int = 256
    network: Architecture = PAPER
    rate: float = 1.0
    shift: bool = True
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
        # BC on walker expert, none, 100 episodes, up to four minutes of a core each: shifted 99 +- 14 (half as wide
        # 83, twice as wide 74, batches of 32 44), at twice the rate 133 +- 35, unshifted at twice the rate 490 +- 49
        # (with GELU; with ReLU, a third faster, 510 +- 43). But unshifted pictures are soon known by heart: 428 +- 47
        # after 10,000 of 20,000 steps, where shifted ones at the paper's rate returned 909 +- 11 in the end. So there
        # are two profiles. Compiled kernels made a third more samples a second than GELU, after a minute of compiling,
        # so they may pay from quick on (--compile); four strides instead of three make no more.
        Profile(
            "brief",
            pixel_steps=5_000,
            pretrain_steps=2_500,
            frozen_steps=2_500,
            state_steps=10_000,
            readout_steps=250,
            evaluations=2,
            episodes=30,
            batch_size=64,
            network=NARROW,
            rate=2.0,
            shift=False,
            decay=True,
            note="brief: a network with a 23rd of the work of the paper's and ReLU, 0.3 % of its samples (2.5 % of "
            "states), no random shifts, twice the rate, falling; scores are not comparable with the paper's",
        ),
        # Ten to fifteen minutes of one core for a cell with pictures: 909 +- 11 on walker as above (BC from states
        # 945 +- 3); the paper's network had 708 +- 72 after 40,000 batches of 16 and 31 minutes. An agent of states
        # costs little more in the paper's batches of 256 than in those of 64.
        Profile(
            "quick",
            pixel_steps=20_000,
            pretrain_steps=10_000,
            frozen_steps=10_000,
            state_steps=40_000,
            readout_steps=1_000,
            evaluations=2,
            episodes=30,
            batch_size=64,
            network=NARROW,
            decay=True,
            note="quick: a network with a 23rd of the work of the paper's and ReLU, 1 % of its samples (10 % of "
            "states), a falling rate; scores are not comparable with the paper's",
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
