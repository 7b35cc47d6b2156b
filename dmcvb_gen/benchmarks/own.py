"""Load your own agents ("module:name") for a validation.

The name is that of a ready policy, or of a function or class whose first parameter is called `data` and whose others
have defaults: it gets the episodes that a cell learns from (`AgentData`) and makes a policy. A policy is a callable as
`dmcvb_gen.evaluate` takes it. Two attributes of the named object, if it has them, say what its policy sees: `stack`
(frames, 3) and `pixels` (True).
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.benchmarks.evaluate import Act
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.loaders.source import StepSource
from dmcvb_gen.own_code import source_digest


@dataclass(frozen=True)
class AgentData:
    """Data that your own agent learns from.

    Attributes:
      sources: one a subset, all steps of its training episodes (`StepSource`: len(), [i] and gather(), numpy alone).
      task, setting: scene of its policy's score. seed: seed of the validation.
    """

    sources: tuple[StepSource, ...]
    task: str
    setting: str
    seed: int

    @property
    def source(self) -> StepSource:
        """The first source; the only one, unless levels are mixed."""
        return self.sources[0]


@dataclass(frozen=True)
class OwnAgent:
    """An agent that a user brought.

    Attributes:
      name: "module:name". value: what it names.
    """

    name: str
    value: Any

    @classmethod
    def load(cls, name: str) -> OwnAgent:
        """Import it; modules of the working folder are found.

        Raises:
          DmcvbError: there is no such module or name, importing it fails, or it cannot be called.
        """
        module, _, attribute = name.partition(":")
        if os.getcwd() not in sys.path:
            sys.path.insert(0, os.getcwd())
        try:
            value = getattr(importlib.import_module(module), attribute)
        except Exception as error:  # a user's module may raise anything
            raise DmcvbError(f"cannot load agent {name} ({error}); give MODULE:NAME, run from its folder") from None
        if not callable(value):
            raise DmcvbError(f"agent {name} is a {type(value).__name__}; expected a policy or a function of `data`")
        agent = cls(name, value)
        if isinstance(value, type) and not agent.learns:
            raise DmcvbError(f"agent {name} is a class; expected a policy, or a function or class of `data`")
        return agent

    @property
    def learns(self) -> bool:
        """True if it makes a policy of data."""
        try:
            first, *others = inspect.signature(self.value).parameters.values()
        except (TypeError, ValueError):
            return False
        optional = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        return first.name == "data" and all(o.default is not o.empty or o.kind in optional for o in others)

    @property
    def stack(self) -> int:
        return int(getattr(self.value, "stack", 3))

    @property
    def pixels(self) -> bool:
        return bool(getattr(self.value, "pixels", True))

    def policy(self, data: AgentData) -> Act:
        """The policy, trained if it learns.

        Raises:
          DmcvbError: training gives something that cannot be called.
        """
        policy = self.value(data) if self.learns else self.value
        if not callable(policy):
            raise DmcvbError(f"agent {self.name} returned a {type(policy).__name__}; expected a policy to call")
        return policy

    @property
    def digest(self) -> str:
        """SHA-256 of the module's file, so that a changed agent is scored again; "" for code without a file."""
        return source_digest(self.name.partition(":")[0])

    @property
    def helpers(self) -> dict[str, str]:
        """Module -> SHA-256 of its file, of the user's own modules that the agent's imports, directly or not.

        They are read from the import statements, also those inside functions: which modules a process has imported
        so far would depend on what it did before.
        """
        module = self.name.partition(":")[0]
        file = getattr(sys.modules[module], "__file__", None)
        if not file:
            return {}
        depth = module.count(".") + (Path(file).stem == "__init__")
        root, found, waiting = Path(file).parents[depth], {module: Path(file)}, [module]
        only = module.partition(".")[0] if root in _installed() else None
        while waiting:
            name = waiting.pop()
            for other in _imports(name, found[name]):
                top, path = other.partition(".")[0], _file_of(root, other)
                if path and other not in found and top != "dmcvb_gen" and only in (None, top):
                    found[other] = path
                    waiting.append(other)
        return {name: _digest_of(name, path) for name, path in sorted(found.items()) if name != module}


def _installed() -> set[Path]:
    """Folders of installed packages, which are no modules of the user beside the agent's."""
    return {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib", "stdlib")}


def _imports(module: str, file: Path) -> Iterator[str]:
    """Names that a module's import statements may mean, packages above them too; some are no modules."""
    package = module if file.stem == "__init__" else module.rpartition(".")[0]
    with contextlib.suppress(SyntaxError, ValueError, ImportError):  # compiled, or only imported by a function
        for node in ast.walk(ast.parse(file.read_bytes())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                names = [f"{base}.{alias.name}" for alias in node.names]
            for name in names:
                parts = name.split(".")
                yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))


def _file_of(root: Path, module: str) -> Path | None:
    """The source file of a module below a folder; None if it has none there."""
    place = root.joinpath(*module.split("."))
    return next((path for path in (place / "__init__.py", place.with_suffix(".py")) if path.is_file()), None)


def _digest_of(module: str, file: Path) -> str:
    """`source_digest`, which refuses a file that has changed since its import; of one not imported, of its bytes."""
    if getattr(sys.modules.get(module), "__file__", None) == str(file):
        return source_digest(module)
    return hashlib.sha256(file.read_bytes()).hexdigest()
