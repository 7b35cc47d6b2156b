"""Import DMC-VB's published TFDS folders (RLDS episodes) into a release of the usual layout.

The published data hold pixels, states, actions and rewards, but neither physics states nor distractor labels: an
imported release can be read, checked and trained on, but not repainted or regenerated. Nothing needs TensorFlow.
"""

import contextlib
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from dmcvb_gen.dataset.gate import Release, recorded_shards
from dmcvb_gen.dataset.manifest import IMPORTED, MAX_STEPS, Layer, Resolved, SubsetRecord, check_name, shard_size
from dmcvb_gen.dataset.pictures import picture_arrays
from dmcvb_gen.dataset.schema import image_array, trajectory_arrays
from dmcvb_gen.dataset.writer import begin, finish, put_shard, write_provenance
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.files import parse_json, sha256_bytes, sha256_file
from dmcvb_gen.generate.recipe import DEFAULT_EPISODES_PER_SHARD
from dmcvb_gen.options import Local, Location, checked, progress_bar
from dmcvb_gen.parallel import ProgressCallback
from dmcvb_gen.release.dmcvb_names import parse_folder, picture_feature, state_feature
from dmcvb_gen.release.tfrecord import offsets, read_example
from dmcvb_gen.rendering.base import MAX_SIZE
from dmcvb_gen.spec import FIXED, LEVELS, SubsetSpec
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.tasks import ACTION_REPEAT, get_task
from dmcvb_gen.tasks.base import Task

ORIGIN = "DMC-VB (Ortiz et al., NeurIPS 2024), TFDS folders"
MAX_GOAL_PAIRS = 2**15
"""Pairs of start and goal that the stored numbers (int16) can tell apart."""


class Place(NamedTuple):
    """Location of an episode: the number of its folder, its file, and its bytes there."""

    folder: int
    file: Path
    offset: int
    length: int

    def read(self) -> dict[str, Any]:
        """The features of the episode; see `read_example`."""
        return read_example(self.file, self.offset, self.length)


