"""TD3-BC written from the paper's equations alone, for tests: functions of weights that share nothing with our learner.

Fujimoto & Gu 2021, and DMC-VB's appendix "Agent details": critics learn y = r + gamma d min(Q1', Q2')(s', a~); every
second step the actor minimizes - lambda Q1(s, pi(s)) + |pi(s) - a|^2, lambda = alpha / mean |Q1|, and targets follow
by a hundredth. Networks are two ReLU layers with tanh at the end, behind trunks of linear, LayerNorm, tanh; the actor's
loss moves both trunks.
"""

from __future__ import annotations

import torch

ALPHA, GAMMA, NOISE, CLIP, KEEP, RATE = 2.5, 0.99, 0.2, 0.5, 0.99, 1e-3


def trunk(w, name, s):
    x = s @ w[f"{name}.0.weight"].T + w[f"{name}.0.bias"]
    mean, var = x.mean(1, keepdim=True), x.var(1, unbiased=False, keepdim=True)
    return torch.tanh((x - mean) / (var + 1e-5).sqrt() * w[f"{name}.1.weight"] + w[f"{name}.1.bias"])


def mlp(w, name, x):
    for layer in (0, 2):
        x = torch.relu(x @ w[f"{name}.{layer}.weight"].T + w[f"{name}.{layer}.bias"])
    return torch.tanh(x @ w[f"{name}.4.weight"].T + w[f"{name}.4.bias"])


def act(w, s):
    return mlp(w, "actor", trunk(w, "actor_trunk", s))


def value(w, name, s, a):
    return mlp(w, name, torch.cat([trunk(w, "critic_trunk", s), a], 1))[:, 0]


class Adam:
    """Kingma & Ba 2015, with the usual decays."""

    def __init__(self):
        self.m, self.v, self.t = {}, {}, 0

    def step(self, w, grads):
        self.t += 1
        for name, g in grads.items():
            m = self.m[name] = 0.9 * self.m.get(name, 0) + 0.1 * g
            v = self.v[name] = 0.999 * self.v.get(name, 0) + 0.001 * g * g
            w[name] = w[name] - RATE * (m / (1 - 0.9**self.t)) / ((v / (1 - 0.999**self.t)).sqrt() + 1e-8)


def gradients(w, loss, parts):
    """Of a loss of weights, by the weights whose names begin with one of `parts`."""
    names = [name for name in w if name.startswith(parts)]
    held = w | {name: w[name].detach().requires_grad_() for name in names}
    return dict(zip(names, torch.autograd.grad(loss(held), [held[name] for name in names]), strict=True))


def train(w, batches, noises):
    """Weights after a step on each batch (s, a, r, d, s'), with the given target noise."""
    target, critic, actor = dict(w), Adam(), Adam()
    for step, ((s, a, r, d, after), noise) in enumerate(zip(batches, noises, strict=True)):
        smoothed = (act(target, after) + (NOISE * noise).clamp(-CLIP, CLIP)).clamp(-1, 1)
        least = torch.minimum(value(target, "critic1", after, smoothed), value(target, "critic2", after, smoothed))
        y = r + GAMMA * d * least

        def critic_loss(w, s=s, a=a, y=y):
            return sum(((value(w, name, s, a) - y) ** 2).mean() for name in ("critic1", "critic2"))

        def actor_loss(w, s=s, a=a):
            chosen = act(w, s)
            q = value(w, "critic1", s, chosen)
            return -ALPHA / q.abs().mean().detach() * q.mean() + ((chosen - a) ** 2).mean()

        critic.step(w, gradients(w, critic_loss, ("critic1", "critic2")))
        if step % 2:
            actor.step(w, gradients(w, actor_loss, ("actor.", "actor_trunk", "critic_trunk")))
            target = {name: KEEP * target[name] + (1 - KEEP) * w[name] for name in w}
    return w
