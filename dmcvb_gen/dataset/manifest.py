"""Describe a release as data: layers, subsets, resolved recipes, shard records and the manifest, as checked JSON.

::

    recipes/<sha>.json           Resolved     what was asked for, resolved: layers, subsets, inputs
    records/<layer>/00003.json   ShardRecord  one shard of one layer: its job key, its files
    layers/<sha>.json            LayerList    all records of a layer, in order
    manifest.json                Manifest     subsets, and layers with the SHA-256 of their lists

A digest of a release is the SHA-256 of its manifest's bytes; from there, every file has its SHA-256. The manifest is a
function of recipes and records (`build_manifest`), so every process that finishes a release writes the same bytes.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import pydantic
from typing_extensions import TypedDict

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import parse_json, sha256_bytes
from dmcvb_gen.spec import LOCOMOTION, DistractorSetting, GoalMode, SubsetSpec, is_maze, parse_setting

MANIFEST, COPY = "manifest.json", "copy.json"
RECIPES, RECORDS, LAYERS, MANIFESTS, PROVENANCE = "recipes/", "records/", "layers/", "manifests/", "provenance/"
POLICIES, VIDEOS = "policies/", "backgrounds/"
ZARR_JSON = "zarr.json"
ATTACHMENT_FILES = ("README.md", "CHANGELOG.md", "LICENSE", "croissant.json")
CARD_FOLDER = "card/"
"""Attachments: files of the card, copied as data and no part of the tree. Nothing else may lie in a release."""

MANIFEST_BYTES, RECIPE_BYTES, COPY_BYTES = 2**26, 2**26, 2**24
"""Largest files of their kind that a reader takes."""
MAX_EPISODES, MAX_SHARDS, MAX_STEPS, MAX_SIZE = 10**7, 10**5, 10**6, 10**4
MAX_CHUNK_BYTES, MAX_SHARD_BYTES, MAX_LIST_BYTES = 2**31, 2**37, 2**28
"""More than any release has; a manifest that asks for more is damaged or hostile."""
PLAIN_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.+-]*$"
"""A part of a path that leads nowhere else; exports make folders and files of versions and views."""
_PART = PLAIN_NAME.strip("^$")
IMPORTED = "imported"
"""Name of the renderer of subsets that came from DMC-VB's published data."""
Kind = Literal["trajectories", "labels", "images"]
Codec = Literal["zstd", "channel-delta-zstd"]


