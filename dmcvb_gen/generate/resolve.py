"""Resolve a recipe: names, policies, videos and the renderer go in; layers and subsets come out, true on any machine.

::

    walker-walk/expert/trajectories      of all settings of a task and level, if they share their episodes
    walker-walk/expert/dynamic/labels    of one setting, drawn for those trajectories
    walker-walk/expert/dynamic/pixels    of one image array, rendered from both

Each layer names in `makes` what decides its bytes. No episode is made here, but renderers are started: what cannot work
is said before hours are spent.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import (
    POLICIES,
    SAID,
    VIDEOS,
    ArraySpec,
    FileRecord,
    Layer,
    PolicyRecord,
    Resolved,
    SubsetRecord,
    describable,
    shard_size,
)
from dmcvb_gen.dataset.pictures import picture_arrays, view_arrays
from dmcvb_gen.dataset.schema import image_array, label_arrays, trajectory_arrays
from dmcvb_gen.dataset.writer import file_facts
from dmcvb_gen.distractor_state import OPTIONAL_LABELS
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.distractors.registry import BUILT_IN, distractors_of
from dmcvb_gen.errors import BackgroundError, RecipeError, StoreError
from dmcvb_gen.generate.inputs import BUILTIN
from dmcvb_gen.generate.modalities import get_modality
from dmcvb_gen.generate.recipe import DEFAULT_EPISODES_PER_SHARD, NATIVE, Recipe, SubsetRequest, expand
from dmcvb_gen.generate.render import renderer_for
from dmcvb_gen.generate.renderer_choice import default_renderer
from dmcvb_gen.own_code import is_own, source_digest
from dmcvb_gen.policies.bundled import check_level, resolve_policies
from dmcvb_gen.policies.header import OWN_CODE, PolicyHeader
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.spec import SPLITS, DistractorSetting, SubsetSpec, is_maze
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import as_maze, fixed_pairs
from dmcvb_gen.tasks.base import Task
from dmcvb_gen.tasks.environment import model_digest
from dmcvb_gen.text import pluralize

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Resolution:
    """A resolved recipe.

    Attributes:
      resolved: the recipe, its layers and subsets; it names no place of this machine.
      files: path in the release -> file here, of the policies and videos that the release keeps copies of.
    """

    resolved: Resolved
    files: Mapping[str, Path] = field(default_factory=dict)


@describable()
def resolve(recipe: Recipe, there: Release | None = None, pixels: bool = True) -> Resolution:
    """Resolve a recipe.

    Args:
      there: the release that it is to be a part of; its shards keep their size.
      pixels: store images; without, `generate.paint` can add them later.

    Raises:
      DmcvbError: a name, a policy, the videos or the renderer cannot be used.
    """
    requests = expand(recipe)
    recipe = with_renderer(recipe, requests, there)
    sets: dict[str, list[SubsetRequest]] = {}
    for request in requests:
        alone = recipe.trajectories == "independent" or is_maze(request.task)  # mazes have both kinds of images
        sets.setdefault(request.name if alone else request.name.rpartition("/")[0], []).append(request)
    looks: dict[tuple, dict[str, Any]] = {}
    files: dict[str, Path] = {}
    layers: dict[str, Layer] = {}
    subsets: list[SubsetRecord] = []
    policies: dict[tuple[str, str], dict[str, None]] = {}
    for name, members in sets.items():
        per_shard = _episodes_per_shard(name, members, there)
        for request in members:
            found = request.level != "random" and resolve_policies(request.task, request.level, request.policy) or []
            record = _record(recipe, request, found)
            kept = dict.fromkeys(policy.path or policy.name for policy in record.policies)
            given = (request.policy or "", request.level)
            policies[given] = policies.get(given, {}) | kept
            files |= {p.path: path for p, path in zip(record.policies, found, strict=True) if p.path}
            look = (record.task, record.distractor)
            if look not in looks:
                looks[look] = rendering_facts(record, recipe.backgrounds)
                files |= video_files(looks[look]["backgrounds"], recipe.backgrounds)
            record = record.model_copy(update=looks[look])
            made = _layers(recipe, record, name, per_shard, pixels)
            if layers.setdefault(made[0].name, made[0]) != made[0]:
                raise RecipeError(
                    f"settings of {name} share their episodes, so they need the same policies, max_steps and "
                    "deterministic; make them alike, or write trajectories: independent"
                )
            layers |= {layer.name: layer for layer in made[1:]}
            subsets.append(record.model_copy(update={"layers": tuple(layer.name for layer in made)}))
    _tell_of_held_actions(recipe, subsets)
    resolved = Resolved(
        **{name: getattr(recipe, name) for name in SAID},
        recipe=_without_local_paths(recipe, policies, subsets),
        inputs=file_records(files),
        layers=tuple(layers.values()),
        subsets=tuple(subsets),
    )
    return Resolution(resolved, files)


def with_renderer(recipe: Recipe, requests: Iterable[SubsetRequest], there: Release | None) -> Recipe:
    """The recipe with a renderer: its own, else that of a release that was begun, else what draws its tasks best."""
    tasks = dict.fromkeys(request.task for request in requests)
    backend = recipe.renderer.backend
    if backend is None and there is not None:
        begun = (record for record in there.manifest.subsets if record.task in tasks and not record.imported)
        backend = next((str(record.renderer["name"]) for record in begun), None)
    if backend is None:
        chosen = [default_renderer(get_task(task)) for task in tasks]
        backend = next((name for name in chosen if name != NATIVE), NATIVE)
    return recipe.model_copy(update={"renderer": recipe.renderer.model_copy(update={"backend": backend})})


def file_records(files: Mapping[str, Path]) -> tuple[FileRecord, ...]:
    """Records of files of this machine, by their paths in the release."""
    return tuple(file_facts(files[path]).at(path) for path in sorted(files))


def _episodes_per_shard(name: str, members: Sequence[SubsetRequest], there: Release | None) -> int:
    asked = {request.episodes_per_shard for request in members if request.episodes_per_shard}
    if len(asked) > 1:
        raise RecipeError(f"settings of {name} share their shards; give them one episodes_per_shard")
    given = next(iter(asked), None)
    old = there.layers.get(f"{name}/trajectories") if there else None
    if old is not None:
        if given and given != old.episodes_per_shard:
            _log.warning(f"{name}: shards keep their {old.episodes_per_shard} episodes, as they were begun")
        return old.episodes_per_shard
    most = max(request.episodes for request in members)
    return min(given, most) if given else shard_size(most, DEFAULT_EPISODES_PER_SHARD[get_task(members[0].task).family])


# -- layers ---------------------------------------------------------------------------------------


def _layers(recipe: Recipe, record: SubsetRecord, name: str, per_shard: int, pixels: bool) -> list[Layer]:
    """The layers of a subset: trajectories, labels, images."""
    streams = [record.task, record.level] + ([record.setting] if name == record.name else [])
    makes = {
        "task": record.task,
        "code": code_of_task(record.task),
        "streams": streams,
        "seed": recipe.seed,
        "policies": [policy.digest for policy in record.policies],
        "deterministic": record.deterministic,
        "action_repeat": record.action_repeat,
        "fixed_goals": record.fixed_goals,
        "episodes_per_goal": record.episodes_per_goal,
    }
    trajectories = Layer(
        name=f"{name}/trajectories",
        group=f"{name}.zarr/trajectories",
        kind="trajectories",
        rows=record.max_steps + 1,
        episodes_per_shard=per_shard,
        arrays=trajectory_arrays(get_task(record.task)),
        makes=makes,
    )
    labels = labels_layer(record, trajectories)
    images = image_layers(record, labels, all_pictures(record)) if pixels else ()
    return [trajectories, labels, *images]


def labels_layer(record: SubsetRecord, trajectories: Layer) -> Layer:
    """The layer of a subset's labels, drawn for its trajectories."""
    code = code_of_distractor(record.distractor)
    return Layer(
        name=f"{record.name}/labels",
        group=f"{trajectories.group.rpartition('/')[0]}/{record.setting}",
        kind="labels",
        rows=trajectories.rows,
        episodes_per_shard=trajectories.episodes_per_shard,
        arrays=drawn_labels(record),
        makes={
            "of": trajectories.key,
            "distractor": record.distractor.name,
            "split": record.split,
            "videos": (record.backgrounds or {}).get("digest"),
            **({"code": code} if code else {}),
        },
    )


