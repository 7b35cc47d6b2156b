"""Soft actor-critic with distributional critics on batched simulations: settings, learner and loop, top to bottom.

SAC (Haarnoja et al. 2018, arXiv 1812.05905): a squashed Gaussian actor, critics with targets that follow slowly, and a
learned weight of the entropy. What is taken from elsewhere:

- Critics give a distribution over returns and learn it by cross-entropy with smoothed targets: HL-Gauss (Farebrother et
  al. 2024, "Stop Regressing", arXiv 2403.03950). They have LayerNorm after each hidden layer.
- Rewards are divided by the spread of discounted returns (SimbaV2, Lee et al. 2025, arXiv 2502.15280), observations by
  their own.
- Targets leave out the entropy bonus, so that their range does not depend on the action size, and the actor follows the
  critics' mean, not the smaller one.
- A falling share of the targets sums three rewards before it bootstraps, and learning rates fall; both are our own.

All critics are one batched product, in bfloat16 if the processor has it, and updates are compiled.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import nn

from dmcvb_gen.compilation import compiled
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.header import LOG_STD_RANGE, PolicyHeader
from dmcvb_gen.training.episodes import Episodes, EpisodeSettings, Moment
from dmcvb_gen.training.networks import Actor
from dmcvb_gen.training.run import Run, start_from
from dmcvb_gen.training.settings import Count, Decay, Hidden, Natural, NonNegative, Positive, Share

# -- settings -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReplaySettings(EpisodeSettings):
    """Settings of a learner with a replay buffer.

    Attributes:
      warmup_steps: agent steps of uniform random actions before the first update.
      buffer_size: agent steps remembered.
      batch_size: transitions an update.
      actor_hidden: widths of the policy's hidden layers.
      critic_hidden: widths of each critic's hidden layers.
      critics: number of critics; their mean is used.
      discount: discount of an agent step.
      greedy_fraction: share of the simulations that act by the mean, as data are made: a policy that only ever collects
        with noise never sees the places where its mean stands still.
      compile: compile the updates. Without a C++ compiler a warning says that they run uncompiled.
      shaping: weight of the task's shaping term added to the training reward.
      path_reward_scale: mazes: weight of the meters of shortest path covered in a step, added to the training reward.
        DMC-VB's own reward is flat in the whole goal cell.
    """

    warmup_steps: Natural = 5000
    buffer_size: Count = 1_000_000
    batch_size: Count = 256
    actor_hidden: Hidden = (256, 256)
    critic_hidden: Annotated[Hidden, Field(min_length=1)] = (256, 256)
    critics: Count = 2
    discount: Decay = 0.99
    greedy_fraction: Share = 0.0
    compile: bool = True
    shaping: NonNegative = 0.0
    path_reward_scale: NonNegative = 0.0


@dataclass(frozen=True)
class Settings(ReplaySettings):
    """Settings of SAC; those of mazes are in defaults.yaml.

    Attributes:
      updates_per_step: gradient updates an agent step (all simulations together count `simulations` steps).
      learning_rate: learning rate of policy and critics.
      rate_half_life: agent steps after which learning rates have fallen to 1 / sqrt(2); they fall with the square root
        of the steps (0: never).
      weight_decay: weight decay of AdamW, on actor and critics.
      actor_every: an actor update every so many critic updates.
      target_decay: share of the target critics that an update keeps.
      reward_scale: multiplies rewards before learning; 0: the inverse of the spread of discounted returns, as it grows.
      n_step: rewards summed before a target bootstraps, on the way that the episode really took.
      n_step_half_life: the share of such targets is 1 / (1 + agent steps / this), others look one step ahead (0: all of
        them always). They learn faster at first, and what old actions earned misleads them later.
      initial_temperature: weight of the entropy bonus at the start; it is learned.
      target_entropy_scale: the target entropy is minus this times the action size.
      anneal_after: agent steps after which the target entropy is that of `final_entropy_scale` and the learning rate
        `final_learning_rate` (0: never). A policy that explores loses return to its own noise, one that learns fast
        swings from checkpoint to checkpoint; the end of a run can do without both.
      final_entropy_scale: see `anneal_after`.
      final_learning_rate: see `anneal_after`; 0: as before.
      bfloat16: hidden layers' products in bfloat16 (weights and optimizer stay float32).
    """

    updates_per_step: Positive = 1.0
    learning_rate: Positive = 1e-3
    rate_half_life: Natural = 100_000
    weight_decay: NonNegative = 0.0
    actor_every: Count = 2
    target_decay: Decay = 0.995
    reward_scale: NonNegative = 0.0
    n_step: Count = 3
    n_step_half_life: Natural = 10_000
    initial_temperature: Positive = 0.01
    target_entropy_scale: float = 1.0
    anneal_after: Natural = 0
    final_entropy_scale: float = 1.5
    final_learning_rate: NonNegative = 0.0
    bfloat16: bool = False


HEARD_WITH = {
    "final_entropy_scale": "anneal_after",
    "final_learning_rate": "anneal_after",
    "n_step_half_life": "n_step",
}
"""Setting -> the one without which it has no effect."""
RETURN_LIMIT = 5.0
"""Scaled discounted returns stay within this: the largest seen is scaled to it if the spread alone does not."""
BINS = 101
"""Returns over which critics give a distribution."""
SUPPORT = 1.2 * RETURN_LIMIT
"""Largest absolute return of the bins."""
SMOOTHING = 0.75
"""Standard deviation of a target's smoothing over bins, in bins (Farebrother et al. 2024, section 3)."""


