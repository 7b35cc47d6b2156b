"""Convert policies of other programs: a Stable-Baselines3 zip or a torch state dict.

Nothing is unpickled: parameters are read by torch's weights-only loader, and of a zip's `data` its plain JSON.

::

    from                              body                            mean         noise
    SB3 SAC, TQC                      actor.latent_pi.0, .2, ...      actor.mu     actor.log_std
    SB3 TD3, DDPG                     actor.mu.0, .2, ...             the last     none
    SB3 PPO, A2C                      mlp_extractor.policy_net.0, ... action_net   log_std
    CleanRL PPO (continuous)          actor_mean.0, .2, ...           the last     actor_logstd
    CleanRL SAC                       fc1, fc2, ...                   fc_mean      none: its bounds are CleanRL's own
    CleanRL TD3, DDPG                 fc1, fc2, ...                   fc_mu        none
    torch.nn.Sequential               0, 2, ...                       the last     none

Sizes come from the weights and must fit the task. Converted policies act by our fixed-order arithmetic, so their data
regenerate bit for bit; their actions agree with the other program's to rounding.
"""

from __future__ import annotations

import functools
import hashlib
import io
import re
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from dmcvb_gen.errors import PolicyFileError
from dmcvb_gen.files import parse_json, sha256_file
from dmcvb_gen.policies.header import PolicyHeader, weight_shapes
from dmcvb_gen.policies.policy_file import load_policy, save_policy
from dmcvb_gen.storage.remote import storage_errors
from dmcvb_gen.tasks import get_task

UNCLIPPED = 1e30
"""Stands for "not clipped" in a policy file's header."""
MAX_BYTES = 2**30
"""Largest parameters that are read out of a zip."""
PARAMETERS, DATA = "policy.pth", "data"
"""Members of an SB3 zip that are read."""


@dataclass(frozen=True)
class Layout:
    """Parameter names under which a program keeps the parts of an actor.

    Attributes:
      algorithm: algorithm that the header names.
      body: beginning of the names of the hidden layers, before their numbers.
      mean: the layer that gives the mean; None: the last numbered one.
      log_std: the layer of log standard deviations, or a vector of them.
      activation: None: must be given.
      distribution: None: must be given.
    """

    algorithm: str
    body: str
    mean: str | None
    log_std: str | None = None
    activation: str | None = "relu"
    distribution: str | None = "deterministic"


LAYOUTS = (
    Layout("sb3", "actor.latent_pi.", "actor.mu", "actor.log_std", distribution="squashed_gaussian"),
    Layout("sb3", "actor.mu.", None),
    Layout("sb3", "mlp_extractor.policy_net.", "action_net", "log_std", "tanh", "gaussian"),
    Layout("cleanrl", "actor_mean.", None, "actor_logstd", "tanh", "gaussian"),
    Layout("cleanrl", "fc", "fc_mean"),
    Layout("cleanrl", "fc", "fc_mu"),
    Layout("torch", "", None, None, None, None),
)

PROGRAMS = {"sb3": "Stable-Baselines3", "cleanrl": "CleanRL"}
"""Algorithm of a layout -> the name of its program, for messages."""


def converted(path: Path, task_id: str, level: str) -> Path:
    """A policy file with another program's policy as it is now, in a folder that goes when the process ends."""
    return _converted(path, task_id, level, sha256_file(path))


@functools.lru_cache(maxsize=8)
def _converted(path: Path, task_id: str, level: str, digest: str) -> Path:
    header, weights = convert(path, task_id, level)
    place = hashlib.sha256(f"{path} {task_id} {digest}".encode()).hexdigest()[:16]
    target = Path(_folder().name) / place / f"{level}.safetensors"
    with storage_errors(target, "write to"):
        save_policy(target, header, weights)
    return target


@functools.cache
def _folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="dmcvb-gen-policies-")


