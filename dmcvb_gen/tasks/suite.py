"""The tasks of dm_control's suite by their ids "<domain>-<task>", each stepped by dm_control (see `environment`)."""

from __future__ import annotations

import copy
import functools
import importlib
import importlib.util
import logging
import re
import warnings
from pathlib import Path
from typing import Any

from dmcvb_gen.tasks.environment import EnvironmentTask


def suite_folder() -> Path:
    """The folder of dm_control's suite; to import it would load every domain and a GL library, which takes a second."""
    found = importlib.util.find_spec("dm_control")
    assert found and found.submodule_search_locations  # a dependency of ours, and a package
    return Path(found.submodule_search_locations[0]) / "suite"


@functools.cache
def suite_ids() -> tuple[str, ...]:
    """Usable task ids "<domain>-<task>" of dm_control's suite, read from its source."""
    names = []
    for path in sorted(suite_folder().glob("*.py")):
        added = re.findall(r"^@SUITE\.add\([^)]*\)\ndef (\w+)\(", path.read_text(), re.MULTILINE)
        names += [f"{path.stem}-{task}" for task in added]
    return tuple(names)


def import_quietly(module: str) -> Any:
    """A module of dm_control; the first import warns of a display that is not used, and sets up logging."""
    handlers = list(logging.root.handlers)
    with warnings.catch_warnings(action="ignore"):
        found = importlib.import_module(f"dm_control.{module}")
    logging.root.handlers[:] = handlers
    return found


def suite_task(task_id: str) -> EnvironmentTask:
    """The task of dm_control's suite with this id, one of `suite_ids`."""
    domain, _, name = task_id.partition("-")

    @functools.cache
    def first() -> Any:
        return import_quietly("suite").load(domain, name, task_kwargs={"random": 0})

    def make() -> Any:
        environment = copy.deepcopy(first())  # which costs a fifth of making it
        # Quadruped-escape puts its terrain on a graphics card if there is one; our renderers do so by themselves.
        environment.physics._make_rendering_contexts = lambda: None
        # The observation between the two control steps of an agent step is not asked for: it takes half of the time.
        task = environment.task
        task.observe, task.get_observation = task.get_observation, lambda physics: None
        return environment

    return EnvironmentTask(task_id, make, domain)