# -- what is learned from: statistics and memory --------------------------------------------------


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

    def state(self) -> dict[str, Any]:
        """Return the state that it continues from."""
        return {"count": self.count, "mean": torch.tensor(self.mean), "m2": torch.tensor(self.m2)}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state()`."""
        self.count = float(state["count"])
        self.mean, self.m2 = state["mean"].numpy().copy(), state["m2"].numpy().copy()


class ReturnScale:
    """The factor by which rewards are scaled: the inverse of the spread of the discounted returns that were seen.

    Divides by the standard deviation, or by the largest return over `RETURN_LIMIT` if that is more. Rewards of any task
    then need no scale of their own.
    """

    def __init__(self, simulations: int, discount: float):
        self._discount, self._running = discount, np.zeros(simulations)
        self._norm, self._largest = RunningNorm(1), 0.0

    def update(self, reward: np.ndarray, ended: np.ndarray) -> None:
        """Take in a step's rewards, (simulation,), and which episodes ended with it."""
        self._running = self._discount * self._running + reward
        self._norm.update(self._running[:, None])
        self._largest = max(self._largest, float(np.abs(self._running).max()))
        self._running[ended] = 0

    def __float__(self) -> float:
        spread = max(float(np.sqrt(self._norm.m2 / self._norm.count)[0]), self._largest / RETURN_LIMIT)
        return 1 / max(spread, 1e-3)

    def state(self) -> dict[str, Any]:
        """Return the state that it continues from."""
        return {"norm": self._norm.state(), "largest": self._largest, "running": torch.tensor(self._running)}

    def load_state(self, state: Mapping[str, Any], running: bool = True) -> None:
        """Continue from `state()`; with `running` in the same episodes."""
        self._norm.load_state(state["norm"])
        self._largest = state["largest"]
        if running:
            self._running = state["running"].numpy().copy()


class RowBuffer:
    """A ring of the latest rows of named float32 fields.

    Args:
      size: rows kept.
      shapes: name -> shape of one row of the field.
    """

    def __init__(self, size: int, shapes: Mapping[str, tuple[int, ...]]):
        self.size, self.position, self.full = size, 0, False
        self.arrays = {name: np.zeros((size, *shape), np.float32) for name, shape in shapes.items()}

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

    def state(self) -> dict[str, Any]:
        """Return the state that it continues from: the rows that are filled, not copied."""
        rows = {name: torch.from_numpy(array[: len(self)]) for name, array in self.arrays.items()}
        return {"rows": rows, "position": self.position, "full": self.full}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state()`."""
        for name, rows in state["rows"].items():
            self.arrays[name][: len(rows)] = rows.numpy()
        self.position, self.full = state["position"], state["full"]


class ReplayBuffer(RowBuffer):
    """Transitions of simulations side by side; rows of one simulation lie `simulations` rows apart.

    Args:
      simulations: rows of an `add`.
    """

    def __init__(self, size: int, observation_size: int, action_size: int, simulations: int):
        self._simulations = simulations
        seen = {"observation": (observation_size,), "next_observation": (observation_size,), "action": (action_size,)}
        super().__init__(size, {**seen, "reward": (), "terminated": (), "ended": ()})

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


def in_order(batch: dict[str, torch.Tensor], reward_scale: float) -> list[torch.Tensor]:
    """A batch as losses take it: observation, action, scaled reward, discount and next observation."""
    batch = batch | {"reward": batch["reward"] * reward_scale}
    return [batch[name] for name in ("observation", "action", "reward", "discount", "next_observation")]


# -- critics --------------------------------------------------------------------------------------


class CriticEnsemble(nn.Module):
    """Critics of (observation, action), evaluated in one batched product; LayerNorm after each hidden layer.

    Args:
      inputs: numbers of an observation and an action.
      outputs: numbers that a critic gives: the logits of a distribution over returns, or one value.
    """

    def __init__(self, inputs: int, hidden: tuple[int, ...], critics: int, outputs: int = 1, bfloat16: bool = False):
        super().__init__()
        self.bfloat16 = bfloat16
        sizes = (inputs, *hidden)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        self.scales, self.shifts = nn.ParameterList(), nn.ParameterList()
        for i, o in zip(sizes[:-1], sizes[1:], strict=True):
            self.weights.append(nn.Parameter(torch.stack([_init(i, o) for _ in range(critics)])))
            self.biases.append(nn.Parameter(torch.zeros(critics, 1, o)))
            self.scales.append(nn.Parameter(torch.ones(critics, 1, o)))
            self.shifts.append(nn.Parameter(torch.zeros(critics, 1, o)))
        self.head = nn.Parameter(torch.stack([_init(sizes[-1], outputs) for _ in range(critics)]) * 0.1)
        self.head_bias = nn.Parameter(torch.zeros(critics, 1, outputs))

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(n, observation), (n, action) -> (critic, n, output)."""
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


