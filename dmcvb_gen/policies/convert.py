"""Convert policies of other programs: a Stable-Baselines3 zip or a torch state dict.

No code in them runs: torch's weights-only loader reads parameters, and of a zip's `data` only its JSON is read.

::

    from                              body                            mean         noise
    SB3 SAC, TQC                      actor.latent_pi.0, .2, ...      actor.mu     actor.log_std
    SB3 CrossQ                        the same, .1, .4, ...           actor.mu     actor.log_std
    SB3 TD3, DDPG                     actor.mu.0, .2, ...             the last     none
    SB3 PPO, A2C, TRPO                mlp_extractor.policy_net.0, ... action_net   log_std
    CleanRL PPO (continuous)          actor_mean.0, .2, ...           the last     actor_logstd
    CleanRL SAC                       fc1, fc2, ...                   fc_mean      none: its bounds are CleanRL's own
    CleanRL TD3, DDPG                 fc1, fc2, ...                   fc_mu        none
    torch.nn.Sequential               0, 2, ...                       the last     none

Sizes come from the weights and must fit the task. CrossQ's BatchRenorm goes into the layers that follow it. Converted
policies act by our fixed-order arithmetic, so their data regenerate bit for bit; their actions agree with the other
program's to rounding.
"""

from __future__ import annotations

import functools
import hashlib
import io
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pydantic

from dmcvb_gen.errors import PolicyFileError, first_line
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.policies.policy_file import check_weights, load_policy, save_policy
from dmcvb_gen.policies.sb3_zip import Facts, facts_of, is_sb3, read_members
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.text import quoted

UNCLIPPED = 1e30
"""Stands for "not clipped" in a policy file's header."""
NO_NOISE = -80.0
"""Log standard deviation of a policy that keeps its mean action alone."""
WRAPPERS = re.compile(r"^(_orig_mod\.|module\.)+")
"""What torch.compile and DataParallel put before every name."""
RENORM = re.compile(r"(actor\.latent_pi\.)(\d+)\.ra_mean")
"""The name of a BatchRenorm's running mean, as CrossQ of sb3-contrib keeps it."""
RENORM_PARTS = ("ra_mean", "ra_var", "scale", "bias", "steps")
SCALES = ("action_scale", "action_bias")
"""Names of the half width and the middle of the actions' bounds, as CleanRL keeps them."""


class Layout(NamedTuple):
    """Parameter names under which a program keeps the parts of an actor.

    Attributes:
      algorithm: algorithm that the header names.
      body: beginning of the names of the hidden layers, before their numbers.
      mean: the layer that gives the mean; None: the last numbered one.
      log_std: the layer of log standard deviations, or a vector of them.
      activation: None: must be given.
      distribution: None: must be given.
      others: beginnings of the names of what is no part of the actor.
    """

    algorithm: str
    body: str
    mean: str | None
    log_std: str | None
    activation: str | None
    distribution: str | None
    others: tuple[str, ...] = ()


