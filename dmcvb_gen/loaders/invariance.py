"""Measure what an encoder keeps: the state, or what distracts from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.loaders.release import SubsetReader
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.cameras import nominal_cameras

ENCODED = 64
"""Images that an encoder gets at a time."""
RIDGE = 1e-3
"""Weight of the squared coefficients of a probe, a sample."""
SAME = 1e-5
"""How far labels of the same state may differ by rounding."""


@dataclass(frozen=True)
class Invariance:
    """How an encoder takes images of the same states under several settings.

    Attributes:
      retrieval: share of images whose nearest image under another setting, of all `states` of them, shows the same
        state: 1 for an encoder that sees nothing but the state.
      chance: `retrieval` of an encoder that sees nothing.
      state: R2 of a linear probe of the state on episodes that it did not learn from; 1 is perfect, 0 or less nothing.
      distractors: R2 of a linear probe of the distractors' real-valued labels that differ between the looks of a state,
        the camera's as seen from the model's own camera; NaN if none does.
    """

    retrieval: float
    chance: float
    state: float
    distractors: float


def evaluate_invariance(
    pairs: SubsetReader,
    encoder: Callable[[np.ndarray], Any],
    *,
    states: int = 512,
    episodes: int = 16,
    seed: int = 0,
    **options: Any,
) -> Invariance:
    """See `PairedReader.evaluate_invariance`."""
    if min(len(pairs), episodes, states) < 2:
        what = f"{pairs.name} has {len(pairs)} episodes, of which {episodes} with {states} states are asked for"
        raise DmcvbError(f"{what}; a probe needs 2 of both, to learn from and to be tested on")
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(pairs.episodes)[:episodes])
    source = pairs.source(episodes=chosen, in_memory=True, **options)
    batch = source.gather(sorted(rng.permutation(len(source))[:states].tolist()))
    count, tested = len(batch["step"]), np.isin(batch["episode"], chosen[1::2])
    if tested.all() or not tested.any():
        raise DmcvbError(f"{states} states are of one half of the episodes alone; ask for more")
    features = [_encoded(encoder, batch["pixels"][:, look]) for look in range(pairs.looks)]
    scaled = np.split(_scaled(np.concatenate(features)), pairs.looks)
    places = np.searchsorted(chosen, batch["episode"]), batch["step"]
    position, turn = nominal_cameras(get_task(pairs.task), pairs.read("physics", chosen)[places])
    follows = {"camera_position": position, "camera_quaternion": turn}  # the agent: where it is, is state
    labels = _real([part.labels(chosen)[places] for part in pairs.parts], follows)
    labels = labels[:, np.ptp(labels.reshape(pairs.looks, count, -1), axis=0).max(axis=0, initial=0) > SAME]
    everywhere, looks = np.concatenate(scaled), np.tile(tested, pairs.looks)
    return Invariance(
        float(np.mean([_found(one, other) for one in scaled for other in scaled if one is not other])),
        1 / count,
        _probe(everywhere, np.tile(batch["state"], (pairs.looks, 1)), looks),
        _probe(everywhere, labels, looks),
    )


def _encoded(encoder: Callable[[np.ndarray], Any], pixels: np.ndarray) -> np.ndarray:
    """(image, feature) float64."""
    parts = [encoder(part) for part in np.split(pixels, range(ENCODED, len(pixels), ENCODED))]
    arrays = [np.asarray(part.detach().cpu() if hasattr(part, "detach") else part, float) for part in parts]
    return np.concatenate(arrays).reshape(len(pixels), -1)


def _scaled(values: np.ndarray) -> np.ndarray:
    """Columns that vary, centered, with a standard deviation of 1."""
    std = values.std(axis=0)
    varies = std > 1e-9 * (1 + np.abs(values).max(axis=0, initial=0))
    return (values[:, varies] - values[:, varies].mean(axis=0)) / std[varies]


def _real(looks: Sequence[DistractorState], state: Mapping[str, np.ndarray]) -> np.ndarray:
    """(look * image, label) of the labels that are real numbers; one that a look does not vary is zero in it.

    Args:
      state: what of a label is the state's own.
    """
    labels = [dict(look.items()) for look in looks]
    real = {name: value for look in labels for name, value in look.items() if value.dtype.kind == "f"}
    found = [
        np.concatenate([look.get(name, np.zeros_like(value)) - state.get(name, 0) for look in labels])
        for name, value in real.items()
    ]
    return np.concatenate([value.reshape(len(value), -1) for value in found], axis=1).astype(float)


def _found(one: np.ndarray, other: np.ndarray) -> float:
    """Share of rows whose nearest row of the other array has their own number."""
    distance = (other**2).sum(axis=1) - 2 * one @ other.T
    return float((distance.argmin(axis=1) == np.arange(len(one))).mean())


def _probe(features: np.ndarray, targets: np.ndarray, tested: np.ndarray) -> float:
    """R2 on the tested rows of a ridge regression on the others."""
    wanted, known = _scaled(targets.astype(float)), np.c_[features, np.ones(len(features))]
    learned, own = known[~tested], wanted[~tested]
    if not wanted.shape[1]:
        return float("nan")
    inner = learned.T @ learned + RIDGE * len(learned) * np.eye(learned.shape[1])
    error = wanted[tested] - known[tested] @ np.linalg.solve(inner, learned.T @ own)
    return float(1 - (error**2).sum() / ((wanted[tested] - own.mean(axis=0)) ** 2).sum())
