"""Releases that this package describes but does not hold: manifest, lists and recipes in one file, found by name.

`<name>.json.xz` maps the path of each of these files to its text. So any part of such a release can be made anywhere,
and each of its files is compared with the released one.
"""

from __future__ import annotations

import contextlib
import json
import lzma
import tempfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import parse_json, write_bytes

if TYPE_CHECKING:
    from dmcvb_gen.dataset3.gate import Release

_FOLDER = resources.files("dmcvb_gen.generate") / "data" / "manifests"
ENDING = ".json.xz"
LARGEST = 1 << 28
"""Bytes of an archive's content; dmcvb-v1's has a tenth of it."""


def shipped_manifests() -> tuple[str, ...]:
    """Names of the releases whose manifests are in the package."""
    names = [path.name for path in _FOLDER.iterdir()]
    return tuple(sorted(name.removesuffix(ENDING) for name in names if name.endswith(ENDING)))


@contextlib.contextmanager
def manifest_source(source: str | Path) -> Iterator[Path]:
    """A folder with the manifest, lists and recipes of a shipped release, by its name, or of an archive's file.

    Raises:
      UnknownNameError: a plain name that is neither a file nor a shipped manifest's.
      StoreError: there is no such file, or it is no archive of a manifest.
    """
    path, name = Path(source), str(source)
    if not path.is_file() and (path.suffix or path.name != name):
        raise StoreError(f"{path} is no file; give an archive or a name: {', '.join(shipped_manifests())}")
    if not path.is_file() and name not in shipped_manifests():
        raise UnknownNameError("manifest", name, shipped_manifests())
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        if not path.is_file():
            path = stack.enter_context(resources.as_file(_FOLDER / f"{name}{ENDING}"))
        unpack(path, Path(folder))
        yield Path(folder)


def pack(release: Release, out: str | Path) -> int:
    """Write the archive of a release's manifest, lists and recipes; return its size in bytes."""
    from dmcvb_gen.dataset3.manifest import MANIFEST, RECIPE_BYTES, RECIPES

    recipes = [f"{RECIPES}{recipe.sha256}.json" for recipe in release.recipes]
    paths = [MANIFEST, *release.lists(), *recipes]
    content = {path: release.store.read(path, RECIPE_BYTES).decode() for path in paths}
    Path(out).write_bytes(lzma.compress(json.dumps(content).encode(), preset=9 | lzma.PRESET_EXTREME))
    return Path(out).stat().st_size


def unpack(archive: Path, folder: Path) -> None:
    """Write the files of an archive into a folder.

    Raises:
      StoreError: it is no such archive, or damaged.
    """
    from dmcvb_gen.dataset3.manifest import check_relative_path

    try:
        text = lzma.LZMADecompressor().decompress(archive.read_bytes(), LARGEST + 1)
        if len(text) > LARGEST:
            raise ValueError(f"it holds more than {LARGEST:,} bytes")
        for path, content in parse_json(text).items():
            write_bytes(folder / check_relative_path(path), content.encode())
    except (OSError, lzma.LZMAError, EOFError, ValueError, AttributeError) as error:
        raise StoreError(
            f"{archive} is no archive of a manifest, or damaged ({error or type(error).__name__}); take it again from "
            "the repository's dataset_cards"
        ) from None
