"""Behavior cloning from images in JAX: python bc_jax.py releases/demo walker-walk/expert/dynamic"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import dmcvb_gen

STEPS = 100
subset = dmcvb_gen.open(sys.argv[1])[sys.argv[2]]
source = subset.source(stack=3, pictures="agents")  # len(source), source[i]: numpy alone
channels, size, _ = source[0]["pixels"].shape
shapes = {"first": (32, channels, 3, 3), "second": (32, 32, 3, 3)}  # out, in, height, width
shapes |= {"dense": (256, 32 * (-(-size // 4)) ** 2), "last": (len(source[0]["action"]), 256)}
keys = dict(zip(shapes, jax.random.split(jax.random.key(0), len(shapes)), strict=True))
weights = {name: jax.nn.initializers.he_normal(1, 0)(keys[name], shape) for name, shape in shapes.items()}


def act(weights, pixels):
    x = pixels / 255 - 0.5
    for name in ("first", "second"):
        x = jax.nn.relu(jax.lax.conv(x, weights[name], window_strides=(2, 2), padding="SAME"))
    x = jax.nn.relu(x.reshape(len(x), -1) @ weights["dense"].T)
    return jnp.tanh(x @ weights["last"].T)


def loss(weights, pixels, actions):
    return jnp.mean((act(weights, pixels) - actions) ** 2)


optimizer = optax.adam(3e-4)
state, value_and_grad = optimizer.init(weights), jax.jit(jax.value_and_grad(loss))
rng, losses = np.random.default_rng(0), []
for _ in range(STEPS):
    batch = source.gather(rng.integers(len(source), size=64))
    value, gradient = value_and_grad(weights, batch["pixels"], batch["action"])
    updates, state = optimizer.update(gradient, state)
    weights = optax.apply_updates(weights, updates)
    losses.append(float(value))
print(f"loss {losses[0]:.4f} -> {losses[-1]:.4f} after {STEPS} steps of {len(source)} samples")
task, _, setting = sys.argv[2].split("/")
trained = jax.jit(lambda pixels: act(weights, pixels))
score = dmcvb_gen.evaluate(
    lambda observation: trained(observation["pixels"]), f"{task}/{setting}", episodes=4, max_steps=100, size=size
)
print(f"return {score.mean:.1f} +- {score.stderr:.1f} over 4 fresh episodes of 100 steps")