def convert(
    path: str | Path,
    task_id: str,
    level: str | None = None,
    *,
    hidden: Sequence[int] | None = None,
    activation: str | None = None,
    distribution: str | None = None,
    statistics: str | Path | None = None,
) -> tuple[PolicyHeader, dict[str, np.ndarray]]:
    """Header and weights of another program's policy.

    Args:
      hidden: widths that its hidden layers must have.
      activation: activation of the hidden layers, if it is not the program's own: "relu", "tanh", "elu" or "gelu".
      distribution: of a plain network, "deterministic" (tanh of the output) or "gaussian" (clipped output).
      statistics: .npz file with "mean" and "std" of the observations that it was trained on, if it normalized them.

    Raises:
      PolicyFileError: it is not readable without running code, has other sizes, parts that we do not have, or values
        that are not finite; or an option has no effect.
    """
    path, task = Path(path), get_task(task_id)
    state, facts = _read(path)
    layout, layers = _layout(path, state)
    if distribution is not None and layout.distribution is not None:
        raise PolicyFileError(
            f"--actions has no effect: {path} has an actor of {PROGRAMS[layout.algorithm]}, whose actions are known; "
            "remove it"
        )
    noted, steps = _noted(path, facts)
    activation = activation or noted or layout.activation
    distribution = distribution if layout.distribution is None else layout.distribution
    if activation is None or distribution is None:
        raise PolicyFileError(f"{path} does not say its activation and its actions; give --activation and --actions")
    body, mean = (layers, layout.mean) if layout.mean else (layers[:-1], layers[-1])
    weights = _weights(path, state, body, str(mean), layout.log_std, distribution)
    sizes = (weights["body.0.weight" if body else "mean.weight"].shape[1], weights["mean.weight"].shape[0])
    widths = tuple(int(weights[f"body.{2 * index}.weight"].shape[0]) for index in range(len(body)))
    if sizes != (task.behaviour_size, task.action_size) or (hidden is not None and tuple(hidden) != widths):
        asked = task.behaviour_size, *(hidden if hidden is not None else widths), task.action_size
        found = sizes[0], *widths, sizes[1]
        raise PolicyFileError(
            f"{path} has layers of {' x '.join(map(str, found))}, {task_id} and the sizes given ask for "
            f"{' x '.join(map(str, asked))} (observation, hidden, action); train it on this task"
        )
    weights |= _normalization(statistics, task.behaviour_size)
    header = _header(
        path,
        task=task_id,
        observation=task.observation,
        observation_size=sizes[0],
        action_size=sizes[1],
        algorithm=layout.algorithm,
        agent_step=steps,
        level=level,
        hidden=widths,
        activation=activation,
        distribution=distribution,
        clip_observation=UNCLIPPED if statistics is None else 10.0,
        training={"converted_from": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()},
    )
    _check_weights(path, header, weights)
    return header, weights


def convert_file(path: str | Path, task_id: str, out: str | Path, **options: Any) -> PolicyHeader:
    """Write another program's policy as a policy file, and load it once; see `convert`.

    Raises:
      PolicyFileError: it cannot be converted. An existing file at `out` is not changed.
      StoreError: the file cannot be written.
    """
    header, weights = convert(path, task_id, **options)
    with storage_errors(out, "write to"):
        save_policy(out, header, weights)
    return load_policy(out).header


# -- reading --------------------------------------------------------------------------------------


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Parameters by name, and the plain facts of an SB3 zip's `data` (none of a state dict)."""
    import torch

    try:
        if path.suffix == ".zip":
            data, facts = _sb3_members(path)
        else:
            data, facts = path.read_bytes(), {}
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except OSError as error:
        raise PolicyFileError(f"cannot read {path}: {error.strerror or error}; give the path of a policy") from None
    except Exception as error:  # torch's own kinds, pickle's and zip's
        reason = (str(error).splitlines() or [type(error).__name__])[0].split(". ")[0][:120]
        raise PolicyFileError(
            f"{path} holds no weights that can be read without running code ({reason}); save its state dict with "
            "torch.save(actor.state_dict(), ...)"
        ) from None
    if isinstance(state, tuple | list) and state:
        state = state[0]  # CleanRL saves (actor, critics)
    if not isinstance(state, Mapping) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise PolicyFileError(
            f"{path} holds no state dict of tensors; save one with torch.save(actor.state_dict(), ...)"
        )
    return {str(name): value.detach().to(torch.float32).numpy() for name, value in state.items()}, facts


def _sb3_members(path: Path) -> tuple[bytes, dict[str, Any]]:
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: info for info in archive.infolist()}
        if PARAMETERS not in members or DATA not in members:
            raise ValueError(f"no {PARAMETERS} and {DATA} inside, so it is no zip of Stable-Baselines3")
        if max(members[PARAMETERS].file_size, members[DATA].file_size) > MAX_BYTES:
            raise ValueError("its parameters are larger than 1 GiB")
        facts = parse_json(archive.read(DATA))
        return archive.read(PARAMETERS), facts if isinstance(facts, dict) else {}


def _noted(path: Path, facts: Mapping[str, Any]) -> tuple[str | None, int]:
    """Activation (None: the default) and steps that an SB3 zip's `data` notes in plain text."""
    if facts.get("use_sde"):
        raise PolicyFileError(f"{path} was trained with use_sde=True, which we do not have; train it without")
    kwargs = facts.get("policy_kwargs")
    function = kwargs.get("activation_fn") if isinstance(kwargs, dict) else None
    steps = facts.get("num_timesteps")
    steps = steps if isinstance(steps, int) and steps >= 0 else 0
    if function is None:
        return None, steps
    name = re.sub(r"\W+$", "", str(function)).rsplit(".", 1)[-1].lower()
    if name not in ("relu", "tanh", "elu", "gelu"):
        raise PolicyFileError(f"{path} has activation {name!r}; only relu, tanh, elu and gelu can be converted")
    return name, steps


