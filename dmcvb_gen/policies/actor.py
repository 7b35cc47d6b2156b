"""Compute a policy's actions for a batch of observations, with the same bits on every processor.

Every sum is added up in one fixed order, from the first input to the last, and every function comes from `arithmetic`;
so an action depends on its own observation alone, not on the rows beside it nor on the machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.kept import kept_njit
from dmcvb_gen.policies.header import LOG_STD_RANGE, PolicyHeader
from dmcvb_gen.policies.open_maze import PLACE_SCALE, open_maze_observation, places
from dmcvb_gen.tasks.base import Task


@kept_njit(nogil=True, error_model="numpy")
def _affine(x, weight, bias, out):
    """out = bias + x @ weight, each entry added up from the first input to the last.

    Four rows share what is loaded of the weights, and four inputs what is loaded of the sums; neither changes the
    order in which a sum is made.
    """
    inputs, outputs = weight.shape
    for row in range(len(x)):
        for j in range(outputs):
            out[row, j] = bias[j]
    rows = len(x) // 4 * 4
    ends = inputs // 4 * 4
    for row in range(0, rows, 4):
        for i in range(0, ends, 4):
            a0, a1, a2, a3 = x[row, i], x[row, i + 1], x[row, i + 2], x[row, i + 3]
            b0, b1, b2, b3 = x[row + 1, i], x[row + 1, i + 1], x[row + 1, i + 2], x[row + 1, i + 3]
            c0, c1, c2, c3 = x[row + 2, i], x[row + 2, i + 1], x[row + 2, i + 2], x[row + 2, i + 3]
            d0, d1, d2, d3 = x[row + 3, i], x[row + 3, i + 1], x[row + 3, i + 2], x[row + 3, i + 3]
            for j in range(outputs):
                w0, w1, w2, w3 = weight[i, j], weight[i + 1, j], weight[i + 2, j], weight[i + 3, j]
                out[row, j] = (((out[row, j] + a0 * w0) + a1 * w1) + a2 * w2) + a3 * w3
                out[row + 1, j] = (((out[row + 1, j] + b0 * w0) + b1 * w1) + b2 * w2) + b3 * w3
                out[row + 2, j] = (((out[row + 2, j] + c0 * w0) + c1 * w1) + c2 * w2) + c3 * w3
                out[row + 3, j] = (((out[row + 3, j] + d0 * w0) + d1 * w1) + d2 * w2) + d3 * w3
    for row in range(len(x)):
        for i in range(ends if row < rows else 0, inputs):
            a0 = x[row, i]
            for j in range(outputs):
                out[row, j] += a0 * weight[i, j]


_ACTIVATIONS = {
    "relu": lambda x: np.maximum(x, np.float32(0), out=x),
    "tanh": lambda x: arithmetic.tanh(x).astype(np.float32),
    "elu": lambda x: np.where(x > 0, x, arithmetic.exp(np.minimum(x, 0)) - 1).astype(np.float32),
    "gelu": lambda x: (0.5 * x * (1 + arithmetic.erf(x * np.sqrt(0.5)))).astype(np.float32),
}


class Policy:
    """A behaviour policy, which gives the actions of a whole batch of observations in one call.

    Attributes:
      header: its origin; None for uniform random actions.
      weights: name -> float32, see `header.weight_shapes`.
      digest: SHA-256 of its file ("random" for uniform random actions).
      acts_every: control steps for which its actions are held, if the task's agent steps are shorter; None: it acts at
        each agent step.
      unit: True if its actions lie in [-1, 1], whatever the task's bounds; they are scaled (`Task.from_unit`).
    """

    unit = True
    acts_every: int | None = None

    def __init__(self, header: PolicyHeader, weights: Mapping[str, np.ndarray], digest: str):
        self.header, self.weights, self.digest = header, dict(weights), digest
        self.acts_every = header.acts_every
        # Rows of inputs: neighboring outputs lie beside each other, for vectors of sums.
        self._rows = {
            name: np.ascontiguousarray(value.T, np.float32) for name, value in self.weights.items() if value.ndim == 2
        }
        self._biases = {name: np.array(value, np.float32) for name, value in self.weights.items() if value.ndim == 1}

    def check(self) -> None:
        """Raise PolicyFileError if its actions do not follow from observations alone; asked after simulations."""

    def _dense(self, name: str, x: np.ndarray) -> np.ndarray:
        weight = self._rows[f"{name}.weight"]
        out = np.empty((len(x), weight.shape[1]), np.float32)
        _affine(x, weight, self._biases[f"{name}.bias"], out)
        return out

    def predict_waypoint(self, observation: np.ndarray) -> np.ndarray:
        """(n, observation) -> (n, 2) float32 meters: where a policy that knows the way heads, seen from the ant."""
        x = places(np.asarray(observation)) / PLACE_SCALE
        last = 2 * len(self.header.way or ())
        for place in range(0, last, 2):
            x = np.maximum(self._dense(f"way.{place}", x), np.float32(0))
        return self._dense(f"way.{last}", x)

    def _features(self, observation: np.ndarray) -> np.ndarray:
        header, weights = self.header, self.weights
        if header.way is not None:
            observation = open_maze_observation(observation, self.predict_waypoint(observation))
        limit = np.float32(header.clip_observation)
        x = (np.asarray(observation, np.float32) - weights["observation_mean"]) / weights["observation_std"]
        x = np.ascontiguousarray(np.clip(x, -limit, limit))
        for index in range(len(header.hidden)):
            x = _ACTIVATIONS[header.activation](self._dense(f"body.{2 * index}", x))
        return x

    def distribution(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, observation) -> mean and standard deviation before squashing, each (n, action) float64."""
        header, features = self.header, self._features(observation)
        mean = self._dense("mean", features).astype(np.float64)
        if header.distribution == "squashed_gaussian":
            return mean, arithmetic.exp(np.clip(self._dense("log_std", features), *LOG_STD_RANGE))
        if header.distribution == "gaussian":
            return mean, np.broadcast_to(arithmetic.exp(self.weights["log_std_vector"]), mean.shape)
        return mean, np.full(mean.shape, header.noise)

    def act(
        self,
        observation: np.ndarray,
        generators: Sequence[np.random.Generator] | None = None,
        deterministic: bool = False,
    ) -> np.ndarray:
        """Actions for a batch.

        Args:
          observation: (n, observation), an episode batch's `behaviour_observation`.
          generators: one a row, the source of its noise; needed unless deterministic.
          deterministic: take the mean action.

        Returns:
          (n, action) float32 in [-1, 1].
        """
        mean, std = self.distribution(observation)
        noise = 0.0 if deterministic else std * _noise(generators or (), mean.shape[1])
        if self.header.distribution == "gaussian":
            action = np.clip(mean + noise, -1, 1)
        elif self.header.distribution == "deterministic":
            action = np.clip(arithmetic.tanh(mean) + noise, -1, 1)
        else:
            action = arithmetic.tanh(mean + noise)
        return action.astype(np.float32)


def _noise(generators: Sequence[np.random.Generator], size: int) -> np.ndarray:
    """(n, size) standard normal numbers, each row from its own stream."""
    uniform = np.stack([rng.random(size + size % 2) for rng in generators])
    return arithmetic.gaussian(uniform)[:, :size]


class RandomPolicy(Policy):
    """Actions uniform in [-1, 1] (level "random"); there is no mean action of these, they are always drawn."""

    def __init__(self, task: Task):
        self.header = None  # type: ignore[assignment]  # no file, so no header
        self.weights, self.digest, self._action_size = {}, "random", task.action_size

    def act(self, observation, generators=None, deterministic=False):
        draws = [rng.random(self._action_size, np.float32) for rng in generators]
        return np.stack(draws) * np.float32(2) - np.float32(1)
