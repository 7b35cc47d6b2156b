"""Settings per task that are known to work: task in, the settings and budget of its run out."""

from __future__ import annotations

import dataclasses
import functools
import json
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from dmcvb_gen.behaviours.sac import SacSettings
from dmcvb_gen.errors import DmcvbError, UnknownNameError

ALGORITHMS = ("sac",)
"""What `train-behaviour --algo` takes."""


@functools.cache
def _all() -> dict[str, Any]:
    return yaml.safe_load((resources.files("dmcvb_gen.behaviours") / "data" / "defaults.yaml").read_text())


def default_run(task_id: str) -> dict[str, Any]:
    """{"steps", "evaluate_every", "evaluate_sparse", "settings"} of a task's SAC run."""
    family = "ant-maze" if task_id.startswith("ant-maze") else task_id
    values = _all()["all"] | _all().get(family, {})
    return values | {"settings": dict(values.get("settings") or {})}


def parse_settings(pairs: tuple[str, ...], config: str | Path | None, algorithm: str) -> dict[str, Any]:
    """Settings from --set key=value pairs and a YAML file, checked against the algorithm's known ones.

    Raises:
      DmcvbError: not key=value, an unreadable file, or an unknown setting (lists the known ones).
    """
    settings: dict[str, Any] = {}
    if config:
        try:
            settings |= yaml.safe_load(Path(config).read_text()) or {}
        except (OSError, yaml.YAMLError, TypeError) as error:
            raise DmcvbError(f"cannot read settings from {config}: {' '.join(str(error).split())}") from None
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise DmcvbError(f"--set {pair!r} is not key=value; e.g. --set learning_rate=0.0003")
        try:
            settings[name] = json.loads(value)
        except ValueError:
            settings[name] = value
    if algorithm == "sac":
        known = [field.name for field in dataclasses.fields(SacSettings)]
        for name in settings:
            if name not in known:
                raise UnknownNameError("setting of sac", name, known)
    return settings
