"""SAC: each part of its update against what it should be."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.training.sac import SUPPORT, ReplayBuffer, ReturnScale, Sac, Settings, in_order, smoothed

torch.set_num_threads(1)


def learner(**changes):
    header = PolicyHeader(task="x", observation_size=3, action_size=2, algorithm="sac", agent_step=0, hidden=(8, 8))
    plain = dict(reward_scale=0.5, rate_half_life=0, n_step=1, critic_hidden=(8, 8), initial_temperature=0.1)
    return Sac(header, Settings(**plain | dict(compile=False) | changes), 0)


def rates(sac):
    return [optimizer.param_groups[0]["lr"] for optimizer in sac.optimizers.values()]


def batch_of(count=64):
    rng = np.random.default_rng(0)
    values = dict(
        observation=rng.normal(size=(count, 3)),
        next_observation=rng.normal(size=(count, 3)),
        action=rng.uniform(-1, 1, (count, 2)),
        reward=rng.random(count),
        discount=0.99 * (rng.random(count) > 0.2),
    )
    return {name: torch.tensor(np.asarray(value), dtype=torch.float32) for name, value in values.items()}


def test_the_ensemble_is_two_separate_critics():
    critic = learner().critic
    observation, action = torch.randn(5, 3), torch.rand(5, 2)
    both = critic(observation, action)
    for k in range(2):  # each critic by hand
        x = torch.cat([observation, action], 1)
        for w, b, scale, shift in zip(critic.weights, critic.biases, critic.scales, critic.shifts, strict=True):
            x = torch.nn.functional.layer_norm(x @ w[k] + b[k], (8,)) * scale[k] + shift[k]
            x = x.relu()
        torch.testing.assert_close(both[k], x @ critic.head[k] + critic.head_bias[k])


def test_log_probabilities_are_those_of_a_squashed_gaussian():
    sac = learner()
    torch.manual_seed(3)
    observation = torch.randn(6, 3)
    action, log_prob = sac.sample_action(observation)
    mean, std = sac.actor(observation)
    distribution = TransformedDistribution(Normal(mean, std), TanhTransform(cache_size=0))
    known = distribution.log_prob(action.clamp(-0.999999, 0.999999)).sum(1)
    torch.testing.assert_close(log_prob, known, rtol=1e-3, atol=1e-3)


def test_the_critic_update_moves_critics_alone_and_the_actor_update_the_actor_alone():
    sac = learner(actor_every=2)
    before = {name: value.clone() for name, value in sac.actor.state_dict().items()}
    critic = sac.critic.head.clone()
    sac.update(batch_of())
    assert all(torch.equal(value, before[name]) for name, value in sac.actor.state_dict().items())
    assert not torch.equal(sac.critic.head, critic)
    sac.update(batch_of())
    assert not torch.equal(sac.actor.mean.weight, before["mean.weight"])


def test_the_target_follows_by_its_decay():
    sac = learner(target_decay=0.9)
    before = sac.target.head.clone()
    sac.update(batch_of())
    torch.testing.assert_close(sac.target.head, 0.9 * before + 0.1 * sac.critic.head)
    assert not sac.target.head.requires_grad  # or it would hold the graph of every update


def test_a_terminal_transition_does_not_look_ahead():
    sac, batch = learner(), batch_of()
    batch["discount"][:] = 0
    first = sac.critic_loss(*in_order(batch, 0.5))
    batch["next_observation"] += 100
    torch.testing.assert_close(first, sac.critic_loss(*in_order(batch, 0.5)))


@given(target=st.floats(-20, 20), bins=st.integers(11, 201))
def test_the_distribution_of_a_target_has_its_mean(target, bins):
    edges = torch.linspace(-SUPPORT, SUPPORT, bins + 1)
    distribution = smoothed(torch.tensor([target]), edges)[0].numpy()
    width = 2 * SUPPORT / bins
    within = float(np.clip(target, -SUPPORT + width, SUPPORT - width))
    assert distribution.min() >= -1e-6 and distribution.sum() == pytest.approx(1, abs=1e-4)
    assert distribution @ (edges[1:] + edges[:-1]).numpy() / 2 == pytest.approx(within, abs=0.5 * width)


def test_the_loss_is_least_where_critics_give_the_targets_distribution():
    sac, batch = learner(), batch_of()
    batch["discount"][:] = 0
    wanted = smoothed(0.5 * batch["reward"], sac.edges)
    losses = []
    for share in (0.0, 0.9, 1.0):
        logits = (share * wanted + (1 - share) / wanted.shape[1]).clamp(1e-9).log().expand(2, -1, -1)
        sac.critic.forward = lambda observation, action, logits=logits: logits
        losses.append(float(sac.critic_loss(*in_order(batch, 0.5))))
    entropy = -(wanted * wanted.clamp(1e-9).log()).sum(1).mean()  # the least that a cross-entropy can be
    assert losses[0] > losses[1] > losses[2] == pytest.approx(2 * float(entropy), rel=1e-3)


def test_learning_rates_fall_with_the_root_of_the_steps_until_the_final_one():
    sac = learner(rate_half_life=1000, learning_rate=1e-3, anneal_after=9000, final_learning_rate=1e-5)
    for step, rate in ((0, 1e-3), (1000, 1e-3 / 2**0.5), (8000, 1e-3 / 3)):
        sac.schedule(step)
        assert rates(sac) == pytest.approx([rate, rate, 1e-3])  # the temperature's does not fall
    assert sac.target_entropy == -2.0  # of two actions
    sac.schedule(9000)
    assert rates(sac) == [1e-5] * 3 and sac.target_entropy == -3.0
    before = sac.critic.head.clone()
    sac.update(batch_of())
    assert 0 < (sac.critic.head - before).abs().max() < 1.1e-5  # Adam's first step is the learning rate


def test_rewards_are_scaled_by_the_spread_of_discounted_returns():
    rng, scale = np.random.default_rng(0), ReturnScale(2, 0.9)
    seen, running = [], np.zeros(2)
    for step in range(300):
        reward, ended = rng.gamma(0.1, 3, 2), np.array([step % 50 == 49, step % 70 == 69])
        running = 0.9 * running + reward
        seen.append(running.copy())
        running[ended] = 0
        scale.update(reward, ended)
    seen = np.concatenate(seen)
    assert 1 / float(scale) == pytest.approx(max(seen.std(), seen.max() / 5), rel=1e-3)
    again = ReturnScale(2, 0.9)
    again.load_state(scale.state())
    for each in (scale, again):
        each.update(np.array([90.0, 0.0]), np.array([False, False]))
    assert float(again) == float(scale) and 1 / float(scale) >= 18


@given(st.data())
def test_steps_that_follow_are_summed_as_far_as_an_episode_goes_on(data):
    """Against a loop over what each simulation lived through, in a ring that may have wrapped."""
    simulations, steps = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 4))
    rounds, size = data.draw(st.integers(1, 12)), data.draw(st.integers(6, 20))
    rng, buffer = np.random.default_rng(0), ReplayBuffer(size, 1, 1, simulations)
    lived = [[] for _ in range(simulations)]
    for moment in range(rounds):
        number = (moment * simulations + np.arange(simulations, dtype=float))[:, None]
        reward, terminated = rng.random(simulations), rng.random(simulations) < 0.2
        ended = terminated | (rng.random(simulations) < 0.2)
        rows = dict(observation=number, next_observation=number + 0.5, action=number)
        buffer.add(**rows, reward=reward, terminated=terminated, ended=ended)
        for k in range(simulations):
            lived[k].append((reward[k], terminated[k], ended[k]))
    batch = {name: value.numpy() for name, value in buffer.sample_steps(rng, 30, steps, 0.9).items()}
    for i in range(30):
        moment, k = divmod(int(batch["observation"][i, 0]), simulations)
        total, factor = 0.0, 1.0
        for at in range(moment, min(moment + steps, rounds)):
            reward, terminated, ended = lived[k][at]
            total, factor = total + factor * reward, factor * 0.9
            if ended:
                break
        assert batch["reward"][i] == pytest.approx(total, rel=1e-5)
        assert batch["discount"][i] == pytest.approx(factor * (1 - terminated), rel=1e-5)
        assert batch["next_observation"][i, 0] == at * simulations + k + 0.5


def test_running_statistics_are_those_of_all_values():
    rng, norm, seen = np.random.default_rng(0), learner().norm, []
    for count in (1, 7, 100, 30):
        seen.append(rng.normal(5, 2, (count, 3)))
        norm.update(seen[-1])
    values = np.concatenate(seen)
    np.testing.assert_allclose(norm.mean, values.mean(0), rtol=1e-4)
    np.testing.assert_allclose(norm.std, values.std(0), rtol=1e-3)


def test_a_share_of_the_simulations_acts_by_the_mean():
    sac, observation = learner(greedy_fraction=0.5), np.zeros((8, 3), np.float32)
    first, second = sac.act(observation), sac.act(observation)
    np.testing.assert_array_equal(first[:4], second[:4])
    assert (first[4:] != second[4:]).all()
