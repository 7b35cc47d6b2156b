"""Soft actor-critic on batched simulations, with a squashed Gaussian actor.

SAC (Haarnoja et al. 2018) with what makes humanoids learnable and CPUs fast: running observation
normalization, LayerNorm in the critics, both critics as one batched product, bfloat16 products if the
processor has them, compiled updates.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from dmcvb_gen.compilation import compiled
from dmcvb_gen.policies.header import LOG_STD_RANGE, PolicyHeader
from dmcvb_gen.training.networks import Actor
from dmcvb_gen.training.row_files import map_rows, rows_in
from dmcvb_gen.training.settings import Count, Decay, Natural, NonNegative, Positive, ReplaySettings


@dataclass(frozen=True)
class SacSettings(ReplaySettings):
    """Settings of `Sac`; the defaults of a task are in data/defaults.yaml.

    Attributes:
      actor_every: an actor update every so many critic updates.
      target_decay: share of the target critics that an update keeps.
      initial_temperature: weight of the entropy bonus at the start; it is learned.
      target_entropy_scale: the target entropy is minus this times the action size.
      sharpen_after: agent steps after which the target entropy is that of `sharp_entropy_scale` and the learning rate
        `sharp_learning_rate` (0: never). A policy that explores loses return to its own noise, one that learns fast
        swings from checkpoint to checkpoint; the end of a run can do without both.
      sharp_entropy_scale: see `sharpen_after`.
      sharp_learning_rate: see `sharpen_after`; 0: as before.
      n_step: rewards summed before a target bootstraps, on the way that the episode really took.
      n_step_half_life: the share of such targets is 1 / (1 + agent steps / this), others look one step ahead (0: all of
        them always). They learn faster at first, and what old actions earned misleads them later.
      bins: critics give a distribution over so many returns and learn it by cross-entropy (Farebrother et al. 2024,
        "Stop Regressing"); 0: they give a number and learn by squared error.
      reward_scale: multiplies rewards before learning; 0: the inverse of the spread of discounted returns, as it grows.
      soft_values: targets hold the entropy bonus of later steps, as in SAC. Without it critics give returns alone, so
        that their range does not depend on the action size, and entropy only regularizes the actor.
      rate_half_life: agent steps after which learning rates have fallen to 1 / sqrt(2); they fall with the square root
        of the steps (0: never).
      clipped: targets and actor use the smallest critic's value (off: their mean, less pessimistic, which hard
        tasks want).
      weight_decay: weight decay of AdamW, on actor and critics.
      bfloat16: hidden layers' products in bfloat16 (weights and optimizer stay float32).
    """

    actor_every: Count = 2
    target_decay: Decay = 0.995
    initial_temperature: Positive = 0.1
    target_entropy_scale: float = 0.5
    sharpen_after: Natural = 0
    sharp_entropy_scale: float = 1.5
    sharp_learning_rate: NonNegative = 0.0
    n_step: Count = 1
    n_step_half_life: Natural = 0
    bins: Natural = 0
    reward_scale: NonNegative = 0.5
    soft_values: bool = True
    rate_half_life: Natural = 0
    clipped: bool = True
    weight_decay: NonNegative = 0.0
    bfloat16: bool = False


RETURN_LIMIT = 5.0
"""Scaled discounted returns stay within this: the largest seen is scaled to it if the spread alone does not."""
SUPPORT = 1.2 * RETURN_LIMIT
"""Largest absolute return of the bins; the entropy bonus needs some room."""
SMOOTHING = 0.75
"""Standard deviation of a target's smoothing over bins, in bins (Farebrother et al. 2024, section 3)."""


