"""The manifest of a release: recipe, versions, policies, backgrounds and digests, read and written as checked JSON."""

from __future__ import annotations

import functools
import platform
import re
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import parse_json
from dmcvb_gen.files import write_json as write_json_atomically
from dmcvb_gen.spec import ANT_MAZE, FIXED, HIDDEN, LOCOMOTION, DistractorSetting, GoalMode, SubsetSpec, is_maze
from dmcvb_gen.storage.remote import storage_errors
from dmcvb_gen.version import __version__

__all__ = ["write_json_atomically"]
MANIFEST = "manifest.json"

SCHEMA_VERSION = 2
"""Version of the layout and the manifest; a reader refuses newer ones and reads all older ones."""

MAX_EPISODES, MAX_SHARDS, MAX_STEPS, MAX_SIZE = 10**8, 10**5, 10**6, 10**4
"""More than any release has; what asks for more is damaged or hostile, and would keep a reader busy for hours."""

IMPORTED = "imported"
"""Name of the renderer of subsets that came from DMC-VB's published data."""

PLAIN_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.+-]*$"
"""A part of a path that leads nowhere else; exports make folders and files of versions and views."""
_NAME = re.compile(PLAIN_NAME.strip("^$"))


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
    """A shard that is whole: which episodes, which files. A shard without its record does not exist.

    Attributes:
      environment: environment that made it, see `environment`; empty in releases of version 1.
      painted: True if its pictures are among the files.
      pictures: files that its pictures had where they were painted, for whoever paints them again; empty if they
        are stored, or never were painted.
    """

    subset: RelativePath
    shard: int = pydantic.Field(ge=0)
    episodes: tuple[int, int]
    steps: int = pydantic.Field(ge=0)
    files: tuple[FileRecord, ...]
    environment: dict[str, str] = {}
    painted: bool = True
    pictures: tuple[FileRecord, ...] = ()

    @property
    def episode_count(self) -> int:
        return self.episodes[1] - self.episodes[0]

    def same_data(self, other: CommitRecord) -> bool:
        """Return True if both stand for the same bytes, even if they were made on different machines."""
        return self.model_copy(update={"environment": {}}) == other.model_copy(update={"environment": {}})


class PolicyRecord(_Model):
    """A behaviour policy of a subset: where the release keeps a copy, and what it is."""

    name: str
    digest: str
    path: RelativePath | None = None
    header: dict[str, Any] = {}


