"""Tasks of your own: "<module>:<function>" names a function that returns a dm_control `Environment`.

The function's code runs, so a task id that was read from a file is refused: only ids that a person gave to `allow` (the
command line does, for the tasks that are typed there) or in the environment variable `DMCVB_GEN_TASKS` are run.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks.suite import SuiteTask, import_suite

ALLOWED = "DMCVB_GEN_TASKS"
"""Environment variable with the task ids whose code may run, joined by commas; worker processes inherit it."""

_OWN_ID = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_own(task_id: str) -> bool:
    """Whether a task id has the form "<module>:<function>"."""
    return _OWN_ID.fullmatch(task_id) is not None


def allow(task_ids: Iterable[str]) -> None:
    """Let the code of these tasks run in this process and its children."""
    own = [task_id for task_id in task_ids if is_own(task_id)]
    if own:
        before = [task_id for task_id in os.environ.get(ALLOWED, "").split(",") if task_id]
        os.environ[ALLOWED] = ",".join(dict.fromkeys([*before, *own]))


def own_task(task_id: str) -> SuiteTask:
    """The task of a function "<module>:<function>".

    Raises:
      DmcvbError: its code may not run, cannot be found, fails, or gives no usable environment.
    """
    if task_id not in os.environ.get(ALLOWED, "").split(","):
        raise DmcvbError(f"{task_id} is code of your own; to let it run, set {ALLOWED}={task_id}")
    module, _, name = task_id.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    import_suite()
    try:
        make = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise DmcvbError(
            f"cannot find task {task_id} ({error}); give <module>:<function>, run from its folder"
        ) from None
    return SuiteTask(task_id, make)


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