CRITICS = ("critic", "value_net.", "mlp_extractor.value_net.", "actor_target.", "qf", "fc_logstd.", *SCALES)
"""Beginnings of the names of what is no part of a known program's actor."""
LAYOUTS = (
    Layout("sb3", "actor.latent_pi.", "actor.mu", "actor.log_std", "relu", "squashed_gaussian", CRITICS),
    Layout("sb3", "actor.mu.", None, None, "relu", "deterministic", CRITICS),
    Layout("sb3", "mlp_extractor.policy_net.", "action_net", "log_std", "tanh", "gaussian", CRITICS),
    Layout("cleanrl", "actor_mean.", None, "actor_logstd", "tanh", "gaussian", CRITICS),
    Layout("cleanrl", "fc", "fc_mean", None, "relu", "deterministic", CRITICS),
    Layout("cleanrl", "fc", "fc_mu", None, "relu", "deterministic", CRITICS),
    Layout("torch", "", None, None, None, None),
)
NORMALIZED = {"actor_mean.": "CleanRL's NormalizeObservation"}
"""A layout's body -> what its program's script always puts before the actor."""


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
    activation: str | None = None,
    distribution: str | None = None,
    statistics: str | Path | None = None,
) -> tuple[PolicyHeader, dict[str, np.ndarray]]:
    """Header and weights of another program's policy.

    Args:
      activation: activation of the hidden layers, if it is not the program's own: "relu", "tanh", "elu" or "gelu".
      distribution: of a plain network, "deterministic" (tanh of the output) or "gaussian" (clipped output).
      statistics: .npz file with "mean" and "std" of the observations that it was trained on, in the order in which it
        takes them, if it normalized them; and "clip", if it did not clip them to 10 (SB3, CleanRL) or at all (others).

    Raises:
      PolicyFileError: it is not readable without running code, has other sizes, parts that we do not have, or values
        that are not finite; or an option has no effect.
    """
    path, task = Path(path), get_task(task_id)
    command = f"dmcvb-gen convert-policy {quoted(path)} {quoted(task_id)} --out NEW.safetensors"
    state, data = _read(path)
    facts = None if data is None else facts_of(path, data)
    state = _without_renorm(path, state, facts.renorm_eps if facts else 0.0)
    layout, body, mean = _layout(path, state)
    activation, distribution = _how_it_acts(path, layout, facts, activation, distribution, command)
    weights = _weights(path, task, state, body, mean, layout.log_std, distribution)
    first = weights["body.0.weight" if body else "mean.weight"]
    widths = tuple(int(weights[f"body.{2 * index}.weight"].shape[0]) for index in range(len(body)))
    _check_sizes(path, task, (first.shape[1], *widths, weights["mean.weight"].shape[0]))
    if distribution == "gaussian":
        _scaled(weights, task)
    if facts:
        _check_actions(path, task, facts.low, facts.high)
    wrapper = "VecNormalize" if facts and facts.normalized else NORMALIZED.get(layout.body)
    if wrapper and statistics is None:
        raise PolicyFileError(
            f"{path} was trained behind {wrapper}, whose numbers are not in it; run `{command} --statistics FILE` with "
            "its mean and std of observations (0 and 1 if it normalized none), and use the new file"
        )
    normalization, clip = _normalization(statistics, task.behaviour_size)
    weights |= normalization
    normalizes = bool(weights["observation_mean"].any() or (weights["observation_std"] != 1).any())
    if clip is None:
        clip = 10.0 if normalizes and layout.algorithm != "torch" else UNCLIPPED
    network: dict[str, Any] = {"hidden": widths, "activation": activation, "distribution": distribution}
    try:
        header = PolicyHeader(
            task=task_id,
            observation=task.observation,
            observation_size=task.behaviour_size,
            action_size=task.action_size,
            algorithm=layout.algorithm,
            agent_step=facts.steps if facts else 0,
            level=level,
            **network,
            clip_observation=clip,
            training={"converted_from": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()},
        )
    except pydantic.ValidationError as error:
        problem = error.errors()[0]
        raise PolicyFileError(f"{path}: {problem['loc'][0]}: {problem['msg']}; give a smaller MLP") from None
    check_weights(path, header, weights)
    if facts:
        places = np.argsort(_order(path, task, facts))
        for name in ("body.0.weight" if body else "mean.weight", "observation_mean", "observation_std"):
            weights[name] = weights[name][..., places]
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


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any] | None]:
    """Parameters by name, and the JSON of an SB3 zip (None of a state dict)."""
    import torch

    try:
        data, facts = read_members(path) if path.suffix == ".zip" or is_sb3(path) else (path.read_bytes(), None)
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except OSError as error:
        raise PolicyFileError(f"cannot read {path}: {error.strerror or error}; give the path of a policy") from None
    except Exception as error:  # torch's own kinds, pickle's and zip's
        reason = first_line(error).split(". ")[0][:120]
        raise PolicyFileError(
            f"{path} holds no weights that can be read without running code ({reason}); save its state dict with "
            "torch.save(actor.state_dict(), ...)"
        ) from None
    if isinstance(state, tuple | list) and state:
        state = state[0]  # CleanRL saves (actor, critics)
    if not isinstance(state, Mapping) or not all(map(_holds_numbers, state.values())):
        raise PolicyFileError(
            f"{path} holds no state dict of real numbers; save one with torch.save(actor.state_dict(), ...)"
        )
    arrays = {name: value.detach().to(torch.float32).numpy() for name, value in state.items()}
    return {WRAPPERS.sub("", str(name)): value for name, value in arrays.items()}, facts


