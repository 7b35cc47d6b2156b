"""Check the settings of the learners and turn them into data classes."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from dmcvb_gen.errors import DmcvbError, UnknownNameError

Count = Annotated[int, Field(gt=0)]
Natural = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]

ALGORITHMS = {
    "sac": "dmcvb_gen.training.sac:SacSettings",
    "mpo": "dmcvb_gen.training.mpo:MpoSettings",
    "guided": "dmcvb_gen.training.guided:GuidedSettings",
    "sb3-sac": "dmcvb_gen.training.settings:Sb3SacSettings",
    "td3": "dmcvb_gen.training.settings:Td3Settings",
    "tqc": "dmcvb_gen.training.settings:TqcSettings",
    "ppo": "dmcvb_gen.training.settings:PpoSettings",
}
"""What `train-behaviour --algo` takes -> its settings. `sac`, `mpo`, `guided` are the package's own, the rest SB3's."""


@dataclasses.dataclass(frozen=True)
class Sb3Settings:
    """Settings of all Stable-Baselines3 learners; names and meanings are SB3's if it has them.

    Attributes:
      simulations: episodes stepped side by side.
      hidden: widths of the hidden layers, actor's and critics'.
      normalize_observation, normalize_reward: running normalization (VecNormalize); observation statistics go into
        the policy files.
    """

    simulations: Count = 8
    hidden: tuple[Count, ...] = (256, 256)
    learning_rate: Positive = 1e-3
    gamma: Decay = 0.99
    batch_size: Count = 256
    normalize_observation: bool = False
    normalize_reward: bool = False


@dataclasses.dataclass(frozen=True)
class OffPolicySettings(Sb3Settings):
    """Learners with a replay buffer.

    Attributes:
      buffer_size, learning_starts: agent steps.
      train_freq: steps of all simulations together (`simulations` agent steps) between updates.
      gradient_steps: updates each time.
      tau: share by which an update moves the target networks.
    """

    buffer_size: Count = 1_000_000
    learning_starts: Natural = 5_000
    tau: Share = 0.005
    train_freq: Count = 1
    gradient_steps: Count = 4


@dataclasses.dataclass(frozen=True)
class Sb3SacSettings(OffPolicySettings):
    """SB3's SAC; `ent_coef` and `target_entropy` as there, numbers or "auto"."""

    ent_coef: Positive | Literal["auto"] = "auto"
    target_entropy: float | Literal["auto"] = "auto"


@dataclasses.dataclass(frozen=True)
class TqcSettings(Sb3SacSettings):
    """sb3-contrib's TQC: SAC on quantiles, the highest of which are dropped."""

    n_critics: Count = 2
    n_quantiles: Count = 25
    top_quantiles_to_drop_per_net: Natural = 2


@dataclasses.dataclass(frozen=True)
class Td3Settings(OffPolicySettings):
    """SB3's TD3.

    Attributes:
      action_noise: standard deviation of the noise on actions, while training and in the exported policy.
    """

    policy_delay: Count = 2
    target_policy_noise: NonNegative = 0.2
    target_noise_clip: NonNegative = 0.5
    action_noise: NonNegative = 0.1


@dataclasses.dataclass(frozen=True)
class PpoSettings(Sb3Settings):
    """SB3's PPO; `n_steps` agent steps of every simulation between updates."""

    simulations: Count = 64
    hidden: tuple[Count, ...] = (256, 256)
    learning_rate: Positive = 3e-4
    batch_size: Count = 512
    normalize_observation: bool = True
    normalize_reward: bool = True
    n_steps: Count = 128
    n_epochs: Count = 10
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NonNegative = 0.0
    vf_coef: NonNegative = 0.5
    max_grad_norm: Positive = 0.5


def settings_class(algorithm: str) -> type:
    """The settings data class of an algorithm.

    Raises:
      UnknownNameError: there is no such algorithm; lists the known ones.
    """
    if algorithm not in ALGORITHMS:
        raise UnknownNameError("algorithm", algorithm, ALGORITHMS)
    module, name = ALGORITHMS[algorithm].split(":")
    return getattr(importlib.import_module(module), name)


def check_settings(algorithm: str, values: Mapping[str, Any]) -> Any:
    """Settings of an algorithm from names and values; what is not given has its default.

    Raises:
      DmcvbError: an unknown setting (lists the known ones), or a value out of range or of another type.
    """
    kind = settings_class(algorithm)
    known = [field.name for field in dataclasses.fields(kind)]
    for name in values:
        if name not in known:
            raise UnknownNameError(f"setting of {algorithm}", name, known)
    try:
        return pydantic.TypeAdapter(kind).validate_python(dict(values))
    except pydantic.ValidationError as error:
        problem = error.errors()[0]
        name, default = problem["loc"][0], getattr(kind(), str(problem["loc"][0]))
        raise DmcvbError(
            f"setting {name} of {algorithm} is {values[name]!r}: {problem['msg'][0].lower()}{problem['msg'][1:]}; "
            f"the default is {default!r}"
        ) from None