class ReturnScale:
    """The factor by which rewards are scaled: the inverse of the spread of the discounted returns that were seen.

    Follows SimbaV2 (Lee et al. 2025): divides by the standard deviation, or by the largest return over `RETURN_LIMIT`
    if that is more. Rewards of any task then need no scale of their own.
    """

    def __init__(self, simulations: int, discount: float):
        self._discount, self._running = discount, np.zeros(simulations)
        self._norm, self.largest = RunningNorm(1), 0.0

    def update(self, reward: np.ndarray, ended: np.ndarray) -> None:
        """Take in a step's rewards, (simulation,), and which episodes ended with it."""
        self._running = self._discount * self._running + reward
        self._norm.update(self._running[:, None])
        self.largest = max(self.largest, float(np.abs(self._running).max()))
        self._running[ended] = 0

    def __float__(self) -> float:
        spread = max(float(np.sqrt(self._norm.m2 / self._norm.count)[0]), self.largest / RETURN_LIMIT)
        return 1 / max(spread, 1e-3)

    def state(self) -> dict[str, torch.Tensor]:
        """Return the state that it continues from."""
        numbers = [self._norm.count, float(self._norm.mean[0]), float(self._norm.m2[0]), self.largest]
        running = torch.from_numpy(self._running.copy())
        return {"numbers": torch.tensor(numbers, dtype=torch.float64), "running": running}

    def load_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Continue from `state()`."""
        count, mean, m2, self.largest = state["numbers"].tolist()
        self._norm.count, self._norm.mean, self._norm.m2 = count, np.array([mean]), np.array([m2])
        self._running = state["running"].numpy().copy()


class CriticEnsemble(nn.Module):
    """Critics Q(observation, action), evaluated in one batched product; LayerNorm after each hidden layer.

    Args:
      bins: outputs of a critic's head, see `SacSettings.bins`.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: tuple[int, ...],
        bfloat16: bool,
        critics: int = 2,
        bins: int = 0,
    ):
        super().__init__()
        self.bfloat16, self.bins = bfloat16, bins
        sizes = (observation_size + action_size, *hidden)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        self.scales, self.shifts = nn.ParameterList(), nn.ParameterList()
        for i, o in zip(sizes[:-1], sizes[1:], strict=True):
            self.weights.append(nn.Parameter(torch.stack([_init(i, o) for _ in range(critics)])))
            self.biases.append(nn.Parameter(torch.zeros(critics, 1, o)))
            self.scales.append(nn.Parameter(torch.ones(critics, 1, o)))
            self.shifts.append(nn.Parameter(torch.zeros(critics, 1, o)))
        outputs = max(bins, 1)
        self.head = nn.Parameter(torch.stack([_init(sizes[-1], outputs) for _ in range(critics)]) * 0.1)
        self.head_bias = nn.Parameter(torch.zeros(critics, 1, outputs))
        if bins:
            edges = torch.linspace(-SUPPORT, SUPPORT, bins + 1)
            self.register_buffer("edges", edges, persistent=False)
            self.register_buffer("centers", (edges[1:] + edges[:-1]) / 2, persistent=False)

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(n, observation), (n, action) -> (critic, n) values."""
        outputs = self.outputs(observation, action)
        if not self.bins:
            return outputs.squeeze(-1)
        return (outputs.softmax(dim=-1) * self.centers).sum(dim=-1)

    def loss(self, observation: torch.Tensor, action: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """(1): squared error, or cross-entropy, of targets (n,), its mean over rows and sum over critics."""
        outputs = self.outputs(observation, action)
        if not self.bins:
            return ((outputs.squeeze(-1) - target) ** 2).mean(dim=1).sum()
        width = 2 * SUPPORT / self.bins
        target = target.clamp(-SUPPORT + width, SUPPORT - width)
        below = torch.erf((self.edges - target[:, None]) / (math.sqrt(2) * SMOOTHING * width))
        wanted = (below[:, 1:] - below[:, :-1]) / (below[:, -1:] - below[:, :1])  # (n, bin), one in sum
        return -(wanted * outputs.log_softmax(dim=-1)).sum(dim=-1).mean(dim=1).sum()

    def outputs(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(n, observation), (n, action) -> (critic, n, max(bins, 1))."""
        x = torch.cat([observation, action], dim=1).expand(len(self.head), -1, -1)
        for weight, bias, scale, shift in zip(self.weights, self.biases, self.scales, self.shifts, strict=True):
            if self.bfloat16:
                x = torch.bmm(x.bfloat16(), weight.bfloat16()).float() + bias
            else:
                x = torch.baddbmm(bias, x, weight)
            x = nn.functional.layer_norm(x, x.shape[-1:]) * scale + shift
            x = nn.functional.relu(x)
        return torch.baddbmm(self.head_bias, x, self.head)


def _init(inputs: int, outputs: int) -> torch.Tensor:
    bound = math.sqrt(3.0 / inputs)
    return torch.empty(inputs, outputs).uniform_(-bound, bound)