def _holds_numbers(value: Any) -> bool:
    """Return True for a dense tensor of real numbers."""
    import torch

    dense = isinstance(value, torch.Tensor) and value.layout is torch.strided
    return dense and not value.is_meta and not value.is_complex()


# -- the parts of an actor ------------------------------------------------------------------------


def _layout(path: Path, state: Mapping[str, np.ndarray]) -> tuple[Layout, list[str], str]:
    """The layout whose names a state dict has, its hidden layers in order, and the layer that gives the mean."""
    for layout in LAYOUTS:
        pattern = re.compile(rf"{re.escape(layout.body)}(\d+)\.weight")
        numbers = sorted(int(found[1]) for found in map(pattern.fullmatch, state) if found)
        layers = [f"{layout.body}{number}" for number in numbers if state[f"{layout.body}{number}.weight"].ndim == 2]
        if f"{layout.mean}.weight" in state or layers and layout.mean is None:
            layers += [layout.mean] if layout.mean else []
            used = {f"{layer}.{part}" for layer in layers for part in ("weight", "bias")}
            used |= {f"{layout.log_std}{part}" for part in ("", ".weight", ".bias")}
            for name in state:
                if name not in used and not name.startswith(layout.others or "\0"):
                    raise PolicyFileError(
                        f"{path} has {name!r}, which is no part of a plain MLP; only plain MLP actors can be "
                        "converted, so train it without"
                    )
            return layout, layers[:-1], layers[-1]
    raise PolicyFileError(
        f"{path} has none of the actors that are known (it has {', '.join(list(state)[:3]) or 'nothing'}, ...); save "
        "the actor as a torch.nn.Sequential's state dict"
    )


def _how_it_acts(
    path: Path, layout: Layout, facts: Facts | None, activation: str | None, distribution: str | None, command: str
) -> tuple[str, str]:
    """Activation and distribution: what the file says of them, else what is given."""
    if layout.algorithm == "sb3" and facts is None:
        raise PolicyFileError(f"{path} does not say how the policy acts; give the .zip of Stable-Baselines3's save()")
    if distribution is not None and layout.distribution is not None:
        raise PolicyFileError(f"--actions has no effect: the actions of {path} are known; remove it")
    known = (facts and facts.activation) or layout.activation
    if facts and known and activation not in (None, known):
        raise PolicyFileError(f"--activation has no effect: that of {path} is known, {known}; remove it")
    activation, distribution = activation or known, layout.distribution or distribution
    if activation is None or distribution is None:
        raise PolicyFileError(
            f"{path} does not say its activation and its actions; run `{command} --activation tanh --actions tanh` "
            "with the ones that it has, and use the new file"
        )
    return activation, distribution


def _check_sizes(path: Path, task: Task, layers: Sequence[int]) -> None:
    """Refuse layers (observation, hidden, ..., action) that do not fit the task."""
    asked = (task.behaviour_size, *layers[1:-1], task.action_size)
    if layers != asked:
        own = task.observation != "state"
        cure = f"on {task.observation}, as train-behaviour --algo sb3:NAME does" if own else "on this task"
        raise PolicyFileError(
            f"{path} has layers of {' x '.join(map(str, layers))}, {task.id} asks for {' x '.join(map(str, asked))} "
            f"(observation, hidden, action); train it {cure}"
        )


def _without_renorm(path: Path, state: Mapping[str, np.ndarray], eps: float) -> dict[str, np.ndarray]:
    """The same actor without CrossQ's BatchRenorm: what follows one takes over its scale and shift."""
    plain = dict(state)
    try:
        for found in filter(None, map(RENORM.fullmatch, state)):
            mean, variance, scale, bias, _ = (plain.pop(f"{found[1]}{found[2]}.{part}") for part in RENORM_PARTS)
            scale = scale / np.sqrt(variance + np.float32(eps))
            following = f"{found[1]}{int(found[2]) + 1}"
            for layer in [following] if f"{following}.weight" in state else ["actor.mu", "actor.log_std"]:
                weight = plain[f"{layer}.weight"]
                plain[f"{layer}.bias"] = plain[f"{layer}.bias"] + weight @ (bias - mean * scale)
                plain[f"{layer}.weight"] = weight * scale
    except (KeyError, ValueError) as error:
        raise _incomplete(path, error) from None
    return plain