# -- the parts of an actor ------------------------------------------------------------------------


def _layout(path: Path, state: Mapping[str, np.ndarray]) -> tuple[Layout, list[str]]:
    """The layout whose names a state dict has, and its numbered layers in order."""
    for layout in LAYOUTS:
        pattern = re.compile(rf"{re.escape(layout.body)}(\d+)\.weight")
        numbers = sorted(int(found[1]) for found in map(pattern.fullmatch, state) if found)
        if numbers and (layout.mean is None or f"{layout.mean}.weight" in state):
            strange = [name for name in state if name.startswith(("features_extractor.", "pi_features_extractor."))]
            layers = [f"{layout.body}{number}" for number in numbers]
            dense = [*layers, layout.mean] if layout.mean else layers
            strange += [name for name in dense if state[f"{name}.weight"].ndim != 2]
            if strange:
                raise PolicyFileError(
                    f"{path} has {strange[0]!r}, which is no dense layer; only plain MLPs can be converted"
                )
            return layout, layers
    raise PolicyFileError(
        f"{path} has none of the actors that are known (it has {', '.join(list(state)[:3]) or 'nothing'}, ...); save "
        "the actor as a torch.nn.Sequential's state dict"
    )


def _weights(
    path: Path, state: Mapping[str, np.ndarray], body: Sequence[str], mean: str, log_std: str | None, distribution: str
) -> dict[str, np.ndarray]:
    """The actor's weights by our names, without normalization of observations."""
    names = {f"body.{2 * index}": layer for index, layer in enumerate(body)} | {"mean": mean}
    if distribution == "squashed_gaussian":
        names["log_std"] = str(log_std)
    try:
        weights = {
            f"{ours}.{part}": state[f"{name}.{part}"] for ours, name in names.items() for part in ("weight", "bias")
        }
        if distribution == "gaussian":
            size = len(weights["mean.bias"])
            weights["log_std_vector"] = state[log_std].reshape(size) if log_std else np.full(size, -80.0, np.float32)
    except (KeyError, ValueError, TypeError) as error:
        raise PolicyFileError(f"{path} lacks a part of its actor ({error}); save its whole state dict") from None
    scale, bias = state.get("action_scale"), state.get("action_bias")
    if (scale is not None and (scale != 1).any()) or (bias is not None and (bias != 0).any()):
        raise PolicyFileError(f"{path} scales its actions; train it on actions in [-1, 1], as the task's are")
    return weights


def _header(path: Path, **fields: Any) -> PolicyHeader:
    try:
        return PolicyHeader(**fields)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise PolicyFileError(
            f"{path} makes no policy file ({field}: {first['msg']}); give other values, or a smaller MLP"
        ) from None


def _check_weights(path: Path, header: PolicyHeader, weights: Mapping[str, np.ndarray]) -> None:
    """Refuse what `load_policy` would refuse, before anything is written."""
    for name, shape in weight_shapes(header).items():
        if weights[name].shape != shape:
            raise PolicyFileError(
                f"{path}: {name} has shape {weights[name].shape}, the layers beside it ask for {shape}; save its whole "
                "state dict again"
            )
        if not np.isfinite(weights[name]).all():
            raise PolicyFileError(
                f"{path}: {name} holds values that are not finite; its training diverged, take an earlier checkpoint"
            )


def _normalization(statistics: str | Path | None, size: int) -> dict[str, np.ndarray]:
    mean, std = np.zeros(size, np.float32), np.ones(size, np.float32)
    if statistics is not None:
        mean, std = _statistics(statistics, size)
        wrong = np.flatnonzero(~(np.isfinite(mean) & np.isfinite(std) & (std > 0)))
        if len(wrong):
            first = wrong[0]
            raise PolicyFileError(
                f"{statistics} has mean {mean[first]:g} and std {std[first]:g} of observation {first}; write finite "
                "numbers and a std above 0 (1 for an observation that never changes)"
            )
    return {"observation_mean": mean, "observation_std": std}


def _statistics(path: str | Path, size: int) -> list[np.ndarray]:
    """The mean and std that a file holds, as float32."""
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("it is a single array")
        with file, np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused as such
            return [np.asarray(file[name], np.float32).reshape(size) for name in ("mean", "std")]
    except Exception as error:  # numpy's, zip's and zlib's own kinds
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise PolicyFileError(
            f'{path} has no "mean" and "std" of {size} observations ({reason}); write it with '
            "numpy.savez(file, mean=..., std=...)"
        ) from None