def smoothed(target: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """(n,) -> (n, bin): HL-Gauss: a Gaussian around each target, of which each bin holds its part, one in sum.

    Args:
      edges: (bin + 1,) of the bins, evenly spaced.
    """
    width = 2 * SUPPORT / (len(edges) - 1)
    target = target.clamp(-SUPPORT + width, SUPPORT - width)
    below = torch.erf((edges - target[:, None]) / (math.sqrt(2) * SMOOTHING * width))
    return (below[:, 1:] - below[:, :-1]) / (below[:, -1:] - below[:, :1])


# -- the learner ----------------------------------------------------------------------------------


class Learner(nn.Module):
    """An actor with the running statistics of its observations; subclasses add networks and optimizers.

    Attributes:
      optimizers: name -> optimizer.
      updates: gradient updates so far.
    """

    def __init__(self, header: PolicyHeader, settings: Any, seed: int):
        super().__init__()
        torch.manual_seed(seed)
        self.settings, self.actor = settings, Actor(header)
        self.norm = RunningNorm(header.observation_size)
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self.updates = 0

    def sync_norm(self) -> None:
        """Put the running statistics into the actor, where every network reads them."""
        self.actor.observation_mean.copy_(torch.from_numpy(self.norm.mean))
        self.actor.observation_std.copy_(torch.from_numpy(self.norm.std))

    def take_in(self, moment: Moment, step: int) -> float:
        """Take in a step of all simulations, before the updates; gives `Collector.batches` its share."""
        self.sync_norm()
        return 1.0

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Actions for collecting, (n, observation) -> (n, action) float32: means in the first rows, samples below."""
        with torch.no_grad():
            mean, std = self.actor(torch.from_numpy(np.ascontiguousarray(observation, np.float32)))
            noise = torch.randn_like(mean)
            noise[: round(self.settings.greedy_fraction * len(noise))] = 0
            return torch.tanh(mean + std * noise).numpy()

    def descend(self, name: str, loss: torch.Tensor) -> None:
        """One step of an optimizer down a loss."""
        self.optimizers[name].zero_grad(set_to_none=True)
        loss.backward()
        self.optimizers[name].step()

    def state(self) -> dict[str, Any]:
        """Everything that learning continues from (tensors and plain numbers)."""
        optimizers = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        random = {"updates": self.updates, "torch_rng": torch.get_rng_state()}
        return {"networks": self.state_dict(), "norm": self.norm.state(), "optimizers": optimizers} | random

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state()`."""
        self.load_networks(state)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.updates = state["updates"]
        torch.set_rng_state(state["torch_rng"])

    def load_networks(self, state: Mapping[str, Any]) -> None:
        """Take networks and normalization of `state()`, but no optimizer or random state.

        Raises:
          RuntimeError: they have other shapes.
        """
        self.load_state_dict(state["networks"])
        self.norm.load_state(state["norm"])

    def load_actor(self, weights: Mapping[str, torch.Tensor]) -> None:
        """Take the weights of a policy file, and its normalization as if 100,000 observations had been seen.

        Raises:
          RuntimeError: they have other shapes.
        """
        self.actor.load_state_dict(weights)
        self.norm.mean, self.norm.count = self.actor.observation_mean.numpy().astype(float), 1e5
        self.norm.m2 = self.actor.observation_std.numpy().astype(float) ** 2 * self.norm.count


class Sac(Learner):
    """Networks, optimizers, temperature; `update` does one step of all of them."""

    def __init__(self, header: PolicyHeader, settings: Settings, seed: int):
        super().__init__(header, settings, seed)
        sizes = (header.observation_size + header.action_size, settings.critic_hidden, settings.critics, BINS)
        self.critic, self.target = (CriticEnsemble(*sizes, settings.bfloat16) for _ in range(2))
        self.target.load_state_dict(self.critic.state_dict())
        self.target.requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(math.log(settings.initial_temperature)))
        self.returns = ReturnScale(settings.simulations, settings.discount)
        self.edges = torch.linspace(-SUPPORT, SUPPORT, BINS + 1)
        self.centers = (self.edges[1:] + self.edges[:-1]) / 2
        self.target_entropy = -settings.target_entropy_scale * header.action_size
        rate = settings.learning_rate
        decay = {"weight_decay": settings.weight_decay, "fused": True}
        self.optimizers = {
            "actor": torch.optim.AdamW(self.actor.parameters(), lr=rate, **decay),
            "critic": torch.optim.AdamW(self.critic.parameters(), lr=rate, **decay),
            "alpha": torch.optim.Adam([self.log_alpha], lr=rate, fused=True),
        }
        self._losses: dict[str, torch.Tensor] = {}
        self._critic_loss = compiled(self.critic_loss) if settings.compile else self.critic_loss
        self._actor_loss = compiled(self.actor_loss) if settings.compile else self.actor_loss

    def take_in(self, moment: Moment, step: int) -> float:
        super().take_in(moment, step)
        self.returns.update(moment.reward, moment.ended)
        self.schedule(step)
        half_life = self.settings.n_step_half_life
        return 1 / (1 + step / half_life) if half_life else 1.0

    def schedule(self, step: int) -> None:
        """Set learning rates and target entropy of an agent step."""
        settings, rate = self.settings, self.settings.learning_rate
        if settings.rate_half_life:
            rate /= math.sqrt(1 + step / settings.rate_half_life)
        networks = ["actor", "critic"]
        if settings.anneal_after and step >= settings.anneal_after:
            self.target_entropy = -settings.final_entropy_scale * self.actor.header.action_size
            if settings.final_learning_rate:
                rate, networks = settings.final_learning_rate, [*networks, "alpha"]
        for name in networks:
            self.optimizers[name].param_groups[0]["lr"] = rate

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

    def value(self, critic: CriticEnsemble, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(n,): the mean of the returns that critics expect, and of the critics."""
        return (critic(observation, action).softmax(dim=-1) * self.centers).sum(dim=-1).mean(dim=0)

    def critic_loss(self, observation, action, reward, discount, next_observation):
        """Return the cross-entropy of the Bellman targets, (1): its mean over rows and sum over critics."""
        with torch.no_grad():
            next_observation = self.actor.normalize(next_observation)
            next_action, _ = self.sample_action(next_observation)
            target = reward + discount * self.value(self.target, next_observation, next_action)
        logits = self.critic(self.actor.normalize(observation), action)  # (critic, n, bin)
        return -(smoothed(target, self.edges) * logits.log_softmax(dim=-1)).sum(dim=-1).mean(dim=1).sum()

    def actor_loss(self, observation):
        """E[alpha log pi - Q] and the mean log probability."""
        observation = self.actor.normalize(observation)
        action, log_prob = self.sample_action(observation)
        value = self.value(self.critic, observation, action)
        return (self.log_alpha.exp().detach() * log_prob - value).mean(), log_prob.mean()

    def update(self, batch: dict[str, torch.Tensor]) -> None:
        """One gradient step."""
        settings = self.settings
        loss = self._critic_loss(*in_order(batch, settings.reward_scale or float(self.returns)))
        self.descend("critic", loss)
        self._losses["critic_loss"] = loss.detach()
        self.updates += 1
        if self.updates % settings.actor_every == 0:
            self.critic.requires_grad_(False)
            loss, log_prob = self._actor_loss(batch["observation"])
            self.descend("actor", loss)
            self.critic.requires_grad_(True)
            self._losses |= {"actor_loss": loss.detach(), "entropy": -log_prob.detach()}
            self.descend("alpha", -self.log_alpha.exp() * (log_prob.detach() + self.target_entropy))
        with torch.no_grad():
            old, new = list(self.target.parameters()), list(self.critic.parameters())
            torch._foreach_lerp_(old, new, 1 - settings.target_decay)

    def metrics(self) -> dict[str, float]:
        """Losses, policy entropy (nats) and temperature of the last update."""
        losses = {name: float(value) for name, value in self._losses.items()}
        return losses | {"temperature": float(self.log_alpha.detach().exp())}

    def load_networks(self, state: Mapping[str, Any]) -> None:
        super().load_networks(state)
        self.returns.load_state(state["returns"], running=False)  # critics know rewards on this scale

    def state(self) -> dict[str, Any]:
        return super().state() | {"returns": self.returns.state()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        super().load_state(state)
        self.returns.load_state(state["returns"])


# -- the run --------------------------------------------------------------------------------------


class Collector:
    """Episodes of a learner's actor, at random until there is something to learn from, and the batches to learn from.

    It continues where the run was saved, or begins with what the run starts from; `state` is all that the run goes on
    from, the learner's included.
    """

    def __init__(self, run: Run, learner: Learner):
        settings, config, task = run.settings, run.config, run.task
        self.run, self.learner, self._owed = run, learner, 0.0  # updates that are due
        self.rng = np.random.default_rng([config.seed, 0xB0FF])
        rows = max(settings.buffer_size, settings.simulations)
        self.buffer = ReplayBuffer(rows, task.behaviour_size, task.action_size, settings.simulations)
        self.episodes = Episodes(task, settings, config.seed, self.rng)
        if saved := run.saved():
            learner.load_state(saved["learner"])
            self.buffer.load_state(saved["buffer"])
            self.episodes.restore(saved["episodes"])
            self.rng.bit_generator.state, self._owed = json.loads(saved["rng"]), saved["owed"]
        else:
            if config.init_from:
                start_from(learner, run)
            run.save(self.state())

    def state(self) -> dict[str, Any]:
        """Everything that the run continues from."""
        parts = {"learner": self.learner.state(), "buffer": self.buffer.state(), "episodes": self.episodes.saved()}
        return parts | {"rng": json.dumps(self.rng.bit_generator.state), "owed": self._owed}

    def step(self) -> Moment:
        """One agent step of every simulation, into the buffer."""
        settings, observation = self.run.settings, self.episodes.observation
        self.learner.norm.update(observation)
        if len(self.buffer) < settings.warmup_steps and not self.run.config.init_from:
            action = self.rng.uniform(-1, 1, (settings.simulations, self.run.task.action_size)).astype(np.float32)
        else:
            action = self.learner.act(observation)
        moment = self.episodes.step(action)
        self.buffer.add(observation=observation, action=action, **vars(moment))
        self.run.advance(settings.simulations)
        return moment

    def batches(self, share: float = 1.0) -> Iterator[dict[str, torch.Tensor]]:
        """A batch for each update that the last steps are worth.

        Args:
          share: share of the rows with rewards of several steps, see `ReplayBuffer.sample_steps`.
        """
        settings = self.run.settings
        if len(self.buffer) < settings.warmup_steps:
            return
        self._owed += settings.updates_per_step * settings.simulations
        while self._owed >= 1:
            self._owed -= 1
            yield self.buffer.sample_steps(self.rng, settings.batch_size, settings.n_step, settings.discount, share)


def network(run: Run) -> dict[str, Any]:
    """The header's fields that say how the actor is built."""
    return {"hidden": tuple(run.settings.actor_hidden)}


def check(run: Run) -> None:
    """Refuse, before anything is written, a run that would learn nothing, or that its start does not fit.

    Raises:
      DmcvbError: what is wrong and the cure.
    """
    settings, steps = run.settings, min(run.config.steps, run.settings.buffer_size)
    if steps <= settings.warmup_steps:
        raise DmcvbError(
            f"{steps} steps are all warm-up ({settings.warmup_steps} steps), nothing would be learned; give more "
            "--steps (or buffer_size), or less warm-up: --set warmup_steps=N"
        )
    for name, needed in HEARD_WITH.items():
        if name in run.config.settings and getattr(settings, needed, 1) in (0, 1) and not run.begun:
            raise DmcvbError(f"setting {name} has no effect, as {needed} is {getattr(settings, needed)}; set it too")
    if run.config.init_from and not run.begun:
        start_from(run.algorithm.LEARNER(run.header, settings, run.config.seed), run)


def train(run: Run) -> None:
    """Train the algorithm's learner until the run's last step, or until it is stopped."""
    learner = run.algorithm.LEARNER(run.header, run.settings, run.config.seed)
    collector = Collector(run, learner)
    while run.step < run.config.steps:
        moment = collector.step()
        for batch in collector.batches(learner.take_in(moment, run.step)):
            learner.update(batch)
        if run.evaluation_is_due():
            run.record(learner.actor.state_dict(), learner.updates, learner.metrics())
        run.checkpoint_if_due(collector.state, learner.actor.state_dict)
    run.save(collector.state())


LEARNER = Sac
