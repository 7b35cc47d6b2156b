"""An ant that looks for a goal in a maze: batches of episodes, the reward from a field of distances.

dm_control's locomotion library is the authority: from the same physics state and actions a composer
environment of the same maze gives the same observations and physics (tests/tasks/test_ant_maze.py).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from dmcvb_gen import arithmetic
from dmcvb_gen.spec import ANT_MAZE
from dmcvb_gen.tasks.ant_maze import arena
from dmcvb_gen.tasks.ant_maze.distance import PIXELS, blend, geodesic_field, look_up, saturated_field
from dmcvb_gen.tasks.ant_maze.layouts import Layout
from dmcvb_gen.tasks.base import ACTION_REPEAT, Generators, PhysicsBatch, Places, Task

EPISODE_STEPS, EVALUATION_STEPS = 600, 1000
"""Agent steps of 30 seconds (data) and of 60 seconds (online evaluation)."""
SPAWN_NOISE, GOAL_NOISE = 0.25, 0.5
"""Meters that the spawn lies off its place at most, along x, y and z, and the goal off its cell's center in x and y."""
REACH = 2.0
"""Meters between torso and goal within which a touch is possible during a control step: the ant spans 1.3."""
NEAR = 0.5
"""Meters between ant and goal below which every physics step of a control step is asked for a touch: a foot that
crosses them in one is faster than 20 m/s, and an expert's limbs, also those flung out of the floor, reach 10.3."""
TOUCH_THRESHOLD = 1e-3
"""Newton above which a touch sensor says 1 (dm_control)."""

FIELDS = {
    "distance_to_target": 1,
    "target_position": 3,
    "target_vector": 3,
    "target_activated": 1,
    "appendages_pos": 12,
    "bodies_pos": 39,
    "bodies_quats": 52,
    "body_height": 1,
    "egocentric_target_vector": 3,
    "end_effectors_pos": 12,
    "joints_pos": 8,
    "joints_vel": 8,
    "sensors_accelerometer": 3,
    "sensors_gyro": 3,
    "sensors_touch": 9,
    "sensors_velocimeter": 3,
    "world_zaxis": 3,
    "walker_position": 3,
}
UNSEEN = {"distance_to_target", "target_activated", "appendages_pos", "bodies_pos", "bodies_quats"}
UNSEEN |= {"sensors_accelerometer"}
"""Fields that behaviour policies do not see: they follow from the joints, are noise, or are the reward's."""
BEHAVIOUR_FIELDS = tuple(name for name in FIELDS if name not in UNSEEN)
"""What behaviour policies see: parts of the state, but for the vectors to the goal, which are true ones in meters."""


