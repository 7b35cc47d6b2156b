"""Check the settings of the learners and turn them into data classes."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.policies.header import MAX_LAYERS, Width

Count = Annotated[int, Field(gt=0)]
Natural = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]
Hidden = Annotated[tuple[Width, ...], Field(max_length=MAX_LAYERS)]
"""Widths of hidden layers, as many and as large as a policy file may have."""

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
class ReplaySettings:
    """How the package's own learners with a replay buffer collect episodes and learn from them.

    Attributes:
      simulations: episodes stepped side by side.
      updates_per_step: gradient updates an agent step (all simulations together count `simulations` steps).
      warmup_steps: agent steps of uniform random actions before the first update.
      buffer_size: agent steps remembered.
      batch_size: transitions an update.
      actor_hidden: widths of the policy's hidden layers.
      critic_hidden: widths of each critic's hidden layers.
      critics: number of critics.
      learning_rate: learning rate of policy and critics.
      discount: discount of an agent step.
      shaping: weight of the task's shaping term added to the training reward (never to an evaluation).
      progress: mazes: weight of the meters of shortest path covered in a step, added to the training reward (never to
        an evaluation). DMC-VB's own reward is flat in the whole goal cell.
      standing_starts: share of training episodes that start in the model's own pose (humanoid: standing)
        instead of the task's initial states; evaluations always start as the task does.
      sunken_starts: mazes: share of training episodes that start deep in the floor, which flings an ant up; what it
        does in the air decides whether it comes down on its feet.
      mean_share: share of the simulations that act by the mean, as data are made: a policy that only ever collects
        with noise never sees the places where its mean stands still.
      train_episode_steps: cut training episodes off after so many agent steps (0: the task's limit).
      compile: compile the updates. Without a C++ compiler a warning says that they run uncompiled.
    """

    simulations: Count = 8
    updates_per_step: Positive = 1.0
    warmup_steps: Natural = 5000
    buffer_size: Count = 1_000_000
    batch_size: Count = 256
    actor_hidden: Hidden = (256, 256)
    critic_hidden: Annotated[Hidden, Field(min_length=1)] = (256, 256)
    critics: Count = 2
    learning_rate: Positive = 1e-3
    discount: Decay = 0.99
    shaping: NonNegative = 0.0
    progress: NonNegative = 0.0
    standing_starts: Share = 0.0
    sunken_starts: Share = 0.0
    mean_share: Share = 0.0
    train_episode_steps: Natural = 0
    compile: bool = True


@dataclasses.dataclass(frozen=True)
class Sb3Settings:
    """Settings of all Stable-Baselines3 learners; names and meanings are SB3's if it has them.

    Attributes:
      simulations: episodes stepped side by side.
      hidden: widths of the hidden layers, actor's and critics'.
      learning_rate: learning rate of all networks.
      gamma: discount of an agent step.
      batch_size: transitions an update.
      normalize_observation, normalize_reward: running normalization (VecNormalize); observation statistics go into
        the policy files.
    """

    simulations: Count = 8
    hidden: Hidden = (256, 256)
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
    """SB3's SAC.

    Attributes:
      ent_coef: weight of the entropy bonus, or "auto": learned.
      target_entropy: entropy that the learned weight aims at, or "auto": minus the action size.
    """

    ent_coef: Positive | Literal["auto"] = "auto"
    target_entropy: float | Literal["auto"] = "auto"


@dataclasses.dataclass(frozen=True)
class TqcSettings(Sb3SacSettings):
    """sb3-contrib's TQC: SAC on quantiles, the highest of which are dropped.

    Attributes:
      n_critics: number of critics.
      n_quantiles: quantiles of the return that each critic gives.
      top_quantiles_to_drop_per_net: highest quantiles of each critic that targets leave out.
    """

    n_critics: Count = 2
    n_quantiles: Count = 25
    top_quantiles_to_drop_per_net: Natural = 2


@dataclasses.dataclass(frozen=True)
class Td3Settings(OffPolicySettings):
    """SB3's TD3.

    Attributes:
      policy_delay: an actor update every so many critic updates.
      target_policy_noise: standard deviation of the noise on the targets' actions.
      target_noise_clip: largest such noise.
      action_noise: standard deviation of the noise on actions, while training and in the exported policy.
    """

    policy_delay: Count = 2
    target_policy_noise: NonNegative = 0.2
    target_noise_clip: NonNegative = 0.5
    action_noise: NonNegative = 0.1


@dataclasses.dataclass(frozen=True)
class PpoSettings(Sb3Settings):
    """SB3's PPO.

    Attributes:
      n_steps: agent steps of every simulation between updates.
      n_epochs: passes over these steps.
      gae_lambda: lambda of the generalized advantage estimates.
      clip_range: share by which an update may change an action's probability.
      ent_coef: weight of the entropy bonus.
      vf_coef: weight of the value function's loss.
      max_grad_norm: gradients are scaled down to this norm.
    """

    simulations: Count = 64
    hidden: Hidden = (256, 256)
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


def describe_settings(algorithm: str) -> dict[str, str]:
    """Name -> meaning of every setting of an algorithm, from the docstrings of its class and of those above it.

    Raises:
      UnknownNameError: there is no such algorithm; lists the known ones.
    """
    kind, meanings = settings_class(algorithm), {}
    for owner in reversed(kind.__mro__):
        listed = inspect.cleandoc(vars(owner).get("__doc__") or "").partition("\nAttributes:\n")[2]
        for names, text in re.findall(r"^  ([\w, ]+): (.+(?:\n   .+)*)", listed, re.MULTILINE):
            meaning = " ".join(text.split())
            meanings |= dict.fromkeys(names.split(", "), meaning[0].upper() + meaning[1:])
    return {field.name: meanings[field.name] for field in dataclasses.fields(kind)}


def check_settings(algorithm: str, values: Mapping[str, Any]) -> Any:
    """Settings of an algorithm from names and values; what is not given has its default.

    Raises:
      DmcvbError: an unknown setting (lists the known ones), or a value out of range or of another type.
    """
    kind = settings_class(algorithm)
    known = [field.name for field in dataclasses.fields(kind)]
    for name in values:
        if name not in known:
            raise UnknownNameError(f"setting of {algorithm}", name, known, "--list-settings lists them all")
    try:
        return pydantic.TypeAdapter(kind).validate_python(dict(values))
    except pydantic.ValidationError as error:
        problem = error.errors()[0]
        name, default = problem["loc"][0], getattr(kind(), str(problem["loc"][0]))
        raise DmcvbError(
            f"setting {name} of {algorithm} is {values[name]!r}: {problem['msg'][0].lower()}{problem['msg'][1:]}; "
            f"the default is {default!r}"
        ) from None
