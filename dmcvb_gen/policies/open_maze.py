"""Turn what an ant sees and its next waypoint into what it would see in an open maze with its goal there.

A policy that runs straight to goals gets through every maze when it is shown a point on the way instead of the goal.
A small network, part of the policy, gives that point: from where the ant and the goal are, never from the layout.
"""

from __future__ import annotations

import numpy as np

from dmcvb_gen.tasks.ant_maze.task import BEHAVIOUR_FIELDS, FIELDS
from dmcvb_gen.tasks.base import slices_of

PLACE_SCALE = np.float32(5.0)
"""Meters that count as 1 to the network."""


_COLUMNS = slices_of({name: FIELDS[name] for name in BEHAVIOUR_FIELDS})


def places(observation: np.ndarray) -> np.ndarray:
    """(n, observation) of behaviour policies in mazes -> (n, `WAY_SIZE`) float32: x, y of ant and of goal, meters."""
    ant, goal = observation[:, _COLUMNS["walker_position"]], observation[:, _COLUMNS["target_position"]]
    return np.concatenate([ant[:, :2], goal[:, :2]], axis=1, dtype=np.float32)


def open_maze_observation(observation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return what the ant would see in the middle of an open maze with its goal at `vector` from it.

    The torso's frame follows from two directions that are seen in it, up and to the true goal.

    Args:
      observation: (n, observation), what behaviour policies in mazes see.
      vector: (n, 2) meters, x and y of the world.

    Returns:
      (n, observation) float32.
    """
    seen = {name: observation[:, part].astype(np.float64) for name, part in _COLUMNS.items()}
    (x, y, rise), (to_x, to_y) = seen["target_vector"].T, np.asarray(vector, np.float64).T
    away = np.maximum(np.sqrt(x * x + y * y), 1e-6)
    up = seen["world_zaxis"]
    forward = (seen["egocentric_target_vector"] - rise[:, None] * up) / away[:, None]
    left = np.stack([up[:, i] * forward[:, j] - up[:, j] * forward[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    ahead, aside = (to_x * x + to_y * y) / away, (to_y * x - to_x * y) / away
    out = np.array(observation, np.float32)
    nowhere = np.zeros_like(x)
    height, goal_height = seen["walker_position"][:, 2], seen["target_position"][:, 2]
    out[:, _COLUMNS["target_position"]] = np.stack([to_x, to_y, goal_height], axis=1)
    out[:, _COLUMNS["target_vector"]] = np.stack([to_x, to_y, rise], axis=1)
    out[:, _COLUMNS["egocentric_target_vector"]] = ahead[:, None] * forward + aside[:, None] * left + rise[:, None] * up
    out[:, _COLUMNS["walker_position"]] = np.stack([nowhere, nowhere, height], axis=1)
    return out
