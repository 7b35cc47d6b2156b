"""From what a person sets to an algorithm's checked settings, and each task's default budget."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from types import ModuleType
from typing import Annotated, Any

import pydantic
from pydantic import Field

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.files import read_yaml
from dmcvb_gen.own_code import is_own
from dmcvb_gen.policies.header import MAX_LAYERS, Width
from dmcvb_gen.spec import ANT_MAZE, is_maze

Count = Annotated[int, Field(gt=0)]
Natural = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]
Hidden = Annotated[tuple[Width, ...], Field(max_length=MAX_LAYERS)]
"""Widths of hidden layers, as many and as large as a policy file may have."""

ALGORITHMS = ("sac", "mpo", "guided")
"""The package's own algorithms: each is a module with `Settings`, `network`, `check` and `train`."""
SB3 = "sb3:"
"""What the name of an algorithm of Stable-Baselines3 or sb3-contrib begins with: "sb3:TD3"."""
SHORTEST_WARMUP, LONGEST_WARMUP, WARMUP_EPISODES = 1_000, 5_000, 10
"""An own task is learned after so many random episodes, within these bounds in agent steps."""


def algorithm_module(algorithm: str) -> ModuleType:
    """The module that trains with an algorithm.

    Raises:
      UnknownNameError: there is no such algorithm; lists the known ones.
    """
    if algorithm.startswith(SB3):
        return importlib.import_module("dmcvb_gen.training.sb3")
    if algorithm not in ALGORITHMS:
        raise UnknownNameError("algorithm", algorithm, [*ALGORITHMS, f"{SB3}SAC", f"{SB3}TD3", f"{SB3}PPO"])
    return importlib.import_module(f"dmcvb_gen.training.{algorithm}")


def settings_class(algorithm: str) -> type:
    """The settings data class of an algorithm; raises as `algorithm_module`."""
    module = algorithm_module(algorithm)
    return module.settings_class(algorithm) if algorithm.startswith(SB3) else module.Settings


def describe_settings(algorithm: str) -> dict[str, str]:
    """Name -> meaning of every setting of an algorithm, from the docstrings of its class and of those above it."""
    kind, meanings = settings_class(algorithm), {}
    for owner in reversed(kind.__mro__):
        listed = inspect.cleandoc(vars(owner).get("__doc__") or "").partition("\nAttributes:\n")[2]
        for names, text in re.findall(r"^  ([\w, ]+): (.+(?:\n   .+)*)", listed, re.MULTILINE):
            meaning = " ".join(text.split())
            meanings |= dict.fromkeys(names.split(", "), meaning[0].upper() + meaning[1:])
    return {field.name: meanings[field.name] for field in dataclasses.fields(kind)}


def check_settings(algorithm: str, values: Mapping[str, Any]) -> Any:
    """Settings of an algorithm from names and values; what is not given has its default.

    Raises:
      DmcvbError: an unknown setting (lists the known ones), or a value out of range or of another type.
    """
    kind = settings_class(algorithm)
    known = [field.name for field in dataclasses.fields(kind)]
    for name in values:
        if name not in known:
            raise UnknownNameError(f"setting of {algorithm}", name, known, "--list-settings lists them all")
    try:
        return pydantic.TypeAdapter(kind).validate_python(dict(values))
    except pydantic.ValidationError as error:
        problem = error.errors()[0]
        name, default = problem["loc"][0], getattr(kind(), str(problem["loc"][0]))
        raise DmcvbError(
            f"setting {name} of {algorithm} is {values[name]!r}: {problem['msg'][0].lower()}{problem['msg'][1:]}; "
            f"the default is {default!r}"
        ) from None


def parse_settings(pairs: Sequence[str], algorithm: str) -> dict[str, Any]:
    """Settings from --set key=value pairs, as plain JSON values.

    Raises:
      DmcvbError: not key=value, an unknown setting (lists the known ones) or a wrong value.
    """
    settings: dict[str, Any] = {}
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


def default_run(task_id: str, algorithm: str = "sac") -> dict[str, Any]:
    """{"steps", "evaluate_every", "settings"} of a task's run; settings are those that are not the algorithm's own.

    The precision of `sac` is the one that this processor computes fast in.
    """
    family = ANT_MAZE if is_maze(task_id) else task_id
    defaults = read_yaml(resources.files("dmcvb_gen.training") / "defaults.yaml")
    values: dict[str, Any] = {"settings": {}}
    for name in ("all", family, f"{family}/{algorithm}"):
        values |= defaults.get(name, {})
    if algorithm != "sac":
        return values
    from dmcvb_gen.precision import choose_precision
    from dmcvb_gen.tasks import get_task

    if is_own(task_id):
        steps = WARMUP_EPISODES * get_task(task_id).max_steps
        values["settings"] = {"warmup_steps": min(max(steps, SHORTEST_WARMUP), LONGEST_WARMUP)}
    values["settings"] = {"bfloat16": choose_precision("auto") == "bfloat16"} | values["settings"]
    return values
