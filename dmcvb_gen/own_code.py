"""Code of your own: "<module>:<name>" names a task's or behaviour policy's function, or a distractor's class.

The code runs, so a name that was read from a file is refused: only names that a person gave to `allow` (the
command line does, for what is typed there) or in an environment variable are run.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from dmcvb_gen.errors import DmcvbError, first_line

TASKS = "DMCVB_GEN_TASKS"
BEHAVIOURS = "DMCVB_GEN_BEHAVIOURS"
DISTRACTORS = "DMCVB_GEN_DISTRACTORS"
"""Environment variables with the names whose code may run, joined by commas; worker processes inherit them."""
PLUGINS = "DMCVB_GEN_PLUGINS"
"""The one with modules that register agents, benchmarks, formats or modalities of your own when they are imported."""

_OWN_ID = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_own(name: str) -> bool:
    """Return True if a name has the form "<module>:<function>"."""
    return _OWN_ID.fullmatch(name) is not None


_digests: dict[str, tuple[Any, str]] = {}
"""Module -> its spec, which is another one after a reload, and the digest that its file had then."""


def source_digest(module: str) -> str:
    """SHA-256 of an imported module's file; "" for code without a file.

    Raises:
      DmcvbError: the file has changed since it was first asked for, so that the code that runs is another one.
    """
    found = sys.modules[module]
    file = getattr(found, "__file__", None)
    if not file:
        return ""
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    spec, before = _digests.setdefault(module, (found.__spec__, digest))
    if spec is not found.__spec__:
        _digests[module] = found.__spec__, digest
    elif before != digest:
        raise DmcvbError(f"{file} has changed, but its old code still runs; restart Python, or importlib.reload it")
    return digest


def allow(names: Iterable[str], variable: str = TASKS) -> None:
    """Let the code of these names run in this process and its children; other names are left out.

    Args:
      variable: `TASKS`, `BEHAVIOURS` or `DISTRACTORS`.
    """
    own = [name for name in names if is_own(name)]
    if own:
        os.environ[variable] = ",".join(dict.fromkeys([*allowed(variable), *own]))


def leave_of(task: str | None) -> str:
    """What lets a task of one's own run in a command that does not name it, to write before that command."""
    return f"{TASKS}={task} " if task and is_own(task) else ""


def permissions() -> dict[str, str]:
    """The environment variables that let code run here, for workers that do not inherit them."""
    return {name: os.environ[name] for name in (TASKS, BEHAVIOURS, DISTRACTORS, PLUGINS) if name in os.environ}


def allowed(variable: str) -> list[str]:
    """The names in an environment variable, whatever commas and spaces people write between them."""
    return os.environ.get(variable, "").replace(",", " ").split()


def find_function(name: str, variable: str, kind: str) -> Callable[..., Any]:
    """The function or class "<module>:<name>"; its module is imported from the path or the current folder.

    Args:
      variable: the environment variable that lets it run.
      kind: word for messages: "task", "behaviour" or "distractor".

    Raises:
      DmcvbError: its code may not run, or cannot be found.
    """
    if name not in allowed(variable):
        names = ",".join([*allowed(variable), name])
        raise DmcvbError(f"{kind} {name} is code of your own; to let it run, set {variable}={names}")
    refuse_file(kind, name)
    module, _, function = name.partition(":")
    if module == "__main__":
        raise DmcvbError(f"{kind} {name} lies in the script that runs; put it into a module that workers can import")
    return getattr(_import(module, f"{kind} {name}", function), function)


def refuse_file(kind: str, name: str) -> None:
    """Raise DmcvbError if a name has a file where its module should be."""
    module, _, function = name.partition(":")
    if module.endswith(".py"):
        raise DmcvbError(f"{kind} {name} is a file; in its folder, give {Path(module).stem}:{function or 'FUNCTION'}")


def import_plugins() -> None:
    """Import the modules that `PLUGINS` names, from the path or the current folder.

    Raises:
      DmcvbError: one cannot be imported.
    """
    for module in allowed(PLUGINS):
        _import(module, f"{PLUGINS} {module}")


def _import(module: str, what: str, function: str | None = None) -> ModuleType:
    """A module of the user's own, which has that function if one is asked for."""
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    form = "<module>"
    if function:
        form += ":<Class>" if what.startswith("distractor ") else ":<function>"
    try:
        found = importlib.import_module(module)
        if not function or hasattr(found, function):
            return found
        place = getattr(found, "__file__", None) or "a module of Python itself"
        reason = f"{place} has no {function!r}; if that is not your file, rename yours"
    except ImportError as error:
        reason = str(error)
    except Exception as error:  # the user's code
        raise DmcvbError(f"{what} cannot be imported ({type(error).__name__}: {first_line(error)})") from error
    raise DmcvbError(f"cannot find {what} ({reason}); give {form}, run from its folder")