@dataclass(frozen=True)
class _Source:
    """The record of a subset, its folders, and its episodes; DMC-VB has a folder for each fixed goal."""

    record: SubsetRecord
    folders: tuple[Path, ...]
    episodes: tuple[Place, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """What its data come from: names and sizes of files in the order of their episodes, and their features."""
        files = [
            f"{n}/{file.name} {file.stat().st_size}" for n, path in enumerate(self.folders) for file in _files(path)
        ]
        features = sha256_file(self.folders[0] / "features.json")
        facts = {"files": len(files), "names": sha256_bytes("\n".join(files).encode()), "features": features}
        seed = _metadata(self.folders[0])[1]
        return facts if seed is None else facts | {"seed": seed}


@checked
def import_tfds(
    folder: Location,
    out: Local,
    *,
    task: str | None = None,
    level: str | None = None,
    setting: str | None = None,
    name: str = "dmc-vb-original",
    partial: bool = False,
    progress: bool = True,
) -> Release:
    """Import subsets of locomotion and of mazes. Run again, it resumes.

    Episodes are numbered by the order of their files, so a release of other files is another one.

    Args:
      folder (FOLDER): A TFDS folder (with features.json), or a tree of DMC-VB's folders that hold such.
      out (FOLDER): Folder of the new release.
      task: Task of a folder whose path does not name it.
      level: Level of such a folder.
      setting: Setting of such a folder: none, static_medium, dynamic_medium, ...
      name: Name of the new release.
      partial: Import the files found, even if some are missing.

    Raises:
      StoreError: there is no TFDS folder, it is damaged, lacks files or has other features, or `out` cannot be used.
    """
    check_name(name)
    target = local_path(out)
    found = sorted(path.parent for path in Path(folder).rglob("features.json"))
    if not found:
        raise StoreError(f"{folder} holds no TFDS folder (no features.json); give the folder of a data set")
    if len(found) > 1 and (task or level or setting):
        raise StoreError(
            f"{folder} holds {len(found)} data sets; give the folder of one with --task, --level, --setting"
        )
    if not partial:
        for path in found:
            _refuse_missing(path)
    sources = list(_sources(found, task, level, setting))
    store, layers = open_store(target), [[*_layers(source)] for source in sources]
    records = [
        source.record.model_copy(update={"layers": tuple(layer.name for layer in own)})
        for source, own in zip(sources, layers, strict=True)
    ]
    resolved = Resolved(
        name=name,
        version="1.0.0",
        license="CC-BY-4.0",
        recipe={"name": name, "imported": sorted(record.name for record in records)},
        layers=tuple(layer for own in layers for layer in own),
        subsets=tuple(records),
        derived={"kind": "import", "name": ORIGIN},
    )
    begin(store, resolved, {})
    write_provenance(store, "import")
    with progress_bar(progress, " episodes", scaled=False) as bar:
        bar.expect(sum(record.episodes for record in records))
        for source, own in zip(sources, layers, strict=True):
            _import_subset(source, own, store, bar)
    return finish(store)


def _layers(source: _Source) -> Iterator[Layer]:
    """The layers of an imported subset: trajectories, then the images of each view, with the goal or without it."""
    record, facts = source.record, source.facts
    rows, per_shard = record.max_steps + 1, shard_size(record.episodes, DEFAULT_EPISODES_PER_SHARD[record.family])
    given: dict[str, Any] = dict(rows=rows, episodes_per_shard=per_shard, makes=facts, source=ORIGIN)
    arrays = tuple(spec for spec in trajectory_arrays(get_task(record.task)) if spec.name != "physics")
    group = f"{record.name}.zarr"
    simulated: dict[str, Any] = given | {"kind": "trajectories", "arrays": arrays}
    yield Layer(name=f"{record.name}/trajectories", group=f"{group}/trajectories", **simulated)
    for name in picture_arrays(record.views, record.hidden_goal):
        spec = image_array(name, record.size, record.spec.camera_moves, rows)
        place = f"{record.name}/{spec.stored_name}"
        yield Layer(name=place, group=f"{group}/{record.setting}", kind="images", arrays=(spec,), **given)


def _sources(found: list[Path], task, level, setting) -> Iterator[_Source]:
    """The subsets that folders hold; the folders of a maze's fixed goals, one a goal, are one subset."""
    grouped: dict[SubsetSpec, list[tuple[int, Path]]] = {}
    for path in found:
        spec, seed = _identify(path, task, level, setting)
        grouped.setdefault(spec, []).append((seed, path))
    for spec, members in grouped.items():
        folders = tuple(path for _, path in sorted(members))
        if len(folders) > 1 and spec.setting != FIXED:
            raise StoreError(f"{folders[1]} and {folders[0]} are both {spec.name}; import one of them")
        files = [(goal, file) for goal, path in enumerate(folders) for file in _files(path)]
        places = tuple(Place(goal, file, *place) for goal, file in files for place in offsets(file))
        yield _Source(_record(spec, folders, places), folders, places)


def _identify(path: Path, task, level, setting) -> tuple[SubsetSpec, int]:
    """The subset that a folder holds, and of fixed goals the seed that its path names."""
    guess = parse_folder(path.parts) or ("", "", "", None)
    task, level, setting = task or guess[0], level or guess[1], setting or guess[2]
    try:
        get_task(task)
        return SubsetSpec.parse(task, level, setting), guess[3] or 0
    except UnknownNameError:
        if "-" in level and set(level.split("-")) <= set(LEVELS):
            raise StoreError(f"{path} unites levels; export each of them, and import those") from None
        raise StoreError(
            f"{path} does not say what it is by .../walker_walk/expert/static_medium, "
            ".../antmaze_random_hidden_goal/empty7x7/expert or .../antmaze_fixed_hidden_goal/empty7x7/<seed>; give "
            f"--task, --level ({', '.join(LEVELS)}) and --setting"
        ) from None


def _record(spec: SubsetSpec, folders: tuple[Path, ...], places: tuple[Place, ...]) -> SubsetRecord:
    repeat, _ = _metadata(folders[0])
    of, sizes = get_task(spec.task).at(repeat), _image_sizes(folders[0])
    images = {view: picture_feature(spec.task, view, spec.hides_goal) for view in of.views}
    views = tuple(view for view, image in images.items() if image in sizes)
    if not views:
        first = images[of.views[0]]
        raise StoreError(f"{folders[0]}/features.json has no image observation/{first}; it is no {spec.name} of DMC-VB")
    for number, path in enumerate(folders):
        if not any(place.folder == number for place in places):
            raise StoreError(f"{path} holds no episodes (no *.tfrecord* files with records)")
    pairs = [_goal_pair(place, place.read(), len(folders)) for place in places] if spec.setting == FIXED else []
    goals = max(pairs, default=0) + 1
    in_order = pairs == [pair for pair in range(goals) for _ in range(len(pairs) // goals)]
    return SubsetRecord(
        name=spec.name,
        task=spec.task,
        level=str(spec.level),
        setting=spec.setting,
        episodes=len(places),
        layers=("none-yet",),
        size=sizes[images[views[0]]],
        renderer={"name": IMPORTED},
        family=of.family,
        views=views,
        hidden_goal=spec.hides_goal,
        max_steps=_time_limit(places, of),
        action_repeat=repeat,
        seconds_per_step=of.seconds_per_step,
        joints=tuple(of.model.joint(number).name for number in range(of.model.njnt)),
        actuators=tuple(of.model.actuator(number).name for number in range(of.model.nu)),
        fixed_goals=goals if pairs else None,
        episodes_per_goal=len(pairs) // goals if pairs and in_order else None,  # else the episodes' labels say it
    )


def _metadata(folder: Path) -> tuple[int, int | None]:
    """Action repeat, and seed of fixed goals, which our own exports say; DMC-VB's repeat is 2, its seed unknown."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        said = parse_json((folder / "metadata.json").read_bytes())
        seed = said["seed"] if isinstance(said["seed"], int) and said["seed"] >= 0 else None
        return (said["action_repeat"] if said["action_repeat"] in (1, 2, 4) else ACTION_REPEAT), seed
    return ACTION_REPEAT, None


def _time_limit(places: tuple[Place, ...], task: Task) -> int:
    """Transitions of the first episode that the time limit ended; if it ended none, at least the task's own limit.

    Experts reach nearly all goals of mazes, so the first such episode may be a late one.
    """
    longest = task.max_steps
    for values in map(Place.read, places):
        length = len(values.get("steps/reward", ())) - 1
        if 0 < length <= MAX_STEPS and not np.any(values.get("steps/is_terminal", False)):
            return length
        longest = max(longest, length)
    return min(longest, MAX_STEPS)


def _goal_pair(place: Place, values: dict[str, Any], folders: int) -> int:
    """The pair of start and goal of an episode: DMC-VB has a folder for each pair, our own exports name it."""
    named = values.get("goal_pair", ())
    pair = int(named[0]) if folders == 1 and isinstance(named, np.ndarray) and len(named) == 1 else place.folder
    if not 0 <= pair < MAX_GOAL_PAIRS:
        raise StoreError(f"an episode has goal pair {pair}, expected 0 to {MAX_GOAL_PAIRS - 1}; export it again")
    return pair


def _image_sizes(path: Path) -> dict[str, int]:
    """A step's observations that are images -> their pixels a side."""
    try:
        tree = parse_json((path / "features.json").read_bytes())
        steps = dict(_flatten(tree["featuresDict"]["features"]["steps"]["sequence"]["feature"]))
        images = {name: feature["image"] for name, feature in steps.items() if feature.get("image")}
        sizes = {name: int(image["shape"]["dimensions"][0]) for name, image in images.items()}
        if not all(0 < size <= MAX_SIZE for size in sizes.values()):
            raise ValueError
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise StoreError(f"{path}/features.json does not describe RLDS steps ({type(error).__name__})") from None
    return {name.removeprefix("observation/"): size for name, size in sizes.items()}


def _flatten(feature: dict, prefix: str = "") -> Iterator[tuple[str, dict]]:
    if "featuresDict" in feature:
        for name, inner in feature["featuresDict"]["features"].items():
            yield from _flatten(inner, f"{prefix}/{name}" if prefix else name)
    else:
        yield prefix, feature


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.glob("*.tfrecord*") if file.is_file())


def _refuse_missing(path: Path) -> None:
    """Raises StoreError if the files' names say that there are more."""
    there: dict[tuple[str, int], set[int]] = {}
    for file in _files(path):
        if named := re.fullmatch(r"(.*\.tfrecord.*)-(\d{5,})-of-(\d{5,})", file.name):
            there.setdefault((named[1], int(named[3])), set()).add(int(named[2]))
    for (_, count), numbers in there.items():
        if len(numbers) < count:
            first = next(number for number in range(count) if number not in numbers)
            raise StoreError(
                f"{path} holds {len(numbers)} of {count} files (number {first} is missing); fetch the others, or "
                "import the others with --partial"
            )


def _import_subset(source: _Source, layers: list[Layer], store: Store, progress: ProgressCallback) -> None:
    """Write the shards that some layer lacks. The last shard is filled up with empty episodes."""
    first = layers[0]
    count = first.episodes_per_shard
    done = [recorded_shards(store, layer.name) for layer in layers]
    for shard in range(first.shards_for(source.record.episodes)):
        span = first.episodes_of(shard)
        places = source.episodes[span.start : span.stop]
        if not all(shard in there for there in done):
            arrays = {
                spec.name: np.zeros((count, *([first.rows] if spec.steps else []), *spec.shape), spec.dtype)
                for layer in layers
                for spec in layer.arrays
            }
            for row, place in enumerate(places):
                _import_episode(source, place, {name: array[row : row + 1] for name, array in arrays.items()})
            for layer in layers:
                put_shard(store, layer, shard, [(spec.name, arrays[spec.name]) for spec in layer.arrays])
        progress(len(places))


def _import_episode(source: _Source, place: Place, arrays: dict[str, np.ndarray]) -> None:
    """Put one episode into rows of a shard's arrays."""
    values, record = place.read(), source.record
    task = get_task(record.task)
    try:
        count = len(values["steps/reward"])
        length = count - 1  # RLDS: the last step holds the last observation
        if not 0 < length <= record.max_steps:
            raise ValueError(f"{count} steps, and the first ones have {record.max_steps + 1}")
        terminated = bool(np.any(values["steps/is_terminal"])) if "steps/is_terminal" in values else False
        arrays["state"][0, :count] = _state(task, values, count, terminated)
        for view, name in zip(record.views, picture_arrays(record.views, record.hidden_goal), strict=True):
            files = values[f"steps/observation/{picture_feature(task.id, view, record.hidden_goal)}"]
            arrays[name][0, :count] = [_picture(data, record.size) for data in files]
        arrays["action"][0, :length] = np.reshape(values["steps/action"], (count, -1))[:length]
        arrays["reward"][0, :length] = np.asarray(values["steps/reward"])[:length]
        arrays["discount"][0, :length] = 1
        arrays["discount"][0, length - 1] = 0 if terminated else 1
    except (KeyError, ValueError, TypeError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise StoreError(f"an episode of {place.file} is not one of {task.id}: {error}; fetch the file again") from None
    arrays["length"][0], arrays["terminated"][0] = length, terminated
    arrays["return"][0], arrays["behaviour"][0] = arrays["reward"][0].astype(np.float64).sum(), -1
    arrays["goal_pair"][0] = _goal_pair(place, values, len(source.folders)) if record.setting == FIXED else -1


def _picture(data: bytes, size: int) -> np.ndarray:
    """(size, size, 3) uint8; what says that it is larger is not decoded. Raises ValueError."""
    with Image.open(io.BytesIO(data)) as picture:
        if picture.size != (size, size):
            raise ValueError(f"an image of {picture.size} pixels instead of {size}")
        return np.asarray(picture)


def _state(task: Task, values: dict[str, Any], count: int, terminated: bool) -> np.ndarray:
    """(count, state): the fields by their names. DMC-VB's loader leaves two of a maze's out (165 numbers of 167),
    and they follow from the rest: the torso's height, and that the goal was touched in the last state of an episode
    that ended."""
    found = {
        field: np.reshape(value, (count, -1))
        for field in task.state_fields
        if (value := values.get(f"steps/observation/{state_feature(task.id, field)}")) is not None
    }
    if "target_activated" in task.state_fields and "target_activated" not in found:
        found["target_activated"] = (np.arange(count) == count - 1)[:, None] & terminated
    if "body_height" in task.state_fields and "body_height" not in found:
        found["body_height"] = found["walker_position"][:, 2:]
    return np.concatenate([found[field] for field in task.state_fields], axis=1)
