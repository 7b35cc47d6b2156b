"""A policy of your own from images in torch, scored as `validate` scores its agents.

python evaluate_torch.py releases/demo walker-walk/expert/dynamic
"""

import sys

import torch
from torch import nn

import dmcvb_gen

STEPS = 100


def train(source, seed=0):
    """A policy from a source of steps: gather(indices) gives "pixels", "state", "action" of steps as numpy arrays."""
    generator = torch.Generator().manual_seed(seed)
    network = nn.Sequential(
        nn.LazyConv2d(32, 4, stride=4),
        nn.ReLU(),
        nn.Conv2d(32, 32, 3, stride=2),
        nn.ReLU(),
        nn.Flatten(),
        nn.LazyLinear(256),
        nn.ReLU(),
        nn.LazyLinear(len(source[0]["action"])),
        nn.Tanh(),
    )

    def act(observation):
        """{"pixels": (episode, stack x view x 3, size, size) uint8, ...} -> (episode, action) in [-1, 1]."""
        return network(torch.as_tensor(observation["pixels"]) / 255 - 0.5)

    act({"pixels": source[0]["pixels"][None]})  # fixes the sizes of the lazy layers
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(STEPS):
        batch = source.gather(torch.randint(len(source), (64,), generator=generator).numpy())
        loss = nn.functional.mse_loss(act(batch), torch.as_tensor(batch["action"]))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return torch.no_grad()(act)


if __name__ == "__main__":
    release, subset = sys.argv[1:3]
    episodes, steps = (int(value) for value in (*sys.argv[3:], 30, 500)[:2])  # fewer and shorter ones to try it
    source = dmcvb_gen.open(release)[subset].source(stack=3, pictures="agents")
    policy = train(source)
    task, _, setting = subset.split("/")
    size = source[0]["pixels"].shape[-1]
    score = dmcvb_gen.evaluate(policy, f"{task}/{setting}", episodes=episodes, size=size, max_steps=steps)
    print(f"return {score.mean:.1f} +- {score.stderr:.1f} over {len(score.returns)} episodes")
