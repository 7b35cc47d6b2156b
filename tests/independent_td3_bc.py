"""TD3-BC written from the paper's equations alone, for tests: it shares nothing with our learner but torch's Adam.

Fujimoto & Gu 2021, and DMC-VB's appendix "Agent details": critics learn y = r + gamma d min(Q1', Q2')(s', a~); every
second step the actor minimizes - lambda Q1(s, pi(s)) + |pi(s) - a|^2, lambda = alpha / mean |Q1|, and targets follow
by a hundredth. Networks are two ReLU layers with tanh at the end, behind trunks of linear, LayerNorm, tanh; the actor's
loss moves both trunks.
"""

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


def adam(w, *parts):
    return torch.optim.Adam([weight for name, weight in w.items() if name.startswith(parts)], lr=RATE)


def minimize(optimizer, loss):
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def train(w, batches, noises):
    """Weights after a step on each batch (s, a, r, d, s'), with the given target noise."""
    w, target = ({name: weight.clone() for name, weight in w.items()} for _ in range(2))
    for weight in w.values():
        weight.requires_grad_()
    critic, actor = adam(w, "critic1", "critic2"), adam(w, "actor.", "actor_trunk", "critic_trunk")
    for step, ((s, a, r, d, after), noise) in enumerate(zip(batches, noises, strict=True)):
        smoothed = (act(target, after) + (NOISE * noise).clamp(-CLIP, CLIP)).clamp(-1, 1)
        least = torch.minimum(value(target, "critic1", after, smoothed), value(target, "critic2", after, smoothed))
        y = r + GAMMA * d * least
        minimize(critic, sum(((value(w, name, s, a) - y) ** 2).mean() for name in ("critic1", "critic2")))
        if step % 2:
            chosen = act(w, s)
            q = value(w, "critic1", s, chosen)
            minimize(actor, -ALPHA / q.abs().mean().detach() * q.mean() + ((chosen - a) ** 2).mean())
            target = {name: KEEP * target[name] + (1 - KEEP) * w[name].detach() for name in w}
    return {name: weight.detach() for name, weight in w.items()}
