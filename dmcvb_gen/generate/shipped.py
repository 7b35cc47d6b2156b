"""Releases that this package describes but does not hold: manifest, recipes and the digest of each record, by name.

`<name>.json.xz` holds them as JSON. A record has the digest of each file of its shard, so any part of such a release
can be made anywhere and compared with the released one.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from dmcvb_gen.dataset.manifest import Manifest, Resolved, canonical_json
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import parse_json, sha256_bytes

if TYPE_CHECKING:
    from dmcvb_gen.dataset.gate import Release

_FOLDER = resources.files("dmcvb_gen.generate") / "data" / "manifests"
ENDING = ".json.xz"
LARGEST = 1 << 28
"""Bytes of an archive's content; dmcvb-v1's has a hundredth of it."""


@dataclass(frozen=True)
class Shipped:
    """What the package knows of a release.

    Attributes:
      manifest, recipes: of the release.
      records: layer -> SHA-256 of the record of each shard, in order.
    """

    manifest: Manifest
    recipes: tuple[Resolved, ...]
    records: Mapping[str, tuple[str, ...]]

    @property
    def digest(self) -> str:
        """The release's digest."""
        return sha256_bytes(canonical_json(self.manifest))


def shipped_manifests() -> tuple[str, ...]:
    """Names of the releases whose manifests are in the package."""
    names = [path.name for path in _FOLDER.iterdir()]
    return tuple(sorted(name.removesuffix(ENDING) for name in names if name.endswith(ENDING)))


def load_shipped(source: str | Path) -> Shipped:
    """A shipped release by its name, or the one of an archive's file.

    Raises:
      UnknownNameError: a plain name that is neither a file nor a shipped manifest's.
      StoreError: there is no such file, or it is no archive of a manifest.
    """
    path, name = Path(source), str(source)
    if not path.is_file() and (path.suffix or path.name != name):
        raise StoreError(f"{path} is no file; give an archive or a name: {', '.join(shipped_manifests())}")
    if not path.is_file() and name not in shipped_manifests():
        raise UnknownNameError("manifest", name, shipped_manifests())
    data = path.read_bytes() if path.is_file() else (_FOLDER / f"{name}{ENDING}").read_bytes()
    try:
        text = lzma.LZMADecompressor().decompress(data, LARGEST + 1)
        if len(text) > LARGEST:
            raise ValueError(f"it holds more than {LARGEST:,} bytes")
        content = parse_json(text)
        recipes = tuple(map(Resolved.model_validate, content["recipes"]))
        records = {layer: tuple(map(str, digests)) for layer, digests in content["records"].items()}
        return Shipped(Manifest.model_validate(content["manifest"]), recipes, records)
    except (lzma.LZMAError, EOFError, ValueError, LookupError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise StoreError(f"{source} is no archive of a manifest, or damaged ({reason}); download it again") from None


def pack(release: Release, out: str | Path) -> int:
    """Write the archive of a finished release; return its size in bytes."""
    content = {
        "manifest": release.manifest.model_dump(mode="json"),
        "recipes": [recipe.model_dump(mode="json") for recipe in release.recipes],
        "records": record_digests(release),
    }
    Path(out).write_bytes(lzma.compress(json.dumps(content).encode(), preset=9 | lzma.PRESET_EXTREME))
    return Path(out).stat().st_size


def record_digests(release: Release) -> dict[str, tuple[str, ...]]:
    """Layer -> SHA-256 of the record of each shard, in order."""
    return {name: tuple(shard.record_file.sha256 for shard in release.layer_shards(name)) for name in release.layers}
