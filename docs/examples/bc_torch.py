"""Behavior cloning from images in torch: python bc_torch.py releases/demo walker-walk/expert/dynamic"""

import sys

import torch
from torch import nn
from torch.utils.data import DataLoader, RandomSampler

import dmcvb_gen

STEPS = 100
torch.manual_seed(0)
subset = dmcvb_gen.open(sys.argv[1])[sys.argv[2]]
source = subset.source(stack=3, pictures="agents")  # len(source), source[i]: numpy alone
first = source[0]
channels, size, _ = first["pixels"].shape
encoder = nn.Sequential(
    nn.Conv2d(channels, 32, 3, stride=2, padding=1),
    nn.ReLU(),
    nn.Conv2d(32, 32, 3, stride=2, padding=1),
    nn.ReLU(),
    nn.Flatten(),
)
policy = nn.Sequential(encoder, nn.LazyLinear(256), nn.ReLU(), nn.Linear(256, len(first["action"])), nn.Tanh())
policy(torch.zeros(1, channels, size, size))  # fixes the size of the lazy layer
optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
drawn = RandomSampler(source, replacement=True, num_samples=64 * STEPS)
losses = []
for batch in DataLoader(source, batch_size=64, sampler=drawn):
    loss = nn.functional.mse_loss(policy(batch["pixels"] / 255 - 0.5), batch["action"])
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    losses.append(loss.item())
print(f"loss {losses[0]:.4f} -> {losses[-1]:.4f} after {len(losses)} steps of {len(source)} samples")


@torch.no_grad()
def act(observation):
    return policy(torch.as_tensor(observation["pixels"]) / 255 - 0.5)


task, _, setting = sys.argv[2].split("/")
score = dmcvb_gen.evaluate(act, f"{task}/{setting}", episodes=4, max_steps=100, size=size)
print(f"return {score.mean:.1f} +- {score.stderr:.1f} over 4 fresh episodes of 100 steps")
