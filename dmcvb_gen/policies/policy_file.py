"""Read and write files of behaviour policies: safetensors weights with a JSON header.

Loading one runs no code from the file, allocates no more than the file holds, and refuses what does not fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pydantic
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors
from safetensors.numpy import save as dump_safetensors

from dmcvb_gen.errors import PolicyFileError, first_line
from dmcvb_gen.files import parse_json, sha256_bytes, write_bytes
from dmcvb_gen.own_code import is_own
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.header import FORMAT_VERSION, PolicyHeader, weight_shapes
from dmcvb_gen.spec import is_maze, task_folder
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import as_maze
from dmcvb_gen.tasks.base import Task

LEAST_NOISE = 1e-9
"""Standard deviation below which drawn actions are the mean ones. Squashed Gaussians have exp(-20) = 2e-9 at least."""


def save_policy(path: str | Path, header: PolicyHeader, weights: Mapping[str, np.ndarray]) -> None:
    """Write a policy file atomically.

    Args:
      weights: as `weight_shapes` of the header says, kept as float32.
    """
    tensors = {name: np.ascontiguousarray(value, np.float32) for name, value in weights.items()}
    data = dump_safetensors(tensors, metadata={"header": header.model_dump_json()})
    write_bytes(path, data)


def read_header(path: str | Path) -> PolicyHeader:
    """The header of a policy file, see `load_policy` for what is refused."""
    return _read(Path(path))[0]


def _read(path: Path) -> tuple[PolicyHeader, dict[str, np.ndarray], str]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PolicyFileError(f"cannot read policy file {path}: {error.strerror}; give the path of one") from None
    try:
        size = int.from_bytes(data[:8], "little")
        metadata = parse_json(data[8 : 8 + size]).get("__metadata__", {})
        version = parse_json(metadata["header"].encode()).get("format_version", 0)
        if version > FORMAT_VERSION:
            raise PolicyFileError(f"{path} has format version {version}; install a newer dmcvb-gen")
        header = PolicyHeader.model_validate_json(metadata["header"])
        weights = load_safetensors(data)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = first_line(error)
        if isinstance(error, pydantic.ValidationError):
            first = error.errors()[0]
            reason = f"header field {'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise PolicyFileError(
            f"{path} is not a whole policy file ({reason}); copy it again or export it with select-checkpoints"
        ) from None
    return header, weights, sha256_bytes(data)


def load_policy(path: str | Path, task: Task | None = None, sample: bool = False) -> Policy:
    """Load a policy file.

    Args:
      path: a policy file, or "<module>:<function>" (see `policies.own`), which needs a task.
      task: the task it must be for; the header's own by default.
      sample: its actions will be drawn.

    Raises:
      PolicyFileError: the file is not whole, is for another task, its shapes or values do not fit, or it has no noise.
    """
    if is_own(str(path)) and task is not None:
        from dmcvb_gen.policies.own import own_policy

        return own_policy(str(path), task)
    path = Path(path)
    header, weights, digest = _read(path)
    if task is not None and header.task != task.id and not (is_maze(header.task) and is_maze(task.id)):
        raise PolicyFileError(f"{path} is a policy for {header.task}, not for {task.id}; give one trained on {task.id}")
    task = task or get_task(header.task)  # ant-maze policies never see the layout, so most may act in any maze
    if header.way is not None and as_maze(get_task(header.task)).layout.rows != as_maze(task).layout.rows:
        raise PolicyFileError(f"{path} knows the way of another layout; give one trained on {task_folder(task.id)}")
    asked = (task.behaviour_size, task.action_size)
    if (header.observation_size, header.action_size) != asked:
        raise PolicyFileError(
            f"{path} maps {header.observation_size} observations to {header.action_size} actions, "
            f"{task.id} has {asked[0]} and {asked[1]}; train it again for this task"
        )
    if header.observation not in (None, task.observation):
        raise PolicyFileError(
            f"{path} sees {header.observation!r}, {task.id} shows {task.observation!r}; train it again for this task"
        )
    check_weights(path, header, weights)
    policy = Policy(header, weights, digest)
    if sample and policy.distribution(np.zeros((1, task.behaviour_size)))[1].max() < LEAST_NOISE:
        raise PolicyFileError(f"--sample has no effect: a policy for {task.id} has no noise to sample; remove it")
    return policy


def check_weights(path: Path, header: PolicyHeader, weights: Mapping[str, np.ndarray]) -> None:
    """Refuse weights that are not those of a header.

    Raises:
      PolicyFileError: names and shapes differ, or values are not finite float32, or no scale of observations.
    """
    wanted = weight_shapes(header)
    for name in sorted(wanted.keys() | weights.keys()):
        shape = weights[name].shape if name in weights else None
        if shape != wanted.get(name):
            raise PolicyFileError(
                f"{path}: weight {name!r} has shape {shape}, its neighboring layers need {wanted.get(name)}; save "
                "it whole"
            )
    for name, value in weights.items():
        if value.dtype != np.float32 or not np.isfinite(value).all():
            raise PolicyFileError(
                f"{path}: weight {name!r} holds values that are not finite float32; take an earlier checkpoint"
            )
    if not (weights["observation_std"] > 0).all():
        raise PolicyFileError(f"{path}: observation_std is not positive; give 1 to observations that never change")