class AntMazeBatch(PhysicsBatch):
    task: AntMaze

    def __init__(self, task: AntMaze, size: int, threads: int = 1):
        super().__init__(task, size, threads)
        bind, model = self.sims.bind, task.model
        self._mocap, self._geom_xpos, self._geom_xmat = bind("mocap_pos"), bind("geom_xpos"), bind("geom_xmat")
        self._torso = model.body("walker/torso").id
        self._ant = np.array([i for i in range(model.ngeom) if model.geom(i).name.startswith("walker/")])
        capsule = model.geom_type[self._ant] == mujoco.mjtGeom.mjGEOM_CAPSULE
        self._half = np.where(capsule, model.geom_size[self._ant, 1], 0.0)
        self._radius = model.geom_size[self._ant, 0]
        self._columns_of = {
            "bodies_pos": _sensor_columns(model, "_ego_body_pos"),
            "bodies_quats": _sensor_columns(model, "_ego_body_quat"),
            "end_effectors_pos": _sensor_columns(model, "_end_effector"),
            "sensors_accelerometer": _sensor_columns(model, "torso_accel"),
            "sensors_gyro": _sensor_columns(model, "torso_gyro"),
            "sensors_touch": _sensor_columns(model, "_touch"),
            "sensors_velocimeter": _sensor_columns(model, "torso_vel"),
        }
        shape = tuple(PIXELS * cells for cells in task.layout.shape)
        self._fields, self._largest = np.zeros((size, *shape)), np.ones(size)
        self._touched = np.zeros(size, bool)
        self._paths: np.ndarray | None = None

    # -- starting -----------------------------------------------------------------------------

    def _initialize(self, ids, generators):
        free = self.task.layout.free
        for sim, rng in zip(ids, generators, strict=True):
            start = int(rng.integers(len(free)))
            goal = int(rng.integers(len(free) - 1))
            self._place(sim, rng, free[start], free[goal + (goal >= start)])
        self._refresh(ids)

    def reset_fixed(self, generators: Generators, pairs: Sequence[tuple], ids: Places = None) -> np.ndarray:
        """Start episodes at given (start, goal) cells; offsets and yaw are drawn as ever.

        Returns:
          (size, state) float64.

        Raises:
          LayoutError: a start or a goal in a wall.
        """
        ids, layout = self._all if ids is None else np.asarray(ids, int), self.task.layout
        self._clear(ids)
        for sim, rng, (start, goal) in zip(ids, generators, pairs, strict=True):
            layout.check_cell(start, "start")  # the goal's field is asked for by `_refresh`, which checks its cell
            self._place(sim, rng, start, goal)
        self._refresh(ids)
        return self.state()

    def sink(self, ids: np.ndarray, offsets: np.ndarray) -> None:
        """Put ants that have just started at other heights, as spawn offsets along z do.

        Args:
          offsets: (len(ids),) meters, within +-`SPAWN_NOISE`. Below about -0.15 an ant is flung up to a meter high,
            and next to a wall it may come down on its back, where it stays.
        """
        self._qpos[ids, 2] = offsets
        self._refresh(ids)

    def _place(self, sim: int, rng: np.random.Generator, start: tuple[int, int], goal: tuple[int, int]) -> None:
        layout, offsets, yaw = self.task.layout, rng.uniform(-1, 1, 5), rng.uniform(0, 2 * np.pi)
        self._qpos[sim] = 0  # joints too
        self._qpos[sim, :3] = np.append(layout.world(start), 0) + SPAWN_NOISE * offsets[:3]
        self._qpos[sim, 6], self._qpos[sim, 3] = arithmetic.sin_cos(yaw / 2)
        self._mocap[sim, 0] = *(layout.world(goal) + GOAL_NOISE * offsets[3:]), 0

    def _refresh(self, ids):
        # Accelerometer and touch are of the last stage; dm_control's reset computes them without actuation.
        self._ctrl[ids] = 0
        self.sims.forward(ids=ids)
        self._touched[ids] = False
        for sim in ids:
            goal = self._mocap[sim, 0]
            row, column = np.rint(self.task.layout.grid(goal[:2])).astype(int).tolist()
            field = saturated_field(self.task.layout, (row, column))
            self._fields[sim], self._largest[sim] = field.values, field.largest
            if self._paths is not None:
                self._paths[sim] = geodesic_field(self.task.layout, goal).values
        self._touched[ids] = self._gaps(ids) < 0

    # -- stepping -----------------------------------------------------------------------------

    def _advance(self, ids):
        ids = self._all if ids is None else ids
        whole, gaps = self.task.substeps, self._gaps(ids)
        left = np.full(len(ids), whole)
        while len(ids):  # a touch counts at any physics step, as in dm_control
            count = np.select([gaps >= NEAR, gaps >= NEAR / 5], [whole, whole // 5], 1)
            count = np.minimum(left, count)  # steps that cannot end in a touch; 1 if the next one can
            for steps in np.unique(count).tolist():
                some = ids[count == steps]
                self.sims.step(ids=some, nstep=steps, stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            gaps = self._gaps(ids)
            self._touched[ids] |= gaps < 0
            left = left - count
            ids, gaps, left = ids[left > 0], gaps[left > 0], left[left > 0]

    def _gaps(self, ids: np.ndarray) -> np.ndarray:
        """(len(ids),) meters between the goal's sphere and the ant's nearest geom, negative where they overlap.

        Infinite for ants so far away that none of their geoms is near.
        """
        goal, gaps = self.goal()[ids], np.full(len(ids), np.inf)
        to_torso = goal[:, :2] - self._xpos[ids, self._torso, :2]
        close = np.flatnonzero((to_torso * to_torso).sum(axis=1) < (REACH + NEAR) ** 2)
        geoms = np.ix_(ids[close], self._ant)
        centers, axes = self._geom_xpos[geoms], self._geom_xmat[geoms][..., 2::3]
        to_goal = goal[close, None] - centers
        along = np.clip((to_goal * axes).sum(axis=-1), -self._half, self._half)
        away = np.linalg.norm(to_goal - along[..., None] * axes, axis=-1)
        gaps[close] = (away - self._radius).min(axis=1) - arena.GOAL_RADIUS
        return gaps

    # -- what it gives ------------------------------------------------------------------------

    def goal(self) -> np.ndarray:
        """(size, 3): center of the goal's sphere, meters."""
        return self._mocap[:, 0] + [0, 0, arena.GOAL_HEIGHT]

    def behaviour_observation(self):
        position, goal = self._xpos[:, self._torso], self.goal()
        values = self._proprioception() | {
            "target_position": goal,
            "target_vector": goal - position,
            "egocentric_target_vector": self._egocentric(goal - position),
            "walker_position": position,
        }
        return np.concatenate([values[name] for name in BEHAVIOUR_FIELDS], axis=1, dtype=np.float32)

    def distance(self) -> np.ndarray:
        """(size,): meters to the goal as the reward measures them."""
        return look_up(self.task.layout, self._fields, self._xpos[:, self._torso, :2])

    def track_paths(self) -> None:
        """Keep fields of the shortest path for `path_length`, from the next reset on."""
        self._paths = np.zeros_like(self._fields)

    def path_length(self) -> np.ndarray:
        """(size,): length of the shortest path to the goal's center, meters; 0 once it is touched."""
        position = self._xpos[:, self._torso, :2]
        assert self._paths is not None  # `track_paths` came first
        return np.where(self._touched, 0.0, blend(self.task.layout, self._paths, position))

    def state(self):
        position, goal = self._xpos[:, self._torso], self.goal()
        values = self._proprioception()
        values |= {
            "distance_to_target": self.distance()[:, None],
            "target_position": goal,
            "target_vector": goal - position,
            "target_activated": self._touched[:, None],
            "appendages_pos": values["end_effectors_pos"],
            # As released: not to the goal, but to a point above the middle of the maze (SPEC, section 3).
            "egocentric_target_vector": self._egocentric(np.array([0, 0, arena.GOAL_HEIGHT]) - position),
            "walker_position": position,
        }
        return np.concatenate([np.asarray(values[name], np.float64) for name in FIELDS], axis=1)

    def _proprioception(self) -> dict[str, np.ndarray]:
        """The state's fields that know neither place nor goal."""
        values = {name: self._sensors[:, columns] for name, columns in self._columns_of.items()}
        return values | {
            "body_height": self._xpos[:, self._torso, 2:],
            "joints_pos": self._qpos[:, 7:],
            "joints_vel": self._qvel[:, 6:],
            "sensors_touch": values["sensors_touch"] > TOUCH_THRESHOLD,
            "world_zaxis": self._xmat[:, self._torso, 6:],
        }

    def _egocentric(self, vector: np.ndarray) -> np.ndarray:
        """(size, 3) of the world -> the same in the torso's frame."""
        frame = self._xmat[:, self._torso].reshape(self.size, 3, 3)
        return arithmetic.total((vector[..., None] * frame).transpose(1, 0, 2))

    def _control_reward(self):
        return -np.clip(self.distance() / self._largest, 0.0, 1.0)

    def _control_terminated(self):
        return self._touched.copy()


def _sensor_columns(model: mujoco.MjModel, suffix: str) -> np.ndarray:
    """Columns of sensordata of the sensors whose names end so, in the model's order."""
    chosen = [model.sensor(index).name.endswith(suffix) for index in range(model.nsensor)]
    return np.flatnonzero(np.repeat(chosen, model.sensor_dim))  # sensors lie one after another


class AntMaze(Task):
    """An ant in a maze, rewarded with minus its distance to the goal over the largest distance (SPEC: r = -d/d_max).

    Args:
      layout: the maze.
      id: the task's name.
    """

    family = ANT_MAZE
    state_fields = FIELDS
    observation = "proprioception and true goal vectors"
    behaviour_size = sum(FIELDS[name] for name in BEHAVIOUR_FIELDS)
    max_steps, evaluation_steps = EPISODE_STEPS, EVALUATION_STEPS
    substeps = 25  # 1 ms physics, 25 ms control
    views = tuple(arena.CAMERAS)
    cameras = tuple(arena.CAMERAS.values())
    return_range = (-float(ACTION_REPEAT * EPISODE_STEPS), 0.0)
    unstored_fields = ("sensors_accelerometer", "sensors_touch", "target_activated")
    """Fields of a state that depend on the step before it, so that a physics state alone does not give them."""

    def __init__(self, layout: Layout, id: str):
        self.layout, self.id = layout, id

    @property
    def model(self):
        return arena.build_arena(self.layout).model

    @property
    def picture_model(self):
        return arena.textured_model(self.layout)

    @property
    def action_size(self):
        return arena.ACTIONS  # plans ask for it, and need no model

    @functools.cached_property
    def goal_geoms(self) -> tuple[int, ...]:  # type: ignore[override]
        return (arena.build_arena(self.layout).goal_geom,)

    def styles(self, split):
        return tuple(map(arena.look_numbers, arena.STYLES[split]))

    def style_geom_matid(self, look):
        return arena.build_arena(self.layout).looks.get(look)

    def batch(self, size: int, threads: int = 1) -> AntMazeBatch:
        return AntMazeBatch(self, size, threads)