class SubsetRecord(_Model):
    """One subset: what it was asked to be.

    Attributes:
      family: family of its task, "locomotion" or "ant-maze".
      views: names of the pictures of a frame, in the order in which policies see them.
      hidden_goal: True if the pictures that the subset is about have no goal in them (both kinds may be stored).
      max_steps: transitions at which the time limit ends an episode.
      fixed_goals, episodes_per_goal: how many pairs of start and goal there are, and how many episodes each has; what
        is at hand may be fewer. None if both are drawn for each episode.
      split: the videos and styles that it was painted with, "train" or "val".
      pixels: True if pictures are stored; without them, they can be painted from physics states and labels.
      only_shown: whether only the pictures that the subset is about are stored; else, if the task has a goal, those
        with it and those without it. Left out of the JSON if it is false, as it is in older releases.
    """

    name: RelativePath
    task: str
    level: str
    setting: str
    episodes: int = pydantic.Field(gt=0, le=MAX_EPISODES)
    episodes_per_shard: int = pydantic.Field(gt=0, le=MAX_EPISODES)
    size: int = pydantic.Field(gt=0, le=MAX_SIZE)
    deterministic: bool = False
    policies: tuple[PolicyRecord, ...] = ()
    renderer: dict[str, Any] = {}
    backgrounds: dict[str, Any] | None = None
    family: str = LOCOMOTION
    views: tuple[Annotated[str, pydantic.StringConstraints(pattern=PLAIN_NAME)], ...] = pydantic.Field(
        default=("pixels",), min_length=1, max_length=100
    )
    hidden_goal: bool = False
    max_steps: int = pydantic.Field(default=500, gt=0, le=MAX_STEPS)
    fixed_goals: int | None = pydantic.Field(default=None, gt=0, le=MAX_EPISODES)
    episodes_per_goal: int | None = pydantic.Field(default=None, gt=0, le=MAX_EPISODES)
    split: str = "train"
    pixels: bool = True
    digest: Digest | None = None
    only_shown: bool = False

    @pydantic.field_validator("backgrounds")
    @classmethod
    def _stays_inside(cls, backgrounds: dict[str, Any] | None) -> dict[str, Any] | None:
        source = (backgrounds or {}).get("source")
        if source is not None and not Path(str(source)).is_absolute():  # absolute: in releases of version 1, only read
            check_relative_path(str(source))
        return backgrounds

    @property
    def spec(self) -> SubsetSpec:
        """Its typed identity.

        Raises:
          UnknownNameError: the manifest names a level or setting that does not exist.
        """
        return SubsetSpec.parse(self.task, self.level, self.setting)

    @property
    def distractor(self) -> DistractorSetting:
        """The distractor of its images; "none" for mazes."""
        return self.spec.distractor

    @property
    def goal_mode(self) -> GoalMode | None:
        """Treatment of a maze's goal; None for tasks without one."""
        return self.spec.goal

    @property
    def imported(self) -> bool:
        """Whether it came from DMC-VB's published data, which have no physics states and no labels: nothing of it can
        be simulated or painted again."""
        return self.renderer.get("name") == IMPORTED

    @pydantic.model_serializer(mode="wrap")
    def _bare(self, dump: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        data = dump(self)
        if not self.only_shown:
            data.pop("only_shown", None)
        return data


class VersionEntry(_Model):
    """One growth of a release.

    Attributes:
      version: version of the release since then.
      recipe: the resolved recipe that was added.
      generator: program that added it.
      subsets: name -> (first, last + 1) of the episodes that it added.
    """

    version: str
    recipe: dict[str, Any]
    generator: str
    subsets: dict[RelativePath, tuple[int, int]]


def _check_shards(subsets: tuple[SubsetRecord, ...]) -> tuple[SubsetRecord, ...]:
    if (count := sum(map(shard_count, subsets))) > MAX_SHARDS:
        raise ValueError(f"{count:,} shards are more than the {MAX_SHARDS:,} that a release may have")
    return subsets


class Manifest(_Model):
    """The release's manifest.json.

    Attributes:
      recipe: the resolved recipe that made it, in its first version.
      additions: its growths since, in order.
      environments: versions and platform of every process that added to it, in order.
      lineage: for a release derived from another one (repaint, fetch, import): what from.
      complete: True if every shard of every subset is committed; `digest`s are set then.
      digest: digest of every file of the release, see `dmcvb_gen.dataset.index`; None while it is made.
    """

    schema_version: int = SCHEMA_VERSION
    name: str
    version: Annotated[str, pydantic.StringConstraints(pattern=PLAIN_NAME)]
    license: str
    authors: tuple[str, ...] = ()
    generator: str = f"dmcvb-gen {__version__}"
    recipe: dict[str, Any]
    additions: tuple[VersionEntry, ...] = ()
    subsets: Annotated[tuple[SubsetRecord, ...], pydantic.AfterValidator(_check_shards)]
    environments: tuple[dict[str, str], ...] = ()
    lineage: tuple[dict[str, Any], ...] = ()
    complete: bool = False
    digest: Digest | None = None
    format: Literal["dmcvb-gen release"] = "dmcvb-gen release"

    @property
    def imported(self) -> bool:
        """True if any of its subsets was imported, see `SubsetRecord.imported`."""
        return any(record.imported for record in self.subsets)

    def recipe_of(self, subset: str) -> dict[str, Any]:
        """The recipe that a subset's first episode was made by; those added later agree with it."""
        for addition in self.additions:
            if addition.subsets.get(subset, (1, 1))[0] == 0:
                return addition.recipe
        return self.recipe

    def origin(self, subset: str) -> tuple[str, str]:
        """The version of the release that a subset's last episodes came with, and what made its first."""
        version, generator = str(self.recipe.get("version", self.version)), self.generator
        for addition in self.additions:
            if subset in addition.subsets:
                version = addition.version
                generator = addition.generator if addition.subsets[subset][0] == 0 else generator
        return version, generator

    def labels_of(self, subset: str) -> tuple[str, ...]:
        """Modalities that the last repaint stored in a subset, which rollouts do not make."""
        repaints = [entry for entry in self.lineage if entry["kind"] == "repaint" and subset in entry["subsets"]]
        return tuple(repaints[-1].get("labels", ())) if repaints else ()


def subset_path(name: str) -> str:
    """Folder of a subset's Zarr group inside the release."""
    return f"{name}.zarr"


def commit_path(name: str, shard: int) -> str:
    """Commit record of a shard inside the release."""
    return f"commits/{name}/{shard:05d}.json"


def shard_count(subset: SubsetRecord) -> int:
    return -(-subset.episodes // subset.episodes_per_shard)


def shard_episodes(subset: SubsetRecord, shard: int) -> tuple[int, int]:
    """First episode of a shard, and the one after its last."""
    first = shard * subset.episodes_per_shard
    return first, min(first + subset.episodes_per_shard, subset.episodes)


def environment() -> dict[str, str]:
    """Versions and the processor that can change a bit of the data."""
    return dict(_environment())


@functools.cache
def _environment() -> dict[str, str]:
    packages: tuple[str, ...] = ("mujoco", "dm-control", "scikit-fmm", "numba", "numpy", "scipy", "zarr", "numcodecs")
    versions = {name: version for name in packages if (version := _version(name))}
    return {
        "dmcvb-gen": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_name(),
        **versions,
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


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


def local_manifest(root: Path) -> Manifest:
    """The manifest in a release's folder.

    Raises:
      StoreError: there is none, it is damaged or cannot be read.
    """
    with storage_errors(root / MANIFEST):
        if not (root / MANIFEST).is_file():
            raise StoreError(f"{root} holds no release (no {MANIFEST}); give the folder that `rollout --out` made")
        return parse_manifest((root / MANIFEST).read_bytes(), str(root / MANIFEST))


def parse_commit(text: str | bytes, where: str = "commit record") -> CommitRecord:
    """A commit record from JSON, see `parse_manifest`."""
    return _parse(CommitRecord, text, where)


def checked_commit(text: str | bytes, where: str, subset: SubsetRecord, shard: int) -> CommitRecord:
    """A shard's commit record from JSON, wherever it was read.

    Raises:
      StoreError: it is damaged, another shard's, or names files outside of the subset's folder.
    """
    commit = parse_commit(text, where)
    if (commit.subset, commit.shard, commit.episodes) != (subset.name, shard, shard_episodes(subset, shard)):
        raise StoreError(
            f"{where} is not the record of episodes {_span(shard_episodes(subset, shard))} of {subset.name} but of "
            f"{_span(commit.episodes)} of {commit.subset}; put the release's own record back (`dmcvb-gen regenerate` "
            "makes it again)"
        )
    folder = f"{subset_path(subset.name)}/"
    if any(not file.path.startswith(folder) for file in (*commit.files, *commit.pictures)):
        raise StoreError(f"{where} names files outside of {folder}; do not trust this release")
    return commit


def _span(episodes: tuple[int, int]) -> str:
    return f"{episodes[0]}:{episodes[1]}"


def _parse(model, text, where):
    try:
        data = parse_json(text)
    except ValueError as error:
        raise StoreError(f"{where} is not JSON ({error}); fetch it again, or make a new release") from None
    version = data.get("schema_version", SCHEMA_VERSION) if isinstance(data, dict) else None
    if isinstance(version, int) and version > SCHEMA_VERSION:
        raise StoreError(
            f"{where} has schema version {version}, this dmcvb-gen {__version__} reads up to {SCHEMA_VERSION}; "
            "install a newer dmcvb-gen"
        )
    if model is Manifest and version == 1:
        data = _upgraded(data)
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the top"
        raise StoreError(f"{where} is not valid at {place}: {first['msg']}") from None


def _upgraded(data: dict[str, Any]) -> dict[str, Any]:
    """A manifest of version 1 with what version 2 says of each subset; there were two families of tasks then."""
    subsets, recipe = data.get("subsets"), data.get("recipe")
    if not isinstance(subsets, list) or not isinstance(recipe, dict):
        return data  # the model says what is wrong
    patterns = recipe.get("subsets")
    patterns = [p for p in patterns if isinstance(p, dict)] if isinstance(patterns, list) else []
    upgraded = []
    for old in subsets:
        if not isinstance(old, dict):
            return data
        facts: dict[str, Any] = {"split": (old.get("backgrounds") or {}).get("split") or recipe.get("split", "train")}
        if is_maze(str(old.get("task"))):
            facts |= {"family": ANT_MAZE, "views": ["top", "egocentric", "follow", "overhead"], "max_steps": 1200}
            facts["hidden_goal"] = old.get("setting") in (HIDDEN, FIXED)
            if old.get("setting") == FIXED:
                facts |= _goal_pairs_of_version_1(old, patterns)
        upgraded.append(facts | old)
    return {**data, "subsets": upgraded}


def _goal_pairs_of_version_1(record: dict[str, Any], patterns: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the number of start and goal pairs of a fixed subset, from the recipe's pattern that asked for it."""
    for pattern in patterns:
        tasks, per_goal = pattern.get("tasks") or (), pattern.get("episodes_per_goal")
        if record.get("task") in tasks and FIXED in (pattern.get("settings") or ()) and per_goal:
            return {"fixed_goals": record.get("episodes", 0) // per_goal, "episodes_per_goal": per_goal}
    return {}
