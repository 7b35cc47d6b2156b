"""The manifest of a whole release from those of its parts, which may be made on different days and machines."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from pathlib import Path

from dmcvb_gen.dataset.index import INDEX, Index, data_files, is_card, root_digest
from dmcvb_gen.dataset.manifest import MANIFEST, FileRecord, Manifest, SubsetRecord
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import json_bytes, link_or_copy, sha256_bytes, write_bytes
from dmcvb_gen.generate.plan import create_groups, describe
from dmcvb_gen.generate.recipe import Recipe, expand
from dmcvb_gen.generate.shipped import manifest_source, read_complete
from dmcvb_gen.storage.remote import storage_errors

DESCRIPTIONS = {"name", "version", "description", "license", "authors"}
"""Facts of a recipe that decide no bytes of an array."""


def join(recipe: Recipe, parts: Sequence[str | Path]) -> tuple[Manifest, Index]:
    """The manifest and index of a recipe's release, from those of releases that hold its subsets; no data are needed.

    A subset's bytes follow from its own record and the recipe's seed, whatever else the release holds. So the parts may
    be made on different days and machines, and the root digest is that of one rollout of the whole recipe.

    Args:
      parts: folders of complete releases, or archives of their manifests and indexes.

    Raises:
      StoreError: a part is not complete, or was not made as the recipe says; a subset of the recipe is in no part.
    """
    found: dict[str, SubsetRecord] = {}
    listed: dict[str, FileRecord] = {}
    environments: list[dict[str, str]] = []
    for part in parts:
        with contextlib.ExitStack() as stack:
            folder = Path(part) if Path(part).is_dir() else stack.enter_context(manifest_source(part))
            manifest, index = read_complete(folder)
        _check_part(manifest, recipe, str(part))
        for record in manifest.subsets:
            if found.setdefault(record.name, record) != record:
                raise StoreError(f"{record.name} of {part} is not that of a part before it; verify both")
        listed |= {file.path: file for file in index.files if not is_card(file.path)}
        environments += [environment for environment in manifest.environments if environment not in environments]
    whole, _ = describe(recipe, pixels=any(record.pixels for record in found.values()))
    for record in whole.subsets:
        if record.name not in found:
            raise StoreError(f"{record.name} of {recipe.name} is in none of the parts; give a release that holds it")
        if found[record.name].model_copy(update={"digest": None}) != record:
            raise StoreError(f"{record.name} was not made as {recipe.name} says; roll it out with that recipe")
    facts = {"subsets": tuple(found[record.name] for record in whole.subsets), "complete": True}
    whole = whole.model_copy(update=facts | {"environments": tuple(environments)})
    with tempfile.TemporaryDirectory() as scratch:  # arrays' metadata name the release, so a part has others
        create_groups(Path(scratch), whole, whole.subsets)
        listed |= {file.path: file for file in data_files(Path(scratch), whole, {})}
    files = tuple(listed[path] for path in sorted(listed))
    whole = whole.model_copy(update={"digest": root_digest(files, whole)})
    return whole, Index(manifest_sha256=sha256_bytes(json_bytes(whole)), files=files).with_checksum()


def join_folders(recipe: Recipe, parts: Sequence[str | Path], out: str | Path) -> Manifest:
    """Write the release of a recipe from folders of its parts. Files become hard links, or copies on another disk.

    Raises:
      StoreError: see `join`; `out` is a file or holds something already, or a part lacks a file.
    """
    manifest, index = join(recipe, parts)
    out = Path(out)
    if out.is_file():
        raise StoreError(f"{out} is a file; give another folder")
    if out.exists() and any(out.iterdir()):
        raise StoreError(f"{out} is not empty; give another folder")
    with storage_errors(out, "write to"):
        create_groups(out, manifest, manifest.subsets)
        for file in index.files:
            if (out / file.path).exists():
                continue
            source = next((path for part in parts if (path := Path(part) / file.path).is_file()), None)
            if source is None:
                raise StoreError(f"{file.path} is in none of the parts; mend them first: dmcvb-gen regenerate PART")
            link_or_copy(source, out / file.path)
        write_bytes(out / INDEX, json_bytes(index))
        write_bytes(out / MANIFEST, json_bytes(manifest))  # last: a folder without it is no release
    return manifest


def _check_part(manifest: Manifest, recipe: Recipe, part: str) -> None:
    """Raises StoreError for a part that was made otherwise, or with subsets that the recipe does not have."""
    if manifest.additions or manifest.lineage:
        raise StoreError(f"{part} grew or was repainted; give a release as its rollout left it")
    asked = recipe.model_dump(mode="json")
    for name in asked.keys() - DESCRIPTIONS - {"subsets", "backgrounds"}:  # each subset's record has its videos' digest
        if (given := manifest.recipe.get(name)) != asked[name]:
            raise StoreError(f"{part} was made with {name} {given}, and {recipe.name} has {asked[name]}")
    if strange := {record.name for record in manifest.subsets} - {request.name for request in expand(recipe)}:
        raise StoreError(f"{part} holds {min(strange)}, which {recipe.name} does not have")
