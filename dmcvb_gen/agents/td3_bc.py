"""TD3-BC: an actor-critic that is kept near the actions of the data (Fujimoto & Gu 2021; paper, "Agent details")."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from dmcvb_gen.agents.data import Sizes
from dmcvb_gen.agents.learners import EMA_DECAY, Batch, Policy, adam, frozen_copy, move_towards, register_agent
from dmcvb_gen.agents.networks import LATENT, MLP, PAPER, Architecture, Convolutions, Encoder, Trunk


class _ActorCritic(nn.Module):
    """A body, an actor and two critics, each with a trunk between it and the body, or without (`trunk` None)."""

    def __init__(self, body: nn.Module, features: int, action_size: int, trunk: int | None):
        super().__init__()
        self.body, self.features = body, trunk or features
        self.actor_trunk = Trunk(features, trunk) if trunk else nn.Identity()
        self.critic_trunk = Trunk(features, trunk) if trunk else nn.Identity()
        self.actor = MLP(self.features, action_size, tanh=True)
        self.critic1, self.critic2 = (MLP(self.features + action_size, 1, tanh=True) for _ in range(2))

    def act(self, body: torch.Tensor) -> torch.Tensor:
        return self.actor(self.actor_trunk(body)).float()

    def values(self, body: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Q1 and Q2, each (batch,)."""
        latent = self.critic_trunk(body)
        return self.value(self.critic1, latent, action), self.value(self.critic2, latent, action)

    @staticmethod
    def value(critic: nn.Module, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(batch,): one critic's value, in float32 throughout: half precision is too coarse for returns."""
        with torch.autocast(latent.device.type, enabled=False):
            return critic(torch.cat([latent.float(), action.float()], dim=1))[:, 0]


@register_agent("td3-bc")
class TD3BC(Policy):
    """TD3-BC.

    Critics: y = r + discount gamma min(Q1', Q2')(o', clip(pi'(o') + clip(noise))); || Q - y ||^2 moves the critic
    heads alone. Actor, every second step: - lambda Q1(o, pi(o)) + || pi(o) - a ||^2 with lambda = alpha / mean |Q1|
    moves the actor, both trunks and the body. So alpha = 0 is BC. The critics end with tanh, as the paper's
    hyperparameter table says: values lie in (-1, 1), saturate on these rewards, and what is left is nearly BC.

    Args:
      encoder: is read if it is frozen, without trunks of the heads' own; else actor and critics have convolutions
        (none on states) and trunks of their own.
    """

    draws = {"next_observation": True, "pictures": False}
    compiled = ("critic_loss", "actor_loss")
    only_learns = ("target.", "net.critic", "updates")
    alpha, gamma, noise, noise_clip, actor_every, decay = 2.5, 0.99, 0.2, 0.5, 2, EMA_DECAY

    def __init__(self, encoder: nn.Module, sizes: Sizes, architecture: Architecture = PAPER, frozen: bool = False):
        super().__init__()
        if frozen:
            body, features, trunk = encoder.requires_grad_(False), encoder.features, None
        elif sizes.channels:
            body = Convolutions(sizes.channels, sizes.picture, architecture, sizes.stack)
            features, trunk = body.features, architecture.latent
        else:
            body, features, trunk = nn.Identity(), sizes.state, LATENT
        self.net = net = _ActorCritic(body, features, sizes.action, trunk)
        self.target = frozen_copy(net)
        if frozen:
            self.target.body = body  # it never moves, so one will do
        self.optimizers = {
            "critic": adam([net.critic1, net.critic2]),
            "actor": adam([net.body, net.actor_trunk, net.critic_trunk, net.actor]),
        }
        self.register_buffer("updates", torch.zeros((), dtype=torch.long))

    @property
    def encoder(self) -> nn.Module:
        """phi as the actor sees it: body and actor's trunk."""
        return Encoder(self.net.body, self.net.actor_trunk, self.net.features)

    def act(self, observation):
        return self.net.act(self.net.body(observation))

    @torch.no_grad()
    def target_value(self, batch: Batch) -> torch.Tensor:
        """y: (batch,)."""
        body = self.target.body(batch.next_observation) if batch.next_latent is None else batch.next_latent
        noise = torch.randn_like(batch.action) * self.noise
        action = (self.target.act(body) + noise.clamp(-self.noise_clip, self.noise_clip)).clamp(-1, 1)
        return batch.reward + self.gamma * batch.discount * torch.minimum(*self.target.values(body, action))

    def critic_loss(self, batch: Batch) -> torch.Tensor:
        with torch.no_grad():
            latent = self.net.critic_trunk(batch.seen_by(self.net.body))
        y = self.target_value(batch)
        critics = (self.net.critic1, self.net.critic2)
        return sum(F.mse_loss(self.net.value(critic, latent, batch.action), y) for critic in critics)

    def actor_loss(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor's loss, and the cloning error in it."""
        body = batch.seen_by(self.net.body)
        action = self.net.act(body)
        value = self.net.values(body, action)[0]
        scale = self.alpha / value.abs().mean().detach().clamp(min=1e-6)
        cloning = F.mse_loss(action, batch.action)
        return -scale * value.mean() + cloning, cloning

    def losses(self, batch):
        actor, cloning = self.actor_loss(batch)
        return {"loss": cloning, "actor": actor, "critic": self.critic_loss(batch)}

    def update(self, batch):
        with self.precision():
            critic = self.critic_loss(batch)
        self._descend("critic", critic)
        out = {"critic": critic.detach()}
        self.updates += 1
        if self.updates % self.actor_every == 0:
            with self.precision():
                actor, cloning = self.actor_loss(batch)
            self._descend("actor", actor)  # gradients that land on the critics are dropped at their next step
            move_towards(self.target, self.net, self.decay)
            out |= {"loss": cloning.detach(), "actor": actor.detach()}
        return out
