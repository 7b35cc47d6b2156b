"""The tasks of dm_control's suite by their ids "<domain>-<task>", each stepped by dm_control (see `environment`)."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import re
import warnings
from pathlib import Path
from typing import Any

from dmcvb_gen.tasks.environment import EnvironmentTask

REFUSED = {"quadruped-escape": "it draws a new terrain for every episode"}
"""Tasks of the suite that cannot be used, and why."""


@functools.cache
def suite_ids() -> tuple[str, ...]:
    """Usable task ids "<domain>-<task>" of dm_control's suite, read from its source: importing it takes a second."""
    found = importlib.util.find_spec("dm_control")
    assert found and found.submodule_search_locations  # a dependency of ours, and a package
    names = []
    for path in sorted((Path(found.submodule_search_locations[0]) / "suite").glob("*.py")):
        added = re.findall(r"^@SUITE\.add\([^)]*\)\ndef (\w+)\(", path.read_text(), re.MULTILINE)
        names += [f"{path.stem}-{task}" for task in added]
    return tuple(name for name in names if name not in REFUSED)


def import_suite() -> Any:
    """`dm_control.suite`; its first import warns of a display that nobody needs."""
    with warnings.catch_warnings(action="ignore"):
        return importlib.import_module("dm_control.suite")


def suite_task(task_id: str) -> EnvironmentTask:
    """The task of dm_control's suite with this id, one of `suite_ids`."""
    domain, _, name = task_id.partition("-")
    return EnvironmentTask(task_id, lambda: import_suite().load(domain, name, task_kwargs={"random": 0}), domain)
