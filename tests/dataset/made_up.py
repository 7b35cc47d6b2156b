"""Releases of made-up values: two settings that share trajectories, without a simulator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import numpy as np

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import Layer, Resolved, SubsetRecord, record_path
from dmcvb_gen.dataset.schema import image_array, label_arrays, trajectory_arrays
from dmcvb_gen.dataset.writer import begin, finish, put_shard
from dmcvb_gen.storage.store import Store

PER_SHARD, MAX_STEPS, SIZE = 2, 5, 4
TASK = SimpleNamespace(
    views=("pixels",),
    state_slices={"a": slice(0, 2)},
    state_size=2,
    action_low=(-1.0, -1.0),
    action_high=(1.0, 1.0),
    physics_size=3,
    material_colors=((0, 0, 0),),
    array_attributes={},
)


def _layer(name: str, group: str, kind: str, arrays: Sequence, **makes: object) -> Layer:
    facts = {"rows": MAX_STEPS + 1, "episodes_per_shard": PER_SHARD, "makes": makes}
    return Layer(name=name, group=group, kind=kind, arrays=tuple(arrays), **facts)


KEPT = ("state", "action", "length", "return", "goal_pair", "exogenous/style", "exogenous/camera_position")
"""Few arrays, so that all operations can be killed."""
TRAJECTORIES = _layer(
    "hop/random/trajectories",
    "hop/random.zarr/trajectories",
    "trajectories",
    [spec for spec in trajectory_arrays(TASK) if spec.name in KEPT],
    seed=1,
)


def setting_layers(setting: str, **makes: object) -> tuple[Layer, Layer]:
    """Labels and images of a setting."""
    name, group = f"hop/random/{setting}", f"hop/random.zarr/{setting}"
    arrays = [spec for spec in label_arrays(TASK) if spec.name in KEPT]
    labels = _layer(f"{name}/labels", group, "labels", arrays, of=TRAJECTORIES.key, setting=setting)
    image = image_array("pixels", SIZE, setting == "dynamic", MAX_STEPS + 1)
    return labels, _layer(f"{name}/pixels", group, "images", [image], of=labels.key, **makes)


def recipe(episodes: int, settings: Sequence[str] = ("none", "dynamic"), images: bool = True, **fields) -> Resolved:
    """A recipe of `episodes` episodes for each setting."""
    layers, subsets = [TRAJECTORIES], []
    for setting in settings:
        own = setting_layers(setting)[: 2 if images else 1]
        layers += own
        subsets.append(
            SubsetRecord(
                name=f"hop/random/{setting}",
                task="hop",
                level="random",
                setting=setting,
                episodes=episodes,
                layers=(TRAJECTORIES.name, *[layer.name for layer in own]),
                size=SIZE,
                max_steps=MAX_STEPS,
                renderer={"name": "native"},
            )
        )
    facts = {"name": "hop", "version": "1.0.0", "license": "CC-BY-4.0"} | fields
    return Resolved(recipe={"episodes": episodes}, layers=tuple(layers), subsets=tuple(subsets), **facts)


def values(layer: Layer, shard: int) -> Iterator[tuple[str, np.ndarray]]:
    """Values of a shard: a function of the layer's key and the shard's number."""
    rng = np.random.default_rng([int(layer.key[:8], 16), shard])
    for spec in layer.arrays:
        shape = (PER_SHARD, *([MAX_STEPS + 1] if spec.steps else []), *spec.shape)
        made = (rng.random(shape) * 100).astype(spec.dtype)
        if spec.name == "length":
            made = rng.integers(1, MAX_STEPS + 1, shape).astype(np.int32)
        if spec.name == "goal_pair":
            made[:] = 0  # an array of fill values has no file
        yield spec.name, made


def make(store: Store, wanted: Resolved) -> Release:
    """What rollouts do: begin, make the shards that have no record, finish."""
    begin(store, wanted, {})
    for layer in wanted.layers:
        episodes = max(subset.episodes for subset in wanted.subsets if layer.name in subset.layers)
        for shard in range(layer.shards_for(episodes)):
            if store.size(record_path(layer.name, shard)) is None:
                put_shard(store, layer, shard, values(layer, shard))
    return finish(store)
