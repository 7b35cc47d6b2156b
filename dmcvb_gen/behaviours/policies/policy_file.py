"""Behaviour policies and their files: observations in, actions out; safetensors weights with a checked JSON header.

A file holds the weights of an actor and, in the safetensors metadata, one JSON header that says which
task it is for, how its network is built, how observations are normalized, how it was trained and what it
returned. Loading one runs no code from the file and refuses what does not fit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pydantic
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from safetensors.torch import save as dump_safetensors
from torch import nn

from dmcvb_gen.errors import PolicyFileError
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import Task

FORMAT_VERSION = 1
LOG_STD_RANGE = (-20.0, 2.0)
"""Where the log standard deviation of a squashed Gaussian is clipped (Haarnoja et al. 2018)."""
_ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "gelu": nn.GELU}


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Evaluation(_Model):
    """Returns of a policy over fresh episodes.

    Attributes:
      mode: "sampled" or "deterministic" actions.
      success: share of episodes that the task ended (mazes), else None.
    """

    mean: float
    std: float
    episodes: int = pydantic.Field(gt=0)
    mode: Literal["sampled", "deterministic"]
    seed: int
    quartiles: tuple[float, float, float, float, float] | None = None
    success: float | None = None
    speed: float | None = None


class PolicyHeader(_Model):
    """What a policy file says of itself.

    Attributes:
      task: the task's id.
      observation: the name of what it sees, `task.observation`.
      algorithm: what trained it, e.g. "sac".
      agent_step: environment steps (at action repeat 2) it was trained for.
      hidden: widths of the hidden layers.
      layer_norm: whether each hidden layer is normalized before its activation.
      distribution: "squashed_gaussian": tanh(mean + std * noise); "gaussian": clipped to [-1, 1];
        "deterministic": the mean, with fixed `noise` added when sampling.
      clip_observation: normalized observations are clipped to +- this.
      training: settings, seed, wall time, versions.
      command: what trains it again.
    """

    format: Literal["dmcvb-gen policy"] = "dmcvb-gen policy"
    format_version: int = FORMAT_VERSION
    task: str
    observation: str | None = None
    observation_size: int = pydantic.Field(gt=0)
    action_size: int = pydantic.Field(gt=0)
    algorithm: str
    agent_step: int = pydantic.Field(ge=0)
    level: str | None = None
    hidden: tuple[int, ...]
    activation: Literal["relu", "tanh", "elu", "gelu"] = "relu"
    layer_norm: bool = False
    distribution: Literal["squashed_gaussian", "gaussian", "deterministic"] = "squashed_gaussian"
    noise: float = 0.0
    clip_observation: float = 10.0
    evaluation: Evaluation | None = None
    training: dict[str, Any] = {}
    command: str = ""


class Actor(nn.Module):
    """An MLP from normalized observations to the parameters of the action distribution.

    Weights: `body.<i>` hidden layers, `mean`, and `log_std` (a head of the body) or, for "gaussian", a free
    vector `log_std_vector`; buffers `observation_mean`, `observation_std` (observation,).
    """

    def __init__(self, header: PolicyHeader):
        super().__init__()
        self.header = header
        layers: list[nn.Module] = []
        width = header.observation_size
        for hidden in header.hidden:
            layers.append(nn.Linear(width, hidden))
            if header.layer_norm:
                layers.append(nn.LayerNorm(hidden))
            layers.append(_ACTIVATIONS[header.activation]())
            width = hidden
        self.body = nn.Sequential(*layers)
        self.mean = nn.Linear(width, header.action_size)
        if header.distribution == "squashed_gaussian":
            self.log_std = nn.Linear(width, header.action_size)
        elif header.distribution == "gaussian":
            self.log_std_vector = nn.Parameter(torch.zeros(header.action_size))
        self.register_buffer("observation_mean", torch.zeros(header.observation_size))
        self.register_buffer("observation_std", torch.ones(header.observation_size))

    def normalize(self, observation: torch.Tensor) -> torch.Tensor:
        limit = self.header.clip_observation
        return ((observation - self.observation_mean) / self.observation_std).clamp(-limit, limit)

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(n, observation) -> mean and standard deviation before squashing, each (n, action)."""
        features = self.body(self.normalize(observation))
        mean = self.mean(features)
        if self.header.distribution == "squashed_gaussian":
            std = self.log_std(features).clamp(*LOG_STD_RANGE).exp()
        elif self.header.distribution == "gaussian":
            std = self.log_std_vector.exp().expand_as(mean)
        else:
            std = torch.full_like(mean, self.header.noise)
        return mean, std


