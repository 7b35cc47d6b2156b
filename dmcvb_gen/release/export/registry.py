"""The table of export formats: each writer registers itself, here or from another package.

A format of your own is a function with a decorator, and a line in your package's pyproject.toml::

    @register_exporter("returns")
    def write(source: Source, folder: Path) -> None:
        returns = [str(episode.reward.sum()) for episode in source]
        (folder / "returns.txt").write_text("\\n".join(returns))

    [project.entry-points."dmcvb_gen.exporters"]
    returns = "my_package.my_module"
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.extras import install_hint
from dmcvb_gen.registry import Registry


@dataclass(frozen=True)
class Format:
    """One export format.

    Attributes:
      name: name for `--to`.
      write: writes a subset (`Source`) to an empty folder.
      modules: modules that it imports beyond dmcvb-gen's own dependencies.
      folder_name: subset -> folder below `--out`; its name by default.
    """

    name: str
    write: Callable
    modules: tuple[str, ...] = ()
    folder_name: Callable[[str], str] = str

    def check_installed(self) -> None:
        """Raises DmcvbError if a package that the format needs is not installed."""
        for module in self.modules:
            try:
                importlib.import_module(module)
            except ImportError as error:
                name = error.name or module
                raise DmcvbError(f"export to {self.name}: {install_hint(name) or f'pip install {name}'}") from None


READERS = {"tfds": "rlds", "d4rl": "hdf5", "v-d4rl": "hdf5", "dreamer": "npz", "diffusion-policy": "replay-buffer"}
"""Reader that people ask for -> the format that it reads."""
FORMATS: Registry[Format] = Registry("format", "dmcvb_gen.release.export.formats", "dmcvb_gen.exporters")


def register_exporter(name: str, **facts) -> Callable[[Callable], Callable]:
    """Decorator that registers a function as the writer of a format; `facts` are the attributes of `Format`.

    Raises:
      DmcvbError: another function has that name already.
    """

    def register(write: Callable) -> Callable:
        FORMATS.add(name, Format(name, write, **facts), code=write)
        return write

    return register


def get_format(name: str) -> Format:
    """The format of a name.

    Raises:
      UnknownNameError: there is none; the message lists those that there are.
      DmcvbError: it is the name of a reader; the message has the format that it reads.
    """
    if name in READERS:
        raise DmcvbError(f"unknown format {name!r}. Did you mean {READERS[name]!r}?")
    return FORMATS.get(name)