def _check_actions(path: Path, task: Task, low: np.ndarray, high: np.ndarray) -> None:
    """Refuse an actor with other action bounds than the task's: its file does not say how they were taken."""
    theirs = [np.round(bound.astype(float), 6).tolist() for bound in (low, high)]
    ours = [np.round(bound.astype(float), 6).tolist() for bound in (task.action_low, task.action_high)]
    if theirs != ours:
        raise PolicyFileError(
            f"{path} acts from {theirs[0]} to {theirs[1]}, {task.id} takes actions from {ours[0]} to {ours[1]}; train "
            "it with the task's own bounds"
        )


def _scaled(weights: dict[str, np.ndarray], task: Task) -> None:
    """Bring a mean in the task's bounds to [-1, 1], where policy files act."""
    low, high = (np.asarray(bound, np.float64) for bound in (task.action_low, task.action_high))
    middle, half = (low + high) / 2, (high - low) / 2
    weights["mean.weight"] = (weights["mean.weight"] / half[:, None]).astype(np.float32)
    weights["mean.bias"] = ((weights["mean.bias"] - middle) / half).astype(np.float32)
    weights["log_std_vector"] = (weights["log_std_vector"] - np.log(half)).astype(np.float32)


def _order(path: Path, task: Task, facts: Facts) -> np.ndarray:
    """(observation,) int: the place in the task's observation of each number that the actor takes."""
    if facts.fields in (None, {"state": task.behaviour_size}):  # the latter of this package's own environments
        return np.arange(task.behaviour_size)
    ours = task.state_fields if task.observation == "state" else {}
    if dict(facts.fields) != dict(ours):
        raise PolicyFileError(
            f"{path} observes {facts.fields}, {task.id} shows {dict(ours) or task.observation}; train it on "
            "observations with these names and sizes"
        )
    places = np.arange(task.behaviour_size)
    return np.concatenate([places[task.state_slices[name]] for name in facts.fields])


def _weights(
    path: Path,
    task: Task,
    state: Mapping[str, np.ndarray],
    body: Sequence[str],
    mean: str,
    log_std: str | None,
    distribution: str,
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
            weights["log_std_vector"] = state[log_std].reshape(size) if log_std else np.full(size, NO_NOISE, np.float32)
    except (KeyError, ValueError, TypeError) as error:
        raise _incomplete(path, error) from None
    if set(SCALES) <= state.keys():
        half, middle = (state[name].ravel() for name in SCALES)
        _check_actions(path, task, middle - half, middle + half)
    return weights


def _incomplete(path: Path, error: Exception) -> PolicyFileError:
    return PolicyFileError(f"{path} lacks a part of its actor ({error}); save its whole state dict")


def _normalization(statistics: str | Path | None, size: int) -> tuple[dict[str, np.ndarray], float | None]:
    """The mean and std of observations that a file holds, 0 and 1 without one; what it clips them to, if it says so."""
    if statistics is None:
        return {"observation_mean": np.zeros(size, np.float32), "observation_std": np.ones(size, np.float32)}, None
    try:
        with np.load(statistics, allow_pickle=False) as file, np.errstate(over="ignore"):  # check_weights refuses inf
            moments = {name: np.asarray(file[name], np.float32).reshape(size) for name in ("mean", "std")}
            clip = float(file["clip"]) if "clip" in file else None
            if clip is not None and not clip > 0:
                raise ValueError(f"it clips them to {clip}")
        return {f"observation_{name}": values for name, values in moments.items()}, clip
    except Exception as error:  # numpy's, zip's and zlib's own kinds, and those of a single array
        raise PolicyFileError(
            f'{statistics} has no "mean" and "std" of {size} observations ({first_line(error)}); write it with '
            "numpy.savez(file, mean=..., std=...)"
        ) from None
