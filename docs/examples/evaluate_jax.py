"""A policy of your own from states in JAX, scored as `validate` scores its agents.

python evaluate_jax.py releases/demo walker-walk/expert/dynamic
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import dmcvb_gen

STEPS = 2_000


def train(source, seed=0):
    """A policy from a source of steps: gather(indices) gives "state" and "action" of steps as numpy arrays."""
    rng = np.random.default_rng(seed)
    every = source.gather(np.arange(len(source)))
    mean, scale = every["state"].mean(axis=0), every["state"].std(axis=0) + 1e-3
    sizes = (every["state"].shape[1], 256, 256, every["action"].shape[1])
    keys = jax.random.split(jax.random.key(seed), len(sizes) - 1)
    make = jax.nn.initializers.orthogonal()
    weights = [make(key, shape) for key, shape in zip(keys, zip(sizes[:-1], sizes[1:], strict=True), strict=True)]

    def network(weights, state):
        x = (state - mean) / scale
        for matrix in weights[:-1]:
            x = jax.nn.relu(x @ matrix)
        return jnp.tanh(x @ weights[-1])

    def loss(weights, state, action):
        return jnp.mean((network(weights, state) - action) ** 2)

    optimizer = optax.adam(1e-3)
    state, value_and_grad = optimizer.init(weights), jax.jit(jax.value_and_grad(loss))
    for _ in range(STEPS):
        chosen = rng.integers(len(source), size=256)
        _, gradient = value_and_grad(weights, every["state"][chosen], every["action"][chosen])
        updates, state = optimizer.update(gradient, state)
        weights = optax.apply_updates(weights, updates)
    act = jax.jit(lambda seen: network(weights, seen))
    return lambda observation: act(observation["state"])  # (episode, state) -> (episode, action) in [-1, 1]


if __name__ == "__main__":
    release, subset = sys.argv[1:3]
    episodes, steps = (int(value) for value in (*sys.argv[3:], 30, 500)[:2])  # fewer and shorter ones to try it
    source = dmcvb_gen.open(release)[subset].source(pictures=())
    policy = train(source)
    task, _, setting = subset.split("/")
    score = dmcvb_gen.evaluate(policy, f"{task}/{setting}", episodes=episodes, pixels=False, max_steps=steps)
    print(f"return {score.mean:.1f} +- {score.stderr:.1f} over {len(score.returns)} episodes")
