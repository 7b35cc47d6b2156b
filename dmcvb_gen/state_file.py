"""The files that trainings resume from, of policies and of agents: nested tensors, numbers and texts.

A folder may come from another person (`--init-from`, `--resume`), so a state is read as data: tensors by number, and a
JSON tree that says where each belongs. Nothing in such a file can run.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open

from dmcvb_gen.errors import DmcvbError, first_line

STATE = "state.safetensors"
"""The file's name in a run's `resume` folder."""


def pack_state(state: Any) -> bytes:
    """A tree of dicts, lists, tuples, tensors, numbers, texts and None as a file's bytes.

    Raises:
      TypeError: anything else is in it.
    """
    tensors: dict[str, torch.Tensor] = {}
    memory: set[int] = set()

    def tree(value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            name = str(len(tensors))
            value = value.detach().cpu().contiguous()
            place = value.untyped_storage().data_ptr()
            tensors[name] = value.clone() if place in memory else value  # a file's tensors share no memory
            memory.add(place)
            return {"tensor": name}
        if isinstance(value, dict):
            return {"dict": [[key, tree(inner)] for key, inner in value.items()]}
        if isinstance(value, (list, tuple)):
            return {type(value).__name__: [tree(inner) for inner in value]}
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        raise TypeError(f"a saved state cannot hold a {type(value).__name__}")

    return safetensors.torch.save(tensors, metadata={"state": json.dumps(tree(state))})


def read_state_file(path: str | Path, otherwise: str) -> Any:
    """Read a file that `pack_state` made.

    Args:
      otherwise: what to do if it cannot be read, for the message.

    Raises:
      DmcvbError: the file is damaged, or holds something else.
    """
    try:
        with safe_open(path, framework="pt") as file:
            return _value(json.loads((file.metadata() or {})["state"]), file)
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DmcvbError(f"{path} cannot be read ({first_line(error)}); {otherwise}") from None


def _value(tree: Any, file: Any) -> Any:
    if not isinstance(tree, dict):
        return tree
    [(kind, content)] = tree.items()
    if kind == "tensor":
        return file.get_tensor(content)
    if kind == "dict":
        return {key: _value(inner, file) for key, inner in content}
    values = [_value(inner, file) for inner in content]
    return {"list": list, "tuple": tuple}[kind](values)