RelativePath = Annotated[str, pydantic.StringConstraints(pattern=f"^{_PART}(/{_PART})*$", max_length=1000)]
"""A path that stays inside its folder, without odd characters."""
Digest = Annotated[str, pydantic.StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Line = Annotated[str, pydantic.StringConstraints(pattern=r"^[^\x00-\x1f\x7f-\x9f]*$", max_length=1000)]
PlainName = Annotated[str, pydantic.StringConstraints(pattern=PLAIN_NAME, max_length=200)]


def check_name(name: str) -> str:
    """Return a release's name.

    Raises:
      StoreError: it is too long, or has other characters than paths and pages can hold.
    """
    if not re.fullmatch(PLAIN_NAME, name) or len(name) > 200:
        raise StoreError(f"{name[:80]!r} is no name of a release; give letters, digits, and any of _ . + -")
    return name


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class FileRecord(_Model):
    """One file: its path in the release, its size in bytes, and its SHA-256."""

    path: RelativePath
    bytes: int = pydantic.Field(ge=0)
    sha256: Digest


def file_of(path: str, data: bytes) -> FileRecord:
    """The record of a file with these bytes."""
    return FileRecord(path=path, bytes=len(data), sha256=sha256_bytes(data))


# -- layers and their records ---------------------------------------------------------------------


class ArraySpec(_Model):
    """One array of a layer.

    Attributes:
      name: the reader's name, e.g. "pixels", "pixels/top", "at84/pixels" or "exogenous/camera_position".
      dtype: numpy name.
      shape: shape of one step, or of one episode's entry if `steps` is false.
      dims: names of the axes of `shape`.
      steps: True if the array has a step axis.
      chunk_steps: steps of one chunk, the unit of reading; None: all steps of an episode.
      codec: how a chunk becomes bytes, see `schema.array_metadata`.
      attributes: stored with the array, e.g. the fields of a state or the bounds of an action.
    """

    name: RelativePath
    dtype: Literal[
        "bool", "uint8", "uint16", "uint64", "int8", "int16", "int32", "int64", "float32", "float64", "float16"
    ]
    shape: tuple[Annotated[int, pydantic.Field(gt=0, le=10**7)], ...] = ()
    dims: tuple[PlainName, ...] = ()
    steps: bool = True
    chunk_steps: int | None = pydantic.Field(default=None, gt=0)
    codec: Codec = "zstd"
    attributes: dict[str, Any] = {}

    @property
    def step_bytes(self) -> int:
        """Bytes of one step, or of one episode's entry, before compression."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    @property
    def stored_name(self) -> str:
        """Path below the layer's group: "pixels/top" lies at "pixels_top"; groups "exogenous" and "at84" stay."""
        head, slash, rest = self.name.partition("/")
        grouped = slash and (head == "exogenous" or re.fullmatch(r"at\d+", head))
        return f"{head}/{rest.replace('/', '_')}" if grouped else self.name.replace("/", "_")


class Layer(_Model):
    """Arrays that are made together, shard by shard: a set of trajectories, a setting's labels, or one image array.

    Attributes:
      name: e.g. "walker-walk/expert/trajectories", "walker-walk/expert/dynamic/labels", ".../dynamic/pixels".
      group: folder of its Zarr group, e.g. "walker-walk/expert.zarr/dynamic".
      kind: "trajectories", "labels" or "images".
      rows: rows of the step axis, max_steps + 1.
      episodes_per_shard: every shard has as many; arrays cut off what was not asked for.
      makes: what else decides its bytes: policies, streams, seed, renderer, ... and "of", the key of the layer below.
      source: where an imported layer comes from; it cannot be made again, and no copy leaves it out.
    """

    name: RelativePath
    group: RelativePath
    kind: Kind
    rows: int = pydantic.Field(gt=0, le=MAX_STEPS + 1)
    episodes_per_shard: int = pydantic.Field(gt=0, le=MAX_EPISODES)
    arrays: tuple[ArraySpec, ...] = pydantic.Field(min_length=1, max_length=1000)
    makes: dict[str, Any] = {}
    source: Line | None = None

    @pydantic.model_validator(mode="after")
    def _bounded(self) -> Layer:
        for spec in self.arrays:
            step, rows = spec.step_bytes, self.rows if spec.steps else 1
            chunk = step * (min(spec.chunk_steps or rows, rows) if spec.steps else self.episodes_per_shard)
            if chunk > MAX_CHUNK_BYTES or step * rows * self.episodes_per_shard > MAX_SHARD_BYTES:
                raise ValueError(f"array {spec.name} of {self.name} has larger shards than any release has")
        _check_unique([spec.stored_name for spec in self.arrays], f"arrays of {self.name}")
        return self

    @functools.cached_property
    def key(self) -> str:
        """SHA-256 of all that decides its bytes, and of nothing else (not its name)."""
        facts = self.model_dump(mode="json", include={"kind", "rows", "episodes_per_shard", "makes", "source"})
        facts["arrays"] = [spec.model_dump(mode="json") for spec in self.arrays]
        return sha256_bytes(canonical_json(facts))

    def job_key(self, shard: int) -> str:
        """SHA-256 of all that decides the bytes of one shard."""
        return sha256_bytes(f"{self.key} {shard}\n".encode())

    def shards_for(self, episodes: int) -> int:
        """How many shards hold that many episodes."""
        return -(-episodes // self.episodes_per_shard)

    def episodes_of(self, shard: int) -> range:
        """The episodes of a shard, which is always full."""
        return range(shard * self.episodes_per_shard, (shard + 1) * self.episodes_per_shard)

    @property
    def row_bytes(self) -> int:
        """Bytes of one row of an episode before compression: of all arrays that have a value for each step."""
        return sum(spec.step_bytes for spec in self.arrays if spec.steps)

    def array(self, name: str) -> ArraySpec:
        """The spec of one of its arrays, by the reader's name."""
        return next(spec for spec in self.arrays if spec.name == name)

    def file_path(self, spec: ArraySpec, shard: int) -> str:
        """Path in the release of an array's file of a shard."""
        zeros = len(spec.shape) + spec.steps
        return f"{self.group}/{spec.stored_name}/c/{'/'.join([str(shard), *['0'] * zeros])}"


class ShardFile(_Model):
    """The file of one array in a shard: its size in bytes and its SHA-256."""

    bytes: int = pydantic.Field(gt=0, le=MAX_SHARD_BYTES)
    sha256: Digest

    def at(self, path: str) -> FileRecord:
        """The same file at its path in the release."""
        return FileRecord(path=path, bytes=self.bytes, sha256=self.sha256)


class ShardRecord(_Model):
    """A shard exists if and only if its record does.

    Attributes:
      key: job key, see `Layer.job_key`.
      files: array name -> file; an array that is left out has nothing but fill values in this shard.
    """

    key: Digest
    files: dict[RelativePath, ShardFile]


class LayerList(_Model):
    """All records of a layer, in the order of its shards."""

    shards: tuple[ShardRecord, ...] = pydantic.Field(max_length=MAX_SHARDS)


class ListedLayer(Layer):
    """A layer of a finished release.

    Attributes:
      shards: how many there are.
      list: SHA-256 of the list of its records, `layers/<sha>.json`.
    """

    shards: int = pydantic.Field(gt=0, le=MAX_SHARDS)
    list: Digest


# -- subsets, recipes, manifest -------------------------------------------------------------------


class PolicyRecord(_Model):
    """A behaviour policy of a subset: where the release keeps a copy, and what it is."""

    name: Line
    digest: Line
    path: RelativePath | None = None
    header: dict[str, Any] = {}


@pydantic.with_config(pydantic.ConfigDict(extra="forbid"))
class _ShownVideos(TypedDict):
    """The videos of a subset: "builtin" or the release's folder of them, their split, SHA-256 of their frames."""

    source: RelativePath
    split: Literal["train", "val"]
    digest: Digest


ShownVideos = Annotated[
    dict[str, Any], pydantic.GetPydanticSchema(lambda _, handler: handler.generate_schema(_ShownVideos))
]


class SubsetRecord(_Model):
    """One subset: the episodes of a task and level under one setting.

    Attributes:
      layers: names of its layers: trajectories, labels (none of imported subsets), then images.
      size: pixels a side of its own images.
      family: family of its task, "locomotion" or "ant-maze".
      views: names of the images of a frame, in the order in which policies see them.
      hidden_goal: True if the images that the subset is about have no goal in them (both kinds may be stored).
      max_steps: transitions at which the time limit ends an episode.
      action_repeat: control steps that an action is held.
      seconds_per_step: simulated time of one transition.
      fixed_goals, episodes_per_goal: pairs of start and goal, and the episodes of each; None if drawn an episode.
      split: the videos and styles that it was rendered with, "train" or "val".
      only_shown: whether only the images that the subset is about are stored.
      joints, actuators: names in the model, in the order of the physics state's positions and of the actions.
      return_range: (random, expert): returns that normalize scores to 0 and 100; None if unknown.
    """

    name: RelativePath
    task: Line
    level: PlainName
    setting: PlainName
    episodes: int = pydantic.Field(gt=0, le=MAX_EPISODES)
    layers: tuple[RelativePath, ...] = pydantic.Field(min_length=1, max_length=1000)
    size: int = pydantic.Field(gt=0, le=MAX_SIZE)
    deterministic: bool = False
    policies: tuple[PolicyRecord, ...] = ()
    renderer: dict[PlainName, Line | bool | int | float | None] = {}
    backgrounds: ShownVideos | None = None
    family: PlainName = LOCOMOTION
    views: tuple[PlainName, ...] = pydantic.Field(default=("pixels",), min_length=1, max_length=100)
    hidden_goal: bool = False
    max_steps: int = pydantic.Field(default=500, gt=0, le=MAX_STEPS)
    action_repeat: int = pydantic.Field(default=2, gt=0, le=1000)
    seconds_per_step: float = pydantic.Field(default=0.05, gt=0)
    fixed_goals: int | None = pydantic.Field(default=None, gt=0, le=MAX_EPISODES)
    episodes_per_goal: int | None = pydantic.Field(default=None, gt=0, le=MAX_EPISODES)
    split: Literal["train", "val"] = "train"
    only_shown: bool = False
    joints: tuple[Line, ...] = ()
    actuators: tuple[Line, ...] = ()
    return_range: tuple[float, float] | None = None

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
        return parse_setting(self.task, self.setting)[0]

    @property
    def goal_mode(self) -> GoalMode | None:
        """Treatment of a maze's goal; None for tasks without one."""
        return parse_setting(self.task, self.setting)[1] if is_maze(self.task) else None

    @property
    def imported(self) -> bool:
        """Whether it came from DMC-VB's published data: nothing of it can be simulated or rendered again."""
        return self.renderer.get("name") == IMPORTED


def _check_unique(names: Collection[str], what: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name.casefold() in seen:
            raise ValueError(f"{what}: {name!r} appears twice (case is ignored)")
        seen.add(name.casefold())


SAID = ("name", "version", "license", "authors", "description")
"""What a recipe and a manifest say of a release for people."""


class _Described(_Model):
    """What recipes and manifests share."""

    schema_version: Literal[3] = 3
    name: PlainName
    version: PlainName
    license: Line
    authors: tuple[Line, ...] = pydantic.Field(default=(), max_length=1000)
    description: str = pydantic.Field(default="", max_length=10_000)
    inputs: tuple[FileRecord, ...] = pydantic.Field(default=(), max_length=10**6)
    layers: tuple[Layer, ...] = pydantic.Field(max_length=MAX_SHARDS)
    subsets: tuple[SubsetRecord, ...] = pydantic.Field(max_length=MAX_SHARDS)

    @pydantic.field_validator("inputs")
    @classmethod
    def _in_their_folders(cls, inputs: tuple[FileRecord, ...]) -> tuple[FileRecord, ...]:
        if strange := [file.path for file in inputs if not file.path.startswith((POLICIES, VIDEOS))]:
            raise ValueError(f"{strange[0]} is no policy and no video")
        return inputs

    @pydantic.model_validator(mode="after")
    def _one_tree(self) -> Self:
        named = {layer.name: layer for layer in self.layers}
        _check_unique([subset.name for subset in self.subsets], "subsets")
        _check_unique([layer.name for layer in self.layers], "layers")
        places = [f"{layer.group}/{spec.stored_name}" for layer in named.values() for spec in layer.arrays]
        _check_unique(places, "arrays")
        for subset in self.subsets:
            if lacking := [name for name in subset.layers if name not in named]:
                raise ValueError(f"{subset.name} names layer {lacking[0]}, which is not described")
            kinds = [named[name].kind for name in subset.layers]
            if kinds[0] != "trajectories":
                raise ValueError(f"the first layer of {subset.name} holds no trajectories")
            if not subset.imported and (kinds[1:2] != ["labels"] or "name" not in subset.renderer):
                raise ValueError(f"{subset.name} has no labels, or no renderer")
        return self

    @property
    def imported(self) -> bool:
        """True if any of its subsets was imported, see `SubsetRecord.imported`."""
        return any(record.imported for record in self.subsets)


class Resolved(_Described):
    """A resolved recipe, `recipes/<sha>.json`: what a release was asked to be, on any machine.

    Attributes:
      recipe: the recipe as it was given, without paths of the machine.
      inputs: policies and videos that the release keeps copies of.
      derived: for a release made from another one (repaint, import): its name, version and digest.
    """

    format: Literal["dmcvb-gen recipe"] = "dmcvb-gen recipe"
    recipe: dict[str, Any] = {}
    derived: dict[str, Any] | None = None

    @functools.cached_property
    def sha256(self) -> str:
        """SHA-256 of its canonical JSON, its name in `recipes/`."""
        return sha256_bytes(canonical_json(self))


class Manifest(_Described):
    """The release's manifest.json.

    Attributes:
      recipes: SHA-256 of the recipes that its subsets come from, in order.
      inputs: policies and videos that the release keeps copies of.
    """

    format: Literal["dmcvb-gen release"] = "dmcvb-gen release"
    recipes: tuple[Digest, ...] = pydantic.Field(max_length=10_000)
    layers: tuple[ListedLayer, ...] = pydantic.Field(max_length=MAX_SHARDS)

    @pydantic.model_validator(mode="after")
    def _whole(self) -> Manifest:
        named = {layer.name: layer for layer in self.layers}
        for subset in self.subsets:
            for layer in (named[name] for name in subset.layers):
                if layer.kind != "images" and layer.shards * layer.episodes_per_shard < subset.episodes:
                    raise ValueError(f"{layer.name} has fewer episodes than {subset.name}")
        if sum(subset.episodes for subset in self.subsets) > MAX_EPISODES:
            raise ValueError(f"it has more episodes than the {MAX_EPISODES:,} that a release may have")
        if sum(layer.shards for layer in self.layers) > 10 * MAX_SHARDS:
            raise ValueError(f"it has more shards than the {10 * MAX_SHARDS:,} that a release may have")
        return self


class Copy(_Model):
    """copy.json of a release that holds a part of another one.

    Attributes:
      manifest: SHA-256 of the manifest that it was copied from, which is the manifest here.
      source: where it was copied from, without passwords.
      promised: layer -> runs (first, last + 1) of shards that were to be copied; a shard is here if its record is.
    """

    format: Literal["dmcvb-gen copy"] = "dmcvb-gen copy"
    manifest: Digest
    source: Line = ""
    promised: dict[RelativePath, tuple[tuple[int, int], ...]] = {}

    @pydantic.model_validator(mode="after")
    def _bounded(self) -> Copy:
        for layer, each in self.promised.items():
            bounds = [number for run in each for number in run]
            if bounds != sorted({*bounds}) or bounds and not 0 <= bounds[0] <= bounds[-1] <= MAX_SHARDS:
                raise ValueError(f"the shards of {layer} are not runs of numbers in order")
        if sum(last - first for each in self.promised.values() for first, last in each) > 10 * MAX_SHARDS:
            raise ValueError(f"it has more shards than the {10 * MAX_SHARDS:,} that a release may have")
        return self

    def shards(self, layer: str) -> frozenset[int]:
        """Numbers of the shards of a layer that were to be copied."""
        return frozenset(number for run in self.promised.get(layer, ()) for number in range(*run))


def runs(numbers: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """Numbers as runs (first, last + 1), in order."""
    each = np.array(sorted(numbers), int)
    parts = np.split(each, np.flatnonzero(np.diff(each) != 1) + 1)
    return tuple((int(part[0]), int(part[-1]) + 1) for part in parts if len(part))


# -- JSON -----------------------------------------------------------------------------------------


def canonical_json(value: Any) -> bytes:
    """The bytes of a value (plain, or a model) of which its SHA-256 is taken: sorted keys, no spaces, a newline."""
    if isinstance(value, pydantic.BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


Parsed = TypeVar("Parsed", bound=pydantic.BaseModel)


def parse(model: type[Parsed], text: bytes, where: str) -> Parsed:
    """A model from canonical JSON.

    Raises:
      StoreError: not JSON, not canonical, not such a model, or of another schema version.
    """
    try:
        data = parse_json(text)
    except ValueError as error:
        raise StoreError(f"{where} is not JSON ({error}); remove it and fetch again, or make a new one") from None
    try:
        found = model.model_validate(data)
    except pydantic.ValidationError as error:
        first = min(error.errors(), key=lambda one: one["loc"] != ("schema_version",))  # which tells the most
        place, cure = ".".join(map(str, first["loc"])) or "the top", "fetch it again, or install the dmcvb-gen of it"
        raise StoreError(f"{where} is not valid at {place}: {first['msg']}; {cure}") from None
    with contextlib.suppress(ValueError):  # of a number without end
        if canonical_json(data) == text:
            return found
    raise StoreError(f"{where} was not written by dmcvb-gen, or changed since; fetch it again, or make a new one")


@contextlib.contextmanager
def describable() -> Iterator[None]:
    """Raises DmcvbError, in one line, for what no release may be made of."""
    try:
        yield
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or error.title
        raise DmcvbError(f"{field} is not as a release may have it: {first['msg']}; change it") from None


def record_path(layer: str, shard: int) -> str:
    """Path of a shard's record inside the release."""
    return f"{RECORDS}{layer}/{shard:05d}.json"


def list_path(digest: str) -> str:
    """Path of a layer's list inside the release."""
    return f"{LAYERS}{digest}.json"


def is_attachment(path: str) -> bool:
    """Return True if a path is one of the card's files, which are copied as data and lie outside of the tree."""
    return path in ATTACHMENT_FILES or bool(re.fullmatch(rf"{CARD_FOLDER}[A-Za-z0-9_][A-Za-z0-9_.+-]{{0,200}}", path))


def list_bytes_limit(layer: ListedLayer) -> int:
    """The largest list that a layer can have."""
    return min(1000 + layer.shards * record_bytes_limit(layer), MAX_LIST_BYTES)


def record_bytes_limit(layer: Layer) -> int:
    """The largest record that a shard of a layer can have."""
    return 1000 + sum(len(spec.name) + 130 for spec in layer.arrays)


def check_record(record: ShardRecord, layer: Layer, shard: int, where: str) -> ShardRecord:
    """Return a record that is the shard's.

    Raises:
      StoreError: it was made by another job, or names arrays that the layer does not have.
    """
    key = layer.job_key(shard)
    if record.key != key:
        raise StoreError(
            f"{where} is of another job ({record.key[:12]}) than this release's ({key[:12]}): something that decides "
            "its bytes differs; choose another place for the new one"
        )
    if strange := set(record.files) - {spec.name for spec in layer.arrays}:
        raise StoreError(f"{where} names array {min(strange)}, which {layer.name} does not have")
    return record


# -- the manifest of recipes and records ----------------------------------------------------------


def merged_layers(recipes: Iterable[Resolved]) -> dict[str, Layer]:
    """All layers of recipes.

    Raises:
      StoreError: two of them describe one layer differently.
    """
    layers: dict[str, Layer] = {}
    for recipe in recipes:
        for layer in recipe.layers:
            there = layers.setdefault(layer.name, layer)
            if there != layer:
                raise StoreError(_difference(there, layer))
    return layers


def _difference(one: Layer, other: Layer) -> str:
    keys, fields = sorted({*one.makes, *other.makes}), ("episodes_per_shard", "rows", "group", "kind", "source")
    pairs = {key: (one.makes.get(key), other.makes.get(key)) for key in keys}
    pairs |= {name: (getattr(one, name), getattr(other, name)) for name in fields}
    pairs["arrays"] = (_arrays(one, other), _arrays(other, one))
    differing = [(name, *pair) for name, pair in pairs.items() if pair[0] != pair[1]]
    field, first, second = differing[0] if differing else ("arrays", "one form", "another form of the same arrays")
    if field == "rows":
        had, asked = one.rows - 1, other.rows - 1
        return f"{one.name} has --max-steps {had}, asked for {asked}; give it too, or choose another --out"
    if field == "code":
        return f"the code of your own behind {one.name} has changed since; choose another --out"
    images = field == "arrays" and other.kind == "images"
    paint = f"add these images with `paint --size {other.arrays[0].shape[0]}`, or " if images else ""
    return f"{one.name} has {field} {shortened(first)}, asked for {shortened(second)}; {paint}choose another --out"


def _arrays(one: Layer, other: Layer) -> str:
    """The arrays of a layer that another one lacks or has in another form."""
    mine = [spec for spec in one.arrays if spec not in other.arrays]
    return ", ".join(f"{spec.name} of {spec.dtype} {list(spec.shape)}" for spec in mine) or "no others"


def shortened(value: Any) -> str:
    """A value for a message, cut after 80 characters."""
    text = str(value)
    return text if len(text) < 80 else text[:77] + "..."


def build_manifest(
    recipes: Iterable[Resolved], lists: Mapping[str, tuple[ShardRecord, ...]]
) -> tuple[Manifest, dict[str, LayerList]] | None:
    """The manifest of recipes and records: of each subset the largest count asked for whose shards all exist.

    Args:
      recipes: in any order; the result is the same.
      lists: layer -> its records from the first shard on, up to the first gap.

    Returns:
      The manifest and the lists that it names by their SHA-256; None if no subset is whole.

    Raises:
      StoreError: recipes contradict one another.
    """
    recipes = sorted(recipes, key=lambda recipe: recipe.sha256)
    layers = merged_layers(recipes)
    whole = [(recipe, subset) for recipe in recipes for subset in recipe.subsets if _is_whole(subset, layers, lists)]
    if not whole:
        return None
    subsets = merged_subsets(subset for _, subset in whole)
    needed: dict[str, int] = {}
    for subset in subsets.values():
        for name in subset.layers:
            needed[name] = max(needed.get(name, 0), layers[name].shards_for(subset.episodes))
    made = {name: LayerList(shards=lists[name][:count]) for name, count in sorted(needed.items())}
    used = _without_needless(whole)
    newest = max(used, key=lambda recipe: (_version_key(recipe.version), recipe.name, recipe.sha256))
    inputs = {file.path: file for recipe in used for file in recipe.inputs}
    manifest = Manifest(
        **{name: getattr(newest, name) for name in SAID},
        recipes=tuple(recipe.sha256 for recipe in used),
        inputs=tuple(inputs[path] for path in sorted(inputs)),
        layers=tuple(
            ListedLayer(**layer_facts(layers[name]), shards=len(each.shards), list=sha256_bytes(canonical_json(each)))
            for name, each in made.items()
        ),
        subsets=tuple(subsets[name] for name in sorted(subsets)),
    )
    return manifest, made


def _without_needless(whole: Iterable[tuple[Resolved, SubsetRecord]]) -> list[Resolved]:
    """The recipes of whole subsets, without those that others make needless: asking for less changes no manifest."""
    asked: dict[str, tuple[Resolved, list[SubsetRecord]]] = {}
    for recipe, subset in whole:
        asked.setdefault(recipe.sha256, (recipe, []))[1].append(subset)
    for digest, (recipe, subsets) in sorted(asked.items()):
        covering: dict[str, list[SubsetRecord]] = {}
        for sha256, (other, theirs) in asked.items():
            if sha256 != digest and _can_stand_for(other, recipe):
                for subset in theirs:
                    covering.setdefault(subset.name, []).append(subset)
        if all(any(_merged(more, one) == more for more in covering.get(one.name, ())) for one in subsets):
            del asked[digest]
    return [recipe for recipe, _ in asked.values()]


def _can_stand_for(other: Resolved, recipe: Resolved) -> bool:
    """Return True if a recipe says all that another one does; one that `paint` made names no policies."""
    same = all(getattr(other, name) == getattr(recipe, name) for name in ("derived", *SAID))
    return same and (bool(other.recipe) or not recipe.recipe)


def layer_facts(layer: Layer) -> dict[str, Any]:
    """The fields of a layer, without what a finished release says of it."""
    return {name: getattr(layer, name) for name in Layer.model_fields}


def _is_whole(subset: SubsetRecord, layers: Mapping[str, Layer], lists: Mapping[str, tuple[ShardRecord, ...]]) -> bool:
    return all(len(lists.get(name, ())) >= layers[name].shards_for(subset.episodes) for name in subset.layers)


def merged_subsets(records: Iterable[SubsetRecord]) -> dict[str, SubsetRecord]:
    """All subsets of recipes, by name; one that several ask for has the most episodes and the layers of all.

    Raises:
      StoreError: two descriptions of one subset differ in anything else.
    """
    subsets: dict[str, SubsetRecord] = {}
    for record in records:
        there = subsets.get(record.name)
        subsets[record.name] = record if there is None else _merged(there, record)
    return subsets


def _merged(one: SubsetRecord, other: SubsetRecord) -> SubsetRecord:
    for field in SubsetRecord.model_fields:
        first, second = getattr(one, field), getattr(other, field)
        if field not in ("episodes", "layers") and first != second:
            raise StoreError(
                f"{one.name} has {field} {shortened(first)}, asked for {shortened(second)}; choose another --out"
            )
    layers = tuple(sorted({*one.layers, *other.layers}, key=layer_order))
    return one.model_copy(update={"episodes": max(one.episodes, other.episodes), "layers": layers})


def layer_order(name: str) -> tuple[int, str]:
    """The key by which the layers of a subset are in order: trajectories, labels, then images by name."""
    last = name.rsplit("/", 1)[-1]
    return {"trajectories": 0, "labels": 1}.get(last, 2), name


def _version_key(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version))


def shard_size(episodes: int, most: int) -> int:
    """Episodes a shard, so that shards are nearly equal and every one is full: ceil(n / ceil(n / most))."""
    return -(-episodes // -(-episodes // most))
