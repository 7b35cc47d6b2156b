"""The header of a policy file: checked JSON, and the weights that it asks for."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

import pydantic

FORMAT_VERSION = 2
"""2: a network that knows the way may come before the actor (`way`)."""
WAY_SIZE = 4
"""What the network that knows the way sees: x and y of the ant, x and y of the goal."""
LOG_STD_RANGE = (-20.0, 2.0)
"""Where the log standard deviation of a squashed Gaussian is clipped (Haarnoja et al. 2018)."""
MAX_LAYERS, MAX_WIDTH = 16, 65_536
"""Hidden layers, and units of one, that a header may ask for."""
OWN_CODE = "own-code"
"""Algorithm of a behaviour that is a function of the user's."""
ORIGINS = {
    "sac": "by soft actor-critic (SAC)",
    "mpo": "by maximum a posteriori policy optimization (MPO)",
    "guided": "on a policy of the open maze, by imitation of a guide that knows the way (DAgger)",
    "sb3": "by Stable-Baselines3, outside of this package",
    "cleanrl": "by CleanRL, outside of this package",
    "torch": "by other programs (a torch state dict)",
}
"""Algorithm -> how a policy of it was trained, after "trained ..."."""
Width = Annotated[int, pydantic.Field(gt=0, le=MAX_WIDTH)]


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Evaluation(_Model):
    """Returns of a policy over fresh episodes.

    Attributes:
      mode: "mean" or "sampled" actions.
      success: share of episodes that the task ended (mazes), else None.
    """

    mean: float
    std: float
    episodes: int = pydantic.Field(gt=0)
    mode: Literal["mean", "sampled"]
    seed: int
    quartiles: tuple[float, float, float, float, float] | None = None
    success: float | None = None
    speed: float | None = None


class PolicyHeader(_Model):
    """Header of a policy file.

    Attributes:
      task: the task's id.
      observation: the name of what it sees, `task.observation`.
      algorithm: algorithm that trained it, e.g. "sac"; `origin_of` says it in words.
      agent_step: environment steps (at its action repeat) it was trained for.
      action_repeat: control steps that its actions were held in training; files leave out 2.
      hidden: widths of the hidden layers.
      layer_norm: False, as files of format 1 and 2 say; no hidden layer is normalized.
      distribution: "squashed_gaussian": tanh(mean + std * noise); "gaussian": clipped to [-1, 1];
        "deterministic": the mean, with fixed `noise` added when sampling.
      way: widths of the hidden layers of the network that says where to head in a maze (`policies.open_maze`); None:
        the policy heads for its goal.
      clip_observation: normalized observations are clipped to +- this.
      training: settings, seed, wall time, versions; of a picked policy also `selection`, what it was picked for, and
        `curve`, the steps and returns of its run's evaluations.
      command: command that trained it, by the version that `training` names.
    """

    format: Literal["dmcvb-gen policy"] = "dmcvb-gen policy"
    format_version: int = FORMAT_VERSION
    task: str
    observation: str | None = None
    observation_size: Width
    action_size: Width
    algorithm: str
    agent_step: int = pydantic.Field(ge=0)
    action_repeat: Literal[1, 2, 4] = 2
    level: str | None = None
    hidden: Annotated[tuple[Width, ...], pydantic.Field(max_length=MAX_LAYERS)]
    way: Annotated[tuple[Width, ...] | None, pydantic.Field(max_length=MAX_LAYERS)] = None
    activation: Literal["relu", "tanh", "elu", "gelu"] = "relu"
    layer_norm: Literal[False] = False
    distribution: Literal["squashed_gaussian", "gaussian", "deterministic"] = "squashed_gaussian"
    noise: float = 0.0
    clip_observation: float = 10.0
    evaluation: Evaluation | None = None
    training: dict[str, Any] = {}
    command: str = ""

    @pydantic.model_serializer(mode="wrap")
    def _without_usual_repeat(self, write: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Headers of DMC-VB's action repeat stay as they were before others could be had."""
        return {name: value for name, value in write(self).items() if (name, value) != ("action_repeat", 2)}

    @property
    def acts_every(self) -> int | None:
        """Control steps for which its actions are held; None of the user's code and of other programs' policies."""
        outside = self.algorithm == OWN_CODE or "converted_from" in self.training
        return None if outside else self.action_repeat


def origin_of(algorithm: str) -> str:
    """Say how policies of an algorithm are trained, in a few words that follow "trained ..."."""
    program, _, name = algorithm.partition(":")
    return f"by Stable-Baselines3's {name}" if name and program == "sb3" else ORIGINS.get(algorithm, f"by {algorithm}")


def weight_shapes(header: PolicyHeader) -> dict[str, tuple[int, ...]]:
    """name -> shape of the weights of a header's actor, an MLP from observations to parameters of the distribution.

    `body.<i>` are hidden layers (numbered with their activations), `mean` and `log_std` the heads (for
    "gaussian" a free vector `log_std_vector`); `observation_mean` and `observation_std` normalize what comes in.
    `way.<i>` are the layers of the network that knows the way, if there is one.
    """
    layers: dict[str, tuple[int, int]] = {}  # inputs and outputs
    body = (header.observation_size, *header.hidden)
    way = (WAY_SIZE, *header.way, 2) if header.way is not None else ()
    for name, widths in (("way", way), ("body", body)):
        layers |= {f"{name}.{2 * index}": pair for index, pair in enumerate(itertools.pairwise(widths))}
    for head in ("mean", "log_std") if header.distribution == "squashed_gaussian" else ("mean",):
        layers[head] = body[-1], header.action_size
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (inputs, outputs) in layers.items():
        shapes |= {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}
    if header.distribution == "gaussian":
        shapes["log_std_vector"] = (header.action_size,)
    observation = (header.observation_size,)
    return shapes | {"observation_mean": observation, "observation_std": observation}
