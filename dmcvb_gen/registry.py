"""Registries: tables of named things, to which this package, its users and other packages add.

A thing enters its table when its module is imported, by a decorator. A registry imports the modules of one folder of
this package, those that installed packages name in a group of entry points, and those that the environment variable
DMCVB_GEN_PLUGINS names, when it is first asked.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
from collections.abc import Mapping
from importlib import metadata
from typing import Any, Generic, TypeVar

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.own_code import PLUGINS, import_plugins

Thing = TypeVar("Thing")
_log = logging.getLogger(__name__)


class Registry(Generic[Thing]):
    """Name -> thing of one kind.

    Args:
      kind: word for what it holds, for messages: "format".
      package: the module of ours, or the package with modules, that registers its things on import.
      group: entry points of other packages, modules or objects in them, that do so too.
    """

    def __init__(self, kind: str, package: str, group: str):
        self.kind, self.package, self.group = kind, package, group
        self._things: dict[str, Thing] = {}
        self._code: dict[str, Any] = {}
        self._loaded = False

    def add(self, name: str, thing: Thing, code: Any = None) -> None:
        """Register a thing; `code` is the function or class that it was made of, if it is none itself.

        Raises:
          DmcvbError: the name is taken by other code.
        """
        code = code or thing
        known = self._code.get(name, code)
        if known is not code and (known.__module__, known.__qualname__) != (code.__module__, code.__qualname__):
            where = f"{known.__module__} and {code.__module__}"
            raise DmcvbError(f"two {self.kind}s are called {name}: {where}; rename one of them")
        self._things[name], self._code[name] = thing, code

    def all(self) -> Mapping[str, Thing]:
        """All things by name, this package's first."""
        if not self._loaded:
            package = importlib.import_module(self.package)
            for module in pkgutil.iter_modules(getattr(package, "__path__", ())):
                importlib.import_module(f"{self.package}.{module.name}")
            for entry in metadata.entry_points(group=self.group):
                try:
                    entry.load()
                except Exception as error:  # one broken package must not stop all others
                    _log.warning("%s %s (%s) cannot be loaded: %s", self.kind, entry.name, entry.value, error)
            import_plugins()
            self._loaded = True
        return self._things

    def get(self, name: str) -> Thing:
        """The thing of a name.

        Raises:
          UnknownNameError: there is none; the message lists those that there are.
        """
        if name not in self.all():
            own = f"one of your own needs {PLUGINS}=MODULE"
            raise UnknownNameError(self.kind, name, self.all(), own)
        return self._things[name]