class RowBuffer:
    """The latest rows of named float32 fields, in memory-mapped files, so that a killed run finds them again.

    Args:
      size: rows kept.
      shapes: name -> shape of one row of the field.
      folder: folder of the files; None keeps them in memory.
    """

    def __init__(self, size: int, shapes: Mapping[str, tuple[int, ...]], folder: Path | None = None):
        self.position, self.full = 0, False
        self.found = 0
        """Rows that the files held before they were opened."""
        if folder is None:
            self.arrays = {name: np.zeros((size, *shape), np.float32) for name, shape in shapes.items()}
        else:
            paths = {name: folder / f"{name}.f32" for name in shapes}
            self.found = min(rows_in(paths[name], shape) for name, shape in shapes.items())
            size = max(size, self.found)
            self.arrays = {name: map_rows(paths[name], size, shape)[:size] for name, shape in shapes.items()}
        self.size = size

    def restore(self, position: int, full: bool, rows: int) -> None:
        """Continue where a run was saved, whose buffer had `rows` rows."""
        # A full buffer that has grown since is not full any more: what is new lies behind the old rows.
        self.position, self.full = (rows, False) if full and self.size > rows else (position, full)

    def flush(self) -> None:
        """Hand everything to the disk."""
        for array in self.arrays.values():
            if isinstance(array, np.memmap):
                array.flush()

    def __len__(self) -> int:
        return self.size if self.full else self.position

    def add(self, **values: np.ndarray) -> None:
        """Append one row of each simulation, (n, ...) a field."""
        count = len(next(iter(values.values())))
        rows = (self.position + np.arange(count)) % self.size
        for name, value in values.items():
            self.arrays[name][rows] = value
        self.full |= self.position + count >= self.size
        self.position = (self.position + count) % self.size

    def sample(self, rng: np.random.Generator, count: int) -> dict[str, torch.Tensor]:
        """`count` rows drawn uniformly, float32 tensors."""
        rows = rng.integers(0, len(self), count)
        return {name: torch.from_numpy(np.asarray(array[rows])) for name, array in self.arrays.items()}


class ReplayBuffer(RowBuffer):
    """Transitions of simulations side by side; rows of one simulation lie `simulations` rows apart.

    Args:
      simulations: rows of an `add`.
    """

    def __init__(
        self, size: int, observation_size: int, action_size: int, simulations: int, folder: Path | None = None
    ):
        self._simulations = simulations
        shapes = {
            "observation": (observation_size,),
            "next_observation": (observation_size,),
            "action": (action_size,),
            "reward": (),
            "terminated": (),
            "ended": (),
        }
        super().__init__(size, shapes, folder)

    def restore(self, position: int, full: bool, rows: int) -> None:
        super().restore(position, full, rows)
        # If it has grown after it wrapped, rows do not follow each other any more where the ring was closed.
        if full and not self.full and position:
            for end in (position, rows):
                self.arrays["ended"][max(end - self._simulations, 0) : end] = 1

    def sample_steps(
        self, rng: np.random.Generator, count: int, steps: int, discount: float, share: float = 1.0
    ) -> dict[str, torch.Tensor]:
        """`count` rows drawn uniformly, each with the `steps` steps that followed, as far as its episode went on.

        Args:
          steps: steps of a row at most.
          share: share of the rows that have them; others are single steps.

        Returns:
          float32 tensors: observation, action; reward, the discounted sum of the steps' rewards (n,); next_observation,
          where they led; discount (n,) of the value there, 0 if the episode terminated.
        """
        first = rng.integers(0, len(self), count)
        newer = (self.position - 1 - first) % self.size  # rows that were added after
        last, factor = first.copy(), np.ones(count, np.float32)
        reward = np.array(self.arrays["reward"][first])
        goes_on = self.arrays["ended"][first] == 0
        if share < 1:
            goes_on &= rng.random(count) < share
        for step in range(1, steps):
            goes_on &= step * self._simulations <= newer
            rows = (first + step * self._simulations) % self.size
            last = np.where(goes_on, rows, last)
            factor = np.where(goes_on, factor * np.float32(discount), factor)
            reward += np.where(goes_on, factor * self.arrays["reward"][last], np.float32(0))
            goes_on &= self.arrays["ended"][last] == 0
        values = {
            "observation": self.arrays["observation"][first],
            "action": self.arrays["action"][first],
            "reward": reward,
            "next_observation": self.arrays["next_observation"][last],
            "discount": (factor * np.float32(discount) * (1 - self.arrays["terminated"][last])).astype(np.float32),
        }
        return {name: torch.from_numpy(np.asarray(value)) for name, value in values.items()}


class RunningNorm:
    """Mean and variance of all observations seen (Welford, batched)."""

    def __init__(self, size: int):
        self.count, self.mean, self.m2 = 1e-4, np.zeros(size), np.ones(size) * 1e-4

    def update(self, values: np.ndarray) -> None:
        count, mean = len(values), values.mean(axis=0)
        delta, total = mean - self.mean, self.count + count
        self.m2 += values.var(axis=0) * count + delta**2 * self.count * count / total
        self.mean += delta * count / total
        self.count = total

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(self.m2 / self.count).clip(1e-2)


