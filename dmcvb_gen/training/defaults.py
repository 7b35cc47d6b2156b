"""Default settings and budgets of each task's training."""

from __future__ import annotations

import dataclasses
import functools
import json
from importlib import resources
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import read_yaml
from dmcvb_gen.spec import ANT_MAZE, is_maze
from dmcvb_gen.training.runs import RunConfig
from dmcvb_gen.training.settings import check_settings


@functools.cache
def _all() -> dict[str, Any]:
    return read_yaml(resources.files("dmcvb_gen.policies") / "data" / "defaults.yaml")


def default_run(task_id: str, algorithm: str = "sac") -> dict[str, Any]:
    """{"steps", "evaluate_every", "evaluate_sparse", "settings"} of a task's run.

    `settings` of the file are sac's; another algorithm's are under `algorithms: {<name>: {...}}` of "all" and of
    the task, on top of that algorithm's own defaults; its budget, if it differs, under the task's `runs`.
    """
    family = ANT_MAZE if is_maze(task_id) else task_id
    general, own = _all()["all"], _all().get(family, {})
    values = {name: value for name, value in (general | own).items() if name not in ("algorithms", "runs")}
    values |= (own.get("runs") or {}).get(algorithm) or {}
    if algorithm == "sac":
        return values | {"settings": dict(values.get("settings") or {})}
    parts = ((part.get("algorithms") or {}).get(algorithm) or {} for part in (general, own))
    return values | {"settings": {name: value for part in parts for name, value in part.items()}}


def parse_settings(pairs: tuple[str, ...], config: str | Path | None, algorithm: str) -> dict[str, Any]:
    """Settings from a YAML file and --set key=value pairs (which win), as plain JSON values.

    Raises:
      DmcvbError: not key=value, an unreadable file, an unknown setting (lists the known ones) or a wrong value.
    """
    settings: dict[str, Any] = {}
    if config:
        try:
            read = read_yaml(Path(config))
        except (OSError, ValueError) as error:
            raise DmcvbError(f"cannot read settings from {config}: {error}") from None
        if not isinstance(read or {}, dict):
            raise DmcvbError(f"{config} holds no settings; write lines like `learning_rate: 0.0003`")
        settings |= {str(name): value for name, value in (read or {}).items()}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise DmcvbError(f"--set {pair!r} is not key=value; e.g. --set learning_rate=0.0003")
        try:
            settings[name] = json.loads(value)
        except ValueError:
            settings[name] = value
    checked = dataclasses.asdict(check_settings(algorithm, settings))
    return {name: json.loads(json.dumps(checked[name])) for name in settings}


def run_config(
    task_id: str, algorithm: str, settings: dict[str, Any], found: RunConfig | None = None, **given: Any
) -> RunConfig:
    """Return the config of a run: the given values, else those of the run to resume, else the task's defaults.

    Args:
      settings: given settings, checked.
      found: the configuration of the run to go on with. If `given` differs from it the result does too, and
        `open_run` refuses it.
      given: steps, seed, evaluate_every, init_from; None if not given.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if found and found.algorithm == algorithm:
        return dataclasses.replace(found, task=task_id, settings=found.settings | settings, **given)
    defaults = default_run(task_id, algorithm)
    fields = {name: defaults[name] for name in ("steps", "evaluate_every", "evaluate_sparse")} | {"seed": 0} | given
    fields["evaluate_sparse"] = max(given.get("evaluate_every", 0), fields["evaluate_sparse"])
    return RunConfig(task=task_id, algorithm=algorithm, settings=defaults["settings"] | settings, **fields)
