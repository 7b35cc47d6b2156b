"""Read a Stable-Baselines3 zip without unpickling: its weights' bytes, and the plain JSON beside them.

The JSON decides what the weights mean: the actions' bounds, the order of observations, what lies before the first
layer. What a plain MLP does not have is refused, and named.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.errors import PolicyFileError
from dmcvb_gen.files import parse_json

MAX_BYTES = 2**30
"""Largest parameters that are read out of a zip."""
PARAMETERS, DATA = "policy.pth", "data"
"""Members of a zip that are read."""
PLAIN_EXTRACTORS = ("FlattenExtractor", "CombinedExtractor")
"""Feature extractors that pass numbers on as they are."""
FIELD = re.compile(r"'([^']+)'[:,] Box\([^()]*\((\d*),?\)[^()]*\)")
"""A named part of a Dict space, as its text has it: its name and its size."""


@dataclass(frozen=True)
class Facts:
    """What a zip's JSON says about its actor.

    Attributes:
      low, high: (action,) bounds of its actions.
      fields: name -> size of the parts of a Dict observation, in their order; None for a plain vector.
      activation: of hidden layers; None: the algorithm's default.
      steps: that it was trained for.
      normalized: VecNormalize stood before it; the zips of off-policy algorithms do not say so.
      renorm_eps: added to the variances of a BatchRenorm.
    """

    low: np.ndarray
    high: np.ndarray
    fields: dict[str, int] | None
    activation: str | None
    steps: int
    normalized: bool
    renorm_eps: float


def is_sb3(path: Path) -> bool:
    """Return True for a zip of SB3, whatever its name: save("ppo_0.1M") adds no ending."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return PARAMETERS in archive.namelist()


def read_members(path: Path) -> tuple[bytes, dict[str, Any]]:
    """The parameters' bytes and the JSON of a zip.

    Raises:
      ValueError: it is no zip of SB3, or too large.
    """
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: info for info in archive.infolist()}
        if PARAMETERS not in members or DATA not in members:
            raise ValueError(f"no {PARAMETERS} and {DATA} inside, so it is no zip of Stable-Baselines3")
        if max(members[PARAMETERS].file_size, members[DATA].file_size) > MAX_BYTES:
            raise ValueError("its parameters are larger than 1 GiB")
        data = parse_json(archive.read(DATA))
        return archive.read(PARAMETERS), data if isinstance(data, dict) else {}


def facts_of(path: Path, data: Mapping[str, Any]) -> Facts:
    """What the JSON says.

    Raises:
      PolicyFileError: a part of the policy is none of a plain MLP's, or the bounds of its actions are not there.
    """
    kwargs = data.get("policy_kwargs") or {}
    module = str((data.get("policy_class") or {}).get("__module__"))
    extractor = _class_name(kwargs.get("features_extractor_class") or PLAIN_EXTRACTORS[0])
    if not module.startswith(("stable_baselines3.", "sb3_contrib.")):
        raise _refusal(path, f"a policy class of its own ({module})")
    if "recurrent" in module:
        raise _refusal(path, "a recurrent part (LSTM)")
    if extractor not in PLAIN_EXTRACTORS:
        raise _refusal(path, f"a features extractor ({extractor})")
    if data.get("use_sde"):
        raise _refusal(path, "noise that depends on the state (use_sde)")
    activation = kwargs.get("activation_fn") and _class_name(kwargs["activation_fn"]).lower()
    if activation not in (None, "relu", "tanh", "elu", "gelu"):
        raise PolicyFileError(f"{path} has activation {activation!r}; only relu, tanh, elu and gelu can be converted")
    space, steps = data.get("action_space") or {}, data.get("num_timesteps")
    try:
        low, high = _numbers(space["low"]), _numbers(space["high"])
    except (KeyError, ValueError):
        raise _refusal(path, f"an action space without bounds ({_class_name(space.get(':type:'))})") from None
    return Facts(
        low=low,
        high=high,
        fields=_fields(path, data.get("observation_space") or {}),
        activation=activation,
        steps=steps if isinstance(steps, int) and steps >= 0 else 0,
        normalized="replay_buffer_class" not in data and data.get("_last_original_obs") is not None,
        renorm_eps=float(kwargs.get("batch_norm_eps", 0.001)),
    )


def _refusal(path: Path, part: str) -> PolicyFileError:
    return PolicyFileError(f"{path} has {part}; only plain MLP actors can be converted, so train it without")


def _class_name(text: Any) -> str:
    """The last name of a class as JSON notes it, "<class 'a.b.C'>"."""
    return re.sub(r"\W+$", "", str(text)).rsplit(".", 1)[-1]


def _numbers(text: Any) -> np.ndarray:
    """The numbers of an array's text, which numpy shortens if there are more than a thousand."""
    return np.array(str(text).replace("[", " ").replace("]", " ").split(), np.float64)


def _fields(path: Path, space: Mapping[str, Any]) -> dict[str, int] | None:
    kind = _class_name(space.get(":type:"))
    if kind == "Box":
        return None
    text = str(space.get("spaces"))
    fields = {name: int(size or 1) for name, size in FIELD.findall(text)}
    if kind != "Dict" or not fields or len(fields) != len(re.findall(r"'[^']+'[:,] ", text)):
        raise _refusal(path, f"observations that are no vectors ({kind})")
    return fields
