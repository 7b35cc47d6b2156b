"""An oracle of releases that imports nothing of the package: JSON and SHA-256 of what lies in a folder."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def contents(root: Path) -> dict[str, bytes]:
    """Path -> bytes of all files of a release, hidden ones and provenance apart."""
    paths = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in paths.items() if not name.startswith((".", "provenance"))}


def check(root: Path) -> dict | None:
    """The manifest in a folder, None if there is none; everything that it names must be there, to the byte.

    Raises:
      AssertionError: something named is missing or has other bytes.
    """
    for recipe in (root / "recipes").glob("*.json"):
        assert sha256(recipe) == recipe.stem, f"{recipe} was altered"
    if not (root / "manifest.json").exists():
        assert not any(root.rglob("zarr.json")), "metadata for plain readers before the manifest"
        return None
    manifest = json.loads((root / "manifest.json").read_bytes())
    for recipe in manifest["recipes"]:
        assert (root / f"recipes/{recipe}.json").exists(), f"recipe {recipe} is missing"
    counts = {layer["name"]: layer["shards"] * layer["episodes_per_shard"] for layer in manifest["layers"]}
    for subset in manifest["subsets"]:
        for name in subset["layers"][:2]:
            assert counts[name] >= subset["episodes"], f"{name} has too few shards"
    for layer in manifest["layers"]:
        listed = root / f"layers/{layer['list']}.json"
        assert sha256(listed) == layer["list"], f"{listed} was altered"
        shards = json.loads(listed.read_bytes())["shards"]
        assert len(shards) == layer["shards"]
        for number, shard in enumerate(shards):
            record = root / f"records/{layer['name']}/{number:05d}.json"
            assert json.loads(record.read_bytes()) == shard, f"{record} is not what is listed"
            for array, file in shard["files"].items():
                folder = root / layer["group"] / (array if array.startswith("exogenous/") else array.replace("/", "_"))
                chunks = [path for path in (folder / "c").rglob("*") if path.is_file()]
                own = [path for path in chunks if path.relative_to(folder / "c").parts[0] == str(number)]
                assert len(own) == 1, f"{array} of {record} has {len(own)} files"
                facts = {"bytes": own[0].stat().st_size, "sha256": sha256(own[0])}
                assert facts == file, f"{own[0]} is damaged"
    return manifest
