"""Maximum a posteriori policy optimization, by which DMC-VB's experts were trained (paper, section 3.1).

MPO (Abdolmaleki et al. 2018a, "Maximum a Posteriori Policy Optimisation", and 2018b, "Relative Entropy Regularized
Policy Iteration", equations cited as R): sampled actions are weighted by how good a critic finds them (E-step), and the
policy is fitted to them within trust regions of its own for mean and standard deviation (M-step).

What differs from the papers: the Gaussian lives before a tanh, as in this package's policy files. KL divergences do
not change under tanh and its Jacobian does not depend on the policy, so every equation stays as it is. The critics
learn from one-step targets instead of Retrace. The covariance is diagonal. Critics, buffer and statistics are those of
`sac`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn.functional import softplus

from dmcvb_gen.compilation import compiled
from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.training.sac import CriticEnsemble, Learner, ReplaySettings, check, in_order, network, train
from dmcvb_gen.training.settings import Count, Positive

__all__ = ["Mpo", "Settings", "check", "network", "train"]

SMALLEST = 1e-8
"""Added to temperature and multipliers, which must not be zero."""


@dataclass(frozen=True)
class Settings(ReplaySettings):
    """Settings of MPO.

    Attributes:
      updates_per_step: gradient updates an agent step (all simulations together count `simulations` steps).
      learning_rate: learning rate of policy and critics.
      n_step: rewards summed before a target bootstraps, on the way that the episode really took.
      reward_scale: multiplies rewards before learning.
      action_samples: actions drawn from the target policy for each state.
      epsilon: bound on the KL divergence of the weighted actions from the target policy (E-step).
      epsilon_mean, epsilon_std: bound on the M-step's KL divergence through the mean, and through the deviation.
      initial_temperature: temperature of the action weights at the start; it is learned.
      initial_multiplier_mean, initial_multiplier_std: multiplier of the M-step's bound on the mean, and on the
        deviation, at the start; it is learned.
      dual_learning_rate: learning rate of temperature and multipliers.
      target_period: updates after which the target networks become copies of policy and critics.
    """

    updates_per_step: Positive = 0.5
    learning_rate: Positive = 3e-4
    n_step: Count = 1
    reward_scale: Positive = 1.0
    action_samples: Count = 20
    epsilon: Positive = 0.1
    epsilon_mean: Positive = 0.01
    epsilon_std: Positive = 1e-4
    initial_temperature: Positive = 1.0
    initial_multiplier_mean: Positive = 1.0
    initial_multiplier_std: Positive = 10.0
    dual_learning_rate: Positive = 1e-2
    target_period: Count = 100


def temperature_loss(values: torch.Tensor, temperature: torch.Tensor, epsilon: float) -> torch.Tensor:
    """The dual of the E-step, (1): eta * epsilon + eta * E_s[log E_a exp(Q / eta)] (2018a, equation 9; R 4).

    Args:
      values: Q of the sampled actions, (sample, n).
    """
    mean_exp = torch.logsumexp(values / temperature, dim=0) - math.log(len(values))
    return temperature * (epsilon + mean_exp.mean())


def action_weights(values: torch.Tensor, temperature: torch.Tensor) -> torch.Tensor:
    """Weights of the sampled actions, (sample, n), one in sum for each state: q ~ exp(Q / eta) (2018a, equation 8)."""
    return torch.softmax(values / temperature, dim=0)


def log_density(actions: torch.Tensor, mean: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
    """Log densities of a diagonal Gaussian, summed over actions, (sample, n); without its constant."""
    return (-0.5 * ((actions - mean) / std) ** 2 - std.log()).sum(-1)


def kl_of_means(mean: torch.Tensor, new: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
    """KL(N(mean, std) || N(new, std)), its mean over states, (1) (R 6: the covariance is held fixed)."""
    return (0.5 * ((new - mean) / std) ** 2).sum(-1).mean()


def kl_of_stds(std: torch.Tensor, new: torch.Tensor) -> torch.Tensor:
    """KL(N(mean, std) || N(mean, new)), its mean over states, (1) (R 6: the mean is held fixed)."""
    ratio = std / new
    return (0.5 * (ratio**2 - 1) - ratio.log()).sum(-1).mean()


class Mpo(Learner):
    """Policy, critics, their targets, temperature, multipliers; `update` does one step of all of them."""

    def __init__(self, header: PolicyHeader, settings: Settings, seed: int):
        super().__init__(header, settings, seed)
        inputs = header.observation_size + header.action_size
        self.critic = CriticEnsemble(inputs, settings.critic_hidden, settings.critics)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        # Softplus of these: they stay positive whatever the optimizer does.
        starts = (settings.initial_temperature, settings.initial_multiplier_mean, settings.initial_multiplier_std)
        self.duals = nn.Parameter(torch.tensor([value + math.log(-math.expm1(-value)) for value in starts]))
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=settings.learning_rate, fused=True),
            "critic": torch.optim.Adam(self.critic.parameters(), lr=settings.learning_rate, fused=True),
            "dual": torch.optim.Adam([self.duals], lr=settings.dual_learning_rate, fused=True),
        }
        self._loss = compiled(self.loss) if settings.compile else self.loss
        self._logged: torch.Tensor | None = None

    def loss(self, observation, action, reward, discount, next_observation):
        """The sum of all losses, (1): critics', policy's, temperature's and multipliers'; and what is to be logged."""
        settings = self.settings
        with torch.no_grad():
            mean, std = self.target_actor(next_observation)  # before tanh, as the sampled actions
            sampled = mean + std * torch.randn(settings.action_samples, *mean.shape)  # (sample, n, action)
            repeated = self.actor.normalize(next_observation).expand(len(sampled), -1, -1)
            values = self.target(repeated.flatten(0, 1), torch.tanh(sampled).flatten(0, 1)).squeeze(-1)
            values = values.mean(dim=0).view(len(sampled), -1)  # (sample, n), the mean of the critics
            target = reward + discount * values.mean(dim=0)
        value = self.critic(self.actor.normalize(observation), action).squeeze(-1)  # (critic, n)
        critic_loss = ((value - target) ** 2).mean(dim=1).sum()

        temperature, multiplier_mean, multiplier_std = softplus(self.duals) + SMALLEST
        weights = action_weights(values, temperature).detach()

        new_mean, new_std = self.actor(next_observation)
        # Each part of the policy is fitted with the other one held at the target's (R 5 and 6).
        fit = log_density(sampled, new_mean, std) + log_density(sampled, mean, new_std)
        kl_mean, kl_std = kl_of_means(mean, new_mean, std), kl_of_stds(std, new_std)
        policy_loss = multiplier_mean.detach() * kl_mean + multiplier_std.detach() * kl_std
        policy_loss = policy_loss - (weights * fit).sum(dim=0).mean()
        dual_loss = temperature_loss(values, temperature, settings.epsilon)
        dual_loss = dual_loss + multiplier_mean * (settings.epsilon_mean - kl_mean.detach())
        dual_loss = dual_loss + multiplier_std * (settings.epsilon_std - kl_std.detach())
        logged = torch.stack([critic_loss, policy_loss, temperature, kl_mean, kl_std, std.mean()]).detach()
        return critic_loss + policy_loss + dual_loss, logged

    def update(self, batch: dict[str, torch.Tensor]) -> None:
        """One gradient step."""
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        loss, self._logged = self._loss(*in_order(batch, self.settings.reward_scale))
        loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
        self.updates += 1
        if self.updates % self.settings.target_period == 0:
            self.target.load_state_dict(self.critic.state_dict())
            self.target_actor.load_state_dict(self.actor.state_dict())

    def sync_norm(self) -> None:
        super().sync_norm()
        for name in ("observation_mean", "observation_std"):  # else the target would see other numbers than the policy
            getattr(self.target_actor, name).copy_(getattr(self.actor, name))

    def metrics(self) -> dict[str, float]:
        """Losses, temperature, KL divergences and mean deviation of the last update."""
        names = ("critic_loss", "actor_loss", "temperature", "kl_mean", "kl_std", "std")
        return {} if self._logged is None else dict(zip(names, self._logged.tolist(), strict=True))

    def load_actor(self, weights: Mapping[str, torch.Tensor]) -> None:
        super().load_actor(weights)
        self.target_actor.load_state_dict(self.actor.state_dict())  # it draws what the actor is fitted to


LEARNER = Mpo