class Policy:
    """A behaviour policy: observations in, actions out, one network call for a whole batch.

    Attributes:
      header: where it comes from; None for uniform random actions.
      digest: SHA-256 over header and weights ("random" for uniform random actions).
    """

    def __init__(self, header: PolicyHeader, actor: Actor, digest: str):
        self.header, self._actor, self.digest = header, actor.eval().requires_grad_(False), digest

    @property
    def weights(self) -> dict[str, torch.Tensor]:
        """The actor's weights, float32."""
        return self._actor.state_dict()

    def act(
        self,
        observation: np.ndarray,
        generators: Sequence[np.random.Generator] | None = None,
        deterministic: bool = False,
    ) -> np.ndarray:
        """Actions for a batch.

        Args:
          observation: (n, observation), an episode batch's `behaviour_observation`.
          generators: one a row, the source of its noise; needed unless deterministic.
          deterministic: take the mean action.

        Returns:
          (n, action) float32 in [-1, 1].
        """
        with torch.inference_mode():
            mean, std = self._actor(torch.from_numpy(np.ascontiguousarray(observation, np.float32)))
            value = mean
            if not deterministic:
                noise = np.stack([rng.standard_normal(mean.shape[1], np.float32) for rng in generators])
                value = mean + std * torch.from_numpy(noise)
            if self.header.distribution == "gaussian":
                return value.clamp(-1, 1).numpy()
            if self.header.distribution == "deterministic":
                return (torch.tanh(mean) + (value - mean)).clamp(-1, 1).numpy()
            return torch.tanh(value).numpy()


class RandomPolicy(Policy):
    """Actions uniform in [-1, 1] (level "random")."""

    def __init__(self, action_size: int):
        self.header, self.digest, self._action_size = None, "random", action_size

    def act(self, observation, generators=None, deterministic=False):
        if deterministic:
            return np.zeros((len(observation), self._action_size), np.float32)
        draws = [rng.random(self._action_size, np.float32) for rng in generators]
        return np.stack(draws) * np.float32(2) - np.float32(1)


def random_policy(task: Task) -> Policy:
    """Uniform random actions for a task."""
    return RandomPolicy(task.action_size)


def save_policy(path: str | Path, header: PolicyHeader, weights: Mapping[str, torch.Tensor]) -> None:
    """Write a policy file atomically.

    Args:
      weights: the state dict of an `Actor` of this header, kept as float32.
    """
    tensors = {name: value.detach().float().contiguous().cpu() for name, value in weights.items()}
    data = dump_safetensors(tensors, metadata={"header": header.model_dump_json()})
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.partial")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_header(path: str | Path) -> PolicyHeader:
    """The header of a policy file, see `load_policy` for what is refused."""
    return _read(Path(path))[0]


def _read(path: Path) -> tuple[PolicyHeader, dict[str, torch.Tensor], str]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PolicyFileError(f"cannot read policy file {path}: {error.strerror}; give the path of one") from None
    try:
        size = int.from_bytes(data[:8], "little")
        metadata = json.loads(data[8 : 8 + size]).get("__metadata__", {})
        header = PolicyHeader.model_validate_json(metadata["header"])
        weights = load_safetensors(data)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PolicyFileError(
            f"{path} is not a whole policy file ({reason}); copy it again or export it with select-checkpoints"
        ) from None
    if header.format_version > FORMAT_VERSION:
        raise PolicyFileError(f"{path} has format version {header.format_version}; install a newer dmcvb-gen")
    return header, weights, hashlib.sha256(data).hexdigest()


def load_policy(path: str | Path, task: Task | None = None) -> Policy:
    """Load a policy file.

    Args:
      task: the task it must be for; the header's own by default.

    Raises:
      PolicyFileError: the file is not whole, is for another task, or its shapes or values do not fit.
    """
    path = Path(path)
    header, weights, digest = _read(path)
    if task is not None and header.task != task.id and not _same_family(header.task, task.id):
        raise PolicyFileError(f"{path} is a policy for {header.task}, not for {task.id}; give one trained on {task.id}")
    task = task or get_task(header.task)
    asked = (task.behaviour_size, task.action_size)
    if (header.observation_size, header.action_size) != asked:
        raise PolicyFileError(
            f"{path} maps {header.observation_size} observations to {header.action_size} actions, "
            f"{task.id} has {asked[0]} and {asked[1]}; train it again for this task"
        )
    if header.observation not in (None, task.observation):
        raise PolicyFileError(
            f"{path} sees {header.observation!r}, {task.id} shows {task.observation!r}; train it again for this task"
        )
    actor = Actor(header)
    wanted = {name: tuple(value.shape) for name, value in actor.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in weights.items()}
    if wanted != found:
        name = next(name for name in sorted(wanted | found) if wanted.get(name) != found.get(name))
        raise PolicyFileError(
            f"{path}: weight {name!r} has shape {found.get(name)}, its header asks for {wanted.get(name)}; "
            "the file was tampered with or written by another program"
        )
    for name, value in weights.items():
        if value.dtype != torch.float32 or not bool(torch.isfinite(value).all()):
            raise PolicyFileError(f"{path}: weight {name!r} holds values that are not finite float32; export it again")
    if not bool((weights["observation_std"] > 0).all()):
        raise PolicyFileError(f"{path}: observation_std is not positive; export it again")
    actor.load_state_dict(weights)
    return Policy(header, actor, digest)


def _same_family(first: str, second: str) -> bool:
    """Ant-maze policies never see the layout, so one may be used (and warm-started) in another maze."""
    return first.startswith("ant-maze") and second.startswith("ant-maze")
