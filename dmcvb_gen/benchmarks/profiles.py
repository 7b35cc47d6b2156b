"""How much a validation trains and evaluates: `PROFILES["quick"]`; only "paper" is sized as the paper is."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
        # Sized for two free cores: small batches learn more from a second of CPU than the paper's 256 do. A step of BC
        # on 64 stacks in bfloat16 takes about 0.07 s: BC 12 min, ID 12 min, BC on its frozen encoder 3 min, BC on
        # states 1 min, decoders and evaluations 10 min.
        Profile(
            "quick",
            pixel_steps=10_000,
            pretrain_steps=5_000,
            frozen_steps=6_000,
            state_steps=15_000,
            readout_steps=600,
            evaluations=2,
            episodes=30,
            batch_size=64,
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
