"""Tasks of your own: "<module>:<function>" names a function that returns a dm_control `Environment`.

"<module>:<Class>" names a subclass of `Task` that steps a whole batch by itself, as DMC-VB's own tasks do.

Its code runs only if a person named it, see `own_code`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.own_code import TASKS, find_function
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.cameras import camera_ids
from dmcvb_gen.tasks.environment import EnvironmentTask, starting
from dmcvb_gen.tasks.suite import import_quietly


def own_task(task_id: str) -> Task:
    """The task of a function "<module>:<function>", or of a class.

    Raises:
      DmcvbError: its code may not run, cannot be found, fails, or gives no usable environment.
    """
    import_quietly("suite")  # before the task imports it, to hide its warnings
    make = find_function(task_id, TASKS, "task")
    if isinstance(make, type) and issubclass(make, Task):
        return _of_class(task_id, make)
    return EnvironmentTask(task_id, make)


def _of_class(task_id: str, kind: type[Task]) -> Task:
    """A task of a class, after two steps of it."""
    with starting(task_id):
        task = kind()
        task.id = task_id
        if "return_range" not in vars(kind):
            task.return_range = (-math.inf, math.inf)  # not its parent's
        for name in Task.__annotations__.keys() - vars(Task).keys():
            getattr(task, name)
        cameras = camera_ids(task)
        if len(cameras) != len(task.views) or not all(0 <= camera < task.model.ncam for camera in cameras):
            raise DmcvbError(
                f"{task_id} has views {task.views} and cameras {task.cameras}, and its model has {task.model.ncam}; "
                "name a camera of the model for each view"
            )
        if not isinstance(task.max_steps, int):
            raise DmcvbError(f"{task_id} has max_steps {task.max_steps!r}; give an int")
        batch = task.batch(2)
        batch.reset([np.random.default_rng(place) for place in range(2)])
        for _ in range(2):
            result = batch.step(task.from_unit(np.zeros((2, task.action_size), np.float32)))
        shapes = {name: np.shape(value) for name, value in vars(result).items()}
        for name, shape in [*shapes.items(), ("state", batch.state().shape)]:
            wanted = (2, task.state_size) if name == "state" else (2,)
            if shape != wanted:
                raise DmcvbError(f"{task_id} gives {name} of shape {shape} for two simulations; let it be {wanted}")
    return task


def mjcf_environment(
    path: str | Path,
    reward: Callable[[Any], float],
    observe: Callable[[Any], dict] | None = None,
    *,
    initialize: Callable[[Any, Any], None] | None = None,
    time_limit: float = 20.0,
    control_timestep: float | None = None,
):
    """A dm_control `Environment` of an MJCF file and a reward function.

    Args:
      path: the MJCF file.
      reward: physics -> reward of a control step.
      observe: physics -> dictionary of arrays; positions and velocities by default.
      initialize: (physics, numpy RandomState) sets the initial state; small random velocities by default.
      time_limit: seconds an episode.
      control_timestep: seconds a control step; one physics step by default.
    """
    from dm_control import mujoco
    from dm_control.rl import control
    from dm_control.suite import base

    class MjcfTask(base.Task):
        def initialize_episode(self, physics):
            if initialize is None:
                physics.data.qvel[:] = 0.01 * self.random.randn(physics.model.nv)
            else:
                initialize(physics, self.random)
            super().initialize_episode(physics)

        def get_observation(self, physics):
            if observe is not None:
                return observe(physics)
            return {"position": physics.data.qpos.copy(), "velocity": physics.data.qvel.copy()}

        def get_reward(self, physics):
            return reward(physics)

    physics = mujoco.Physics.from_xml_path(str(path))
    return control.Environment(physics, MjcfTask(), time_limit=time_limit, control_timestep=control_timestep)
