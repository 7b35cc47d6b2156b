"""What a release says of itself: recipe, versions, policies, backgrounds, digests; read and written as checked JSON."""

from __future__ import annotations

import json
import os
import platform
import re
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from dmcvb_gen import __version__
from dmcvb_gen.errors import StoreError
from dmcvb_gen.store.schema import SCHEMA_VERSION

MANIFEST = "manifest.json"

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]*")


def check_relative_path(path: str) -> str:
    """`path` if it is a plain relative path that stays inside its folder.

    Raises:
      ValueError: it is absolute, climbs out, or holds an odd character.
    """
    parts = path.split("/")
    if not parts or not all(_NAME.fullmatch(part) for part in parts):
        raise ValueError(f"{path!r} is not a plain relative path")
    return path


RelativePath = Annotated[str, pydantic.AfterValidator(check_relative_path)]
Digest = Annotated[str, pydantic.StringConstraints(pattern=r"^[0-9a-f]{64}$")]


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class FileRecord(_Model):
    """One file: its path, bytes and SHA-256."""

    path: RelativePath
    bytes: int = pydantic.Field(ge=0)
    sha256: Digest


class CommitRecord(_Model):
    """A shard that is whole: which episodes, which files. A shard without its record does not exist."""

    subset: RelativePath
    shard: int = pydantic.Field(ge=0)
    episodes: tuple[int, int]
    steps: int = pydantic.Field(ge=0)
    files: tuple[FileRecord, ...]


class PolicyRecord(_Model):
    """A behaviour policy of a subset: where the release keeps a copy, and what it is."""

    name: str
    digest: str
    path: RelativePath | None = None
    header: dict[str, Any] = {}


class SubsetRecord(_Model):
    """One subset: what it was asked to be."""

    name: RelativePath
    task: str
    level: str
    setting: str
    episodes: int = pydantic.Field(gt=0)
    episodes_per_shard: int = pydantic.Field(gt=0)
    size: int
    deterministic: bool = False
    policies: tuple[PolicyRecord, ...] = ()
    renderer: dict[str, Any] = {}
    backgrounds: dict[str, Any] | None = None
    digest: Digest | None = None


class Manifest(_Model):
    """The release's manifest.json.

    Attributes:
      recipe: the resolved recipe that made it.
      environments: versions and platform of every process that added to it, in order.
      lineage: for a release derived from another one (repaint, fetch, import): what from.
      complete: whether every shard of every subset is committed; `digest`s are set then.
    """

    schema_version: int = SCHEMA_VERSION
    name: str
    version: str
    license: str
    authors: tuple[str, ...] = ()
    generator: str = f"dmcvb-gen {__version__}"
    recipe: dict[str, Any]
    subsets: tuple[SubsetRecord, ...]
    environments: tuple[dict[str, str], ...] = ()
    lineage: tuple[dict[str, Any], ...] = ()
    complete: bool = False
    format: Literal["dmcvb-gen release"] = "dmcvb-gen release"


def environment() -> dict[str, str]:
    """Versions and platform that can change a bit of the data."""
    packages = ("mujoco", "mujoco-warp", "warp-lang", "dm-control", "numpy", "torch", "zarr", "numcodecs")
    versions = {name: metadata.version(name) for name in packages}
    return {
        "dmcvb-gen": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_name(),
        **versions,
    }


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def parse_manifest(text: str | bytes, where: str = MANIFEST) -> Manifest:
    """A manifest from JSON.

    Raises:
      StoreError: not JSON, not a manifest, or of a newer schema version.
    """
    return _parse(Manifest, text, where)


def parse_commit(text: str | bytes, where: str = "commit record") -> CommitRecord:
    """A commit record from JSON, see `parse_manifest`."""
    return _parse(CommitRecord, text, where)


def _parse(model, text, where):
    try:
        data = json.loads(text)
    except ValueError as error:
        raise StoreError(f"{where} is not JSON ({error}); fetch or regenerate the release again") from None
    version = data.get("schema_version", SCHEMA_VERSION) if isinstance(data, dict) else None
    if isinstance(version, int) and version > SCHEMA_VERSION:
        raise StoreError(
            f"{where} has schema version {version}, this dmcvb-gen {__version__} reads up to {SCHEMA_VERSION}; "
            "install a newer dmcvb-gen"
        )
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the top"
        raise StoreError(f"{where} is not valid at {place}: {first['msg']}") from None


def write_json_atomically(path: Path, value: pydantic.BaseModel | dict[str, Any]) -> None:
    """Write JSON so that a reader (or a crash) sees the old file or the new one, never a part."""
    data = value.model_dump(mode="json") if isinstance(value, pydantic.BaseModel) else value
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
    try:
        with os.fdopen(handle, "w") as file:
            json.dump(data, file, indent=1)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