class ReplayLearner(abc.ABC):
    """Base of learners from a replay buffer: an actor, running statistics of observations, and what `update` needs.

    Attributes of subclasses:
      _parts, _optimizers: names of the networks and optimizers that `state` holds.
    """

    _parts: tuple[str, ...]
    _optimizers: tuple[str, ...]

    def __init__(self, header: PolicyHeader, settings: Any, seed: int):
        torch.manual_seed(seed)
        self.settings, self.actor = settings, Actor(header)
        self.norm = RunningNorm(header.observation_size)
        self.returns = ReturnScale(settings.simulations, settings.discount)
        self.updates = 0

    @abc.abstractmethod
    def update(self, batch: dict[str, torch.Tensor]) -> None:
        """One gradient step on rows of the buffer."""

    @abc.abstractmethod
    def metrics(self) -> dict[str, float]:
        """Numbers of the last update, for the log."""

    def begin_round(self, step: int) -> None:
        """Called at every agent step of the simulations, before its updates."""
        self.sync_norm()

    def sync_norm(self) -> None:
        """Put the running statistics into the actor, where every network reads them."""
        self.actor.observation_mean.copy_(torch.from_numpy(self.norm.mean))
        self.actor.observation_std.copy_(torch.from_numpy(self.norm.std))

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Actions for collecting, (n, observation) -> (n, action) float32: means in the first rows, samples below."""
        with torch.no_grad():
            mean, std = self.actor(torch.from_numpy(np.ascontiguousarray(observation, np.float32)))
            noise = torch.randn_like(mean)
            noise[: round(self.settings.mean_share * len(noise))] = 0
            return torch.tanh(mean + std * noise).numpy()

    def state(self) -> dict[str, Any]:
        """Everything that learning continues from (tensors and plain numbers)."""
        norm = {
            "count": self.norm.count,
            "mean": torch.from_numpy(self.norm.mean),
            "m2": torch.from_numpy(self.norm.m2),
        }
        states = {name: getattr(self, name).state_dict() for name in (*self._parts, *self._optimizers)}
        numbers = {"norm": norm, "returns": self.returns.state(), "updates": self.updates}
        return states | numbers | {"torch_rng": torch.get_rng_state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.load_networks(state)
        for name in self._optimizers:
            getattr(self, name).load_state_dict(state[name])
        self.returns.load_state(state["returns"])
        self.updates = int(state["updates"])
        torch.set_rng_state(state["torch_rng"])

    def load_actor(self, weights: Mapping[str, torch.Tensor]) -> None:
        """Take the weights of a policy file.

        Raises:
          RuntimeError: they have other shapes.
        """
        self.actor.load_state_dict(weights)

    def load_networks(self, state: dict[str, Any]) -> None:
        """Take networks, temperature and normalization of `state()`, but no optimizer or random state.

        Raises:
          RuntimeError: they have other shapes.
        """
        for name in self._parts:
            getattr(self, name).load_state_dict(state[name])
        self.norm.count = float(state["norm"]["count"])
        self.norm.mean, self.norm.m2 = state["norm"]["mean"].numpy().copy(), state["norm"]["m2"].numpy().copy()


class Sac(ReplayLearner):
    """The learner: networks, optimizers, temperature; `update` does one step of all of them."""

    _parts = ("actor", "critic", "target")
    _optimizers = ("actor_optimizer", "critic_optimizer", "alpha_optimizer")

    def __init__(self, header: PolicyHeader, settings: SacSettings, seed: int):
        super().__init__(header, settings, seed)
        observation, action = header.observation_size, header.action_size
        sizes = (observation, action, settings.critic_hidden, settings.bfloat16, settings.critics, settings.bins)
        self.critic, self.target = CriticEnsemble(*sizes), CriticEnsemble(*sizes)
        self.target.load_state_dict(self.critic.state_dict())
        self.target.requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(math.log(settings.initial_temperature)))
        self.target_entropy = -settings.target_entropy_scale * action
        self._sharp_entropy = -settings.sharp_entropy_scale * action
        rate = settings.learning_rate
        decay = {"weight_decay": settings.weight_decay, "fused": True}
        self.actor_optimizer = torch.optim.AdamW(self.actor.parameters(), lr=rate, **decay)
        self.critic_optimizer = torch.optim.AdamW(self.critic.parameters(), lr=rate, **decay)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], lr=rate, fused=True)
        self._losses: dict[str, torch.Tensor] = {}
        self._critic_loss, self._actor_loss = self.critic_loss, self.actor_loss
        if settings.compile:
            self._critic_loss = compiled(self.critic_loss)
            self._actor_loss = compiled(self.actor_loss)

    def begin_round(self, step: int) -> None:
        super().begin_round(step)
        if self.settings.rate_half_life:
            rate = self.settings.learning_rate / math.sqrt(1 + step / self.settings.rate_half_life)
            for optimizer in (self.actor_optimizer, self.critic_optimizer):
                for group in optimizer.param_groups:
                    group["lr"] = rate
        self.sharpen(step)  # last, as its rate stands in for the falling one

    def sharpen(self, step: int) -> None:
        """Aim at the lower entropy, by smaller steps, from the agent step on that the settings name."""
        settings = self.settings
        if not settings.sharpen_after or step < settings.sharpen_after:
            return
        self.target_entropy = self._sharp_entropy
        for optimizer in (self.actor_optimizer, self.critic_optimizer, self.alpha_optimizer):
            for group in optimizer.param_groups:
                group["lr"] = settings.sharp_learning_rate or group["lr"]

    def sample_action(self, normalized: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Reparametrized action and its log probability, (n, action), (n,)."""
        x = normalized
        for layer in self.actor.body:
            if self.settings.bfloat16 and isinstance(layer, nn.Linear):
                x = nn.functional.linear(x.bfloat16(), layer.weight.bfloat16(), layer.bias.bfloat16()).float()
            else:
                x = layer(x)
        mean, log_std = self.actor.mean(x), self.actor.log_std(x).clamp(*LOG_STD_RANGE)
        noise = torch.randn_like(mean)
        before = mean + log_std.exp() * noise
        action = torch.tanh(before)
        log_prob = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2 * (math.log(2) - before - nn.functional.softplus(-2 * before))
        return action, log_prob.sum(dim=1)

    def reduce(self, values: torch.Tensor) -> torch.Tensor:
        """(critic, n) -> (n,): the value that targets and the actor believe."""
        return values.min(dim=0).values if self.settings.clipped else values.mean(dim=0)

    def critic_loss(self, observation, action, reward, discount, next_observation):
        """Return the loss of the critics against their Bellman targets, (1)."""
        with torch.no_grad():
            next_observation = self.actor.normalize(next_observation)
            next_action, log_prob = self.sample_action(next_observation)
            next_value = self.reduce(self.target(next_observation, next_action))
            if self.settings.soft_values:
                next_value = next_value - self.log_alpha.exp() * log_prob
            target = reward + discount * next_value
        return self.critic.loss(self.actor.normalize(observation), action, target)

    def actor_loss(self, observation):
        """E[alpha log pi - min Q] and the mean log probability."""
        observation = self.actor.normalize(observation)
        action, log_prob = self.sample_action(observation)
        value = self.reduce(self.critic(observation, action))
        return (self.log_alpha.exp().detach() * log_prob - value).mean(), log_prob.mean()

    def update(self, batch: dict[str, torch.Tensor]) -> None:
        """One gradient step."""
        settings = self.settings
        loss = self._critic_loss(
            batch["observation"],
            batch["action"],
            batch["reward"] * (settings.reward_scale or float(self.returns)),
            batch["discount"],
            batch["next_observation"],
        )
        self.critic_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.critic_optimizer.step()
        self._losses["critic_loss"] = loss.detach()
        self.updates += 1
        if self.updates % settings.actor_every == 0:
            self.critic.requires_grad_(False)
            loss, log_prob = self._actor_loss(batch["observation"])
            self.actor_optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.actor_optimizer.step()
            self.critic.requires_grad_(True)
            self._losses |= {"actor_loss": loss.detach(), "entropy": -log_prob.detach()}
            self.alpha_optimizer.zero_grad(set_to_none=True)
            (-self.log_alpha.exp() * (log_prob.detach() + self.target_entropy)).backward()
            self.alpha_optimizer.step()
        torch._foreach_lerp_(list(self.target.parameters()), list(self.critic.parameters()), 1 - settings.target_decay)

    def metrics(self) -> dict[str, float]:
        """Losses, policy entropy (nats) and temperature of the last update."""
        return {name: float(value) for name, value in self._losses.items()} | {
            "temperature": float(self.log_alpha.detach().exp())
        }

    def state(self) -> dict[str, Any]:
        return super().state() | {"log_alpha": self.log_alpha.detach()}

    def load_networks(self, state: dict[str, Any]) -> None:
        super().load_networks(state)
        with torch.no_grad():
            self.log_alpha.copy_(state["log_alpha"])