def code_of_task(task: str) -> str:
    """The digest of the file and the model of a task of one's own, else ""."""
    if not is_own(task):
        return ""
    model = model_digest(get_task(task).model)  # which imports the file
    return hashlib.sha256((source_digest(task.partition(":")[0]) + model).encode()).hexdigest()


def check_code(name: str, makes: Mapping[str, Any], now: Any) -> None:
    """Raises StoreError if the code of one's own that a layer was begun with is another one now."""
    if makes.get("code", now) != now:
        raise StoreError(
            f"the code of {name} has changed since the release was begun; put the old file back, or roll out another "
            "release"
        )


def check_task_code(task: str, trajectories: Layer) -> None:
    """Raises StoreError if a task of one's own is not the one that made these trajectories."""
    check_code(task, trajectories.makes, code_of_task(task))


def code_of_distractor(setting: DistractorSetting) -> list[str]:
    """Digests of the files of distractors of one's own that vary under a setting."""
    return [source_digest(part.__module__) for part in distractors_of(setting) if part not in BUILT_IN]


def drawn_labels(record: SubsetRecord) -> tuple[ArraySpec, ...]:
    """The arrays of the labels that a subset's distractors draw."""
    varying = [part for part in OPTIONAL_LABELS.values() if record.distractor.varies(part)]
    return label_arrays(get_task(record.task), varying)


