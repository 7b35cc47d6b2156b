"""MPO: each of its equations against what it should be, and whole runs of it."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.training import mpo
from dmcvb_gen.training.mpo import Mpo, Settings

SMALL = dict(actor_hidden=[16], critic_hidden=[16], batch_size=32, warmup_steps=64, simulations=4, compile=False)


def gaussian(mean, std):
    return Independent(Normal(mean, std), 1)


def test_densities_and_divergences_through_mean_and_deviation_are_those_of_torch():
    """Of two Gaussians over three actions for five states, and samples of the first."""
    torch.manual_seed(0)
    mean, new = torch.randn(5, 3), torch.randn(5, 3)
    std, other = torch.rand(5, 3) + 0.1, torch.rand(5, 3) + 0.1
    one, constant = gaussian(mean, std), 1.5 * math.log(2 * math.pi)
    sampled = one.sample((7,))
    torch.testing.assert_close(mpo.log_density(sampled, mean, std) - constant, one.log_prob(sampled))
    torch.testing.assert_close(mpo.kl_of_means(mean, new, std), kl_divergence(one, gaussian(new, std)).mean())
    torch.testing.assert_close(mpo.kl_of_stds(std, other), kl_divergence(one, gaussian(mean, other)).mean())


def test_the_dual_finds_the_temperature_whose_weights_keep_their_distance():
    torch.manual_seed(1)
    values, epsilon = torch.randn(200, 50) * 3, 0.1
    grid = torch.linspace(0.3, 40, 4000)
    losses = torch.stack([mpo.temperature_loss(values, eta, epsilon) for eta in grid])
    best = grid[losses.argmin()]
    weights = mpo.action_weights(values, best)
    torch.testing.assert_close(weights.sum(0), torch.ones(50))
    # The dual's minimum is where the weighted samples are epsilon away from the unweighted ones.
    divergence = (weights * (weights * len(values)).log()).sum(0).mean()
    assert divergence.item() == pytest.approx(epsilon, rel=0.02)
    assert torch.equal(weights.argmax(0), values.argmax(0))


def learner(**changes):
    header = PolicyHeader(task="x", observation_size=3, action_size=2, algorithm="mpo", agent_step=0, hidden=(16,))
    return Mpo(header, Settings(**SMALL | changes), 0)


def batch_of(count=64, seed=3):
    torch.manual_seed(seed)
    action = torch.rand(count, 2) * 2 - 1
    rows = {"observation": torch.randn(count, 3), "action": action, "reward": 1 - (action[:, 0] - 0.5) ** 2}
    return rows | {"discount": torch.zeros(count), "next_observation": torch.randn(count, 3)}


@pytest.mark.full
def test_it_finds_the_action_that_pays():
    mpo_learner = learner(learning_rate=3e-3, epsilon_mean=0.05, epsilon_std=0.01, target_period=20)
    for seed in range(1500):
        mpo_learner.update(batch_of(128, seed))
    mean, std = mpo_learner.actor(torch.randn(100, 3))
    assert (torch.tanh(mean)[:, 0] - 0.5).abs().mean() < 0.1 and std[:, 0].mean() < 0.2


def test_targets_are_copies_of_long_ago():
    mpo_learner = learner(target_period=3)
    before = mpo_learner.target.head.clone()
    for count in range(1, 5):
        mpo_learner.update(batch_of())
        assert torch.equal(mpo_learner.target.head, before) == (count < 3)
        assert torch.equal(mpo_learner.target.head, mpo_learner.critic.head) == (count == 3)
    mpo_learner.norm.update(np.random.default_rng(0).normal(5, 2, (10, 3)))
    mpo_learner.sync_norm()
    assert torch.equal(mpo_learner.target_actor.observation_mean, mpo_learner.actor.observation_mean)


def test_from_a_policy_file_the_targets_draw_its_actions():
    source = learner()
    weights = {name: value + 0.1 for name, value in source.actor.state_dict().items()}
    started = learner()
    started.load_actor(weights)
    for network in (started.actor, started.target_actor):
        assert all(torch.equal(value, weights[name]) for name, value in network.state_dict().items())


def test_multipliers_of_any_size_begin_as_they_were_set():
    starts = dict(initial_temperature=1e-3, initial_multiplier_mean=1.0, initial_multiplier_std=1000.0)
    duals = learner(**starts).duals
    np.testing.assert_allclose(torch.nn.functional.softplus(duals).detach().numpy(), list(starts.values()), rtol=1e-3)