def all_pictures(record: SubsetRecord) -> tuple[str, ...]:
    """Names of all RGB images of a subset: of every view, with the goal and, if the task has one, without it."""
    hidden = picture_arrays(record.views, hide_goal=True) if get_task(record.task).goal_geoms else ()
    return (*picture_arrays(record.views), *hidden)


def image_layers(
    record: SubsetRecord, labels: Layer, pictures: Iterable[str], size: int | None = None
) -> Iterator[Layer]:
    """The layers of RGB images of a subset.

    Args:
      pictures: their names, "pixels" or "pixels/top".
      size: pixels a side; the subset's own by default.
    """
    for name in pictures:
        spec = image_array(name, size or record.size, record.spec.camera_moves, labels.rows, own_size=record.size)
        makes = {"of": labels.key, "renderer": record.renderer}
        yield _above(record, labels, spec, makes)


def modality_layers(record: SubsetRecord, labels: Layer, modalities: Iterable[str]) -> Iterator[Layer]:
    """The layers of modalities of a subset's images: "depth", or "depth/<view>" if its task has several views."""
    for modality in map(get_modality, modalities):
        axes = [f"{modality.name}_{axis}" for axis in range(len(modality.shape))]
        dims = ["direction"] if modality.name == "flow" else axes
        makes: dict[str, Any] = {"of": labels.key, "renderer": record.renderer}
        makes |= {"modality": modality.name, "hidden_goal": record.hidden_goal}
        for name in view_arrays(modality.name, record.views):
            facts: dict[str, Any] = dict(dtype=modality.dtype, shape=modality.shape, dims=dims)
            yield _above(record, labels, image_array(name, record.size, False, labels.rows, **facts), makes)


def _above(record: SubsetRecord, labels: Layer, spec: Any, makes: dict[str, Any]) -> Layer:
    return Layer(
        name=f"{record.name}/{spec.stored_name}",
        group=labels.group,
        kind="images",
        rows=labels.rows,
        episodes_per_shard=labels.episodes_per_shard,
        arrays=(spec,),
        makes=makes,
    )


# -- subsets --------------------------------------------------------------------------------------


def _record(recipe: Recipe, request: SubsetRequest, files: Sequence[Path]) -> SubsetRecord:
    """A subset's entry in the manifest, without the facts of its renderer and its layers."""
    task = get_task(request.task).at(recipe.action_repeat)
    goals = request.episodes_per_goal and request.episodes // request.episodes_per_goal
    if goals:
        fixed_pairs(as_maze(task).layout, goals, recipe.seed)
    model = task.model
    return SubsetRecord(
        **request.model_dump(exclude={"episodes_per_shard", "policy"}),
        layers=("none-yet",),
        size=recipe.size,
        policies=tuple(_policy_record(path, task, request) for path in files),
        renderer={"name": recipe.renderer.backend, "samples": recipe.renderer.samples},
        family=task.family,
        views=tuple(task.views),
        hidden_goal=bool(task.goal_geoms) and SubsetSpec.parse(request.task, request.level, request.setting).hides_goal,
        action_repeat=recipe.action_repeat,
        seconds_per_step=task.seconds_per_step,
        fixed_goals=goals,
        split=recipe.split,
        joints=tuple(model.joint(number).name for number in range(model.njnt)),
        actuators=tuple(model.actuator(n).name for n in range(model.nu)) if model.nu == task.action_size else (),
    )


def _tell_of_held_actions(recipe: Recipe, subsets: Iterable[SubsetRecord]) -> None:
    """Log a line for policies that act more rarely than in their training."""
    headers = {policy.name: policy.header for record in subsets for policy in record.policies}
    for name, header in headers.items():
        trained = PolicyHeader.model_validate(header).acts_every
        if trained and trained < recipe.action_repeat:
            _log.warning(
                f"{name} was trained at action repeat {trained}, and its actions are held for {recipe.action_repeat} "
                "control steps; expect lower returns"
            )


def _policy_record(path: Path, task: Task, asked: SubsetRequest) -> PolicyRecord:
    policy = load_policy(path, task, sample=not asked.deterministic)
    check_level(path, policy.header, asked.level)
    header = policy.header.model_dump(mode="json")
    header["training"].pop("curve", None)  # long, and in the policy's file
    if policy.header.algorithm == OWN_CODE:
        return PolicyRecord(name=str(path), digest=policy.digest, header=header)
    copy = f"{POLICIES}{policy.digest[:16]}.safetensors"
    return PolicyRecord(name=path.stem, digest=policy.digest, path=copy, header=header)


def rendering_facts(record: SubsetRecord, backgrounds: str) -> dict[str, Any]:
    """`renderer` and `backgrounds` of a subset's record, from a renderer that was started for it.

    Raises:
      DmcvbError: the videos or the renderer cannot be used.
    """
    renderer, videos = renderer_for(record, backgrounds)
    facts = {name: value for name, value in renderer.describe().items() if name != "mujoco"}  # provenance has it
    renderer.close()
    shown = None
    if videos and (asked := record.distractor.videos or 0) > len(videos):
        name, there = record.distractor.name, pluralize(len(videos), "videos")
        _log.warning(f"{name} shows {there}, not {asked}: {backgrounds} has no more for split {record.split}")
    if videos:
        source = BUILTIN if backgrounds == BUILTIN else f"{VIDEOS}{videos.digest[:16]}"
        shown = {"source": source, "split": record.split, "digest": videos.digest}
    return {"renderer": {"name": record.renderer["name"], **facts}, "backgrounds": shown}


def video_files(shown: Mapping[str, Any] | None, source: str) -> dict[str, Path]:
    """Path in the release -> file of videos that the package does not bring, numbered in order, of both splits."""
    found: dict[str, Path] = {}
    if shown is None or shown["source"] == BUILTIN:
        return found
    for split in SPLITS:
        try:
            videos = load_backgrounds(source, split).files
        except BackgroundError:
            continue  # the split that images show was opened before; another may not be there
        for video, files in enumerate(videos):
            for frame, file in enumerate(files):
                name = f"{video:05d}" if len(files) == 1 else f"{video:05d}/{frame:05d}"
                found[f"{shown['source']}/{split}/{name}{file.suffix.lower()}"] = file
    return found


def _without_local_paths(
    recipe: Recipe, policies: Mapping[tuple[str, str], Iterable[str]], subsets: Iterable[SubsetRecord]
) -> dict[str, Any]:
    """The recipe as the release keeps it: files and folders of this machine go by the release's copies."""
    data = recipe.model_dump(mode="json")
    for pattern in data["subsets"]:
        pattern["policies"] = {level: ",".join(policies[given, level]) for level, given in pattern["policies"].items()}
    shown = {record.backgrounds["source"] for record in subsets if record.backgrounds}
    data["backgrounds"] = shown.pop() if shown else BUILTIN
    return data
