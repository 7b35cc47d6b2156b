"""DMC-VB's published TFDS folders into a release: RLDS episodes in, a store of the same layout as ours out.

The published data hold pixels, states, actions and rewards, but neither physics states nor distractor labels: an
imported release can be read, checked and trained on, but not repainted or regenerated. Nothing needs TensorFlow.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from PIL import Image

from dmcvb_gen.errors import StoreError
from dmcvb_gen.rollout.recipe import DEFAULT_EPISODES_PER_SHARD, LEVELS, is_maze, normalize_setting
from dmcvb_gen.store.manifest import Manifest, SubsetRecord, environment
from dmcvb_gen.store.schema import ArraySpec, EpisodeShape, array_specs
from dmcvb_gen.store.writer import (
    create_subset,
    finish_release,
    read_commits,
    sha256_file,
    shard_count,
    shard_episodes,
    start_release,
    write_shard,
)
from dmcvb_gen.tasks import LOCOMOTION_TASKS, get_task
from dmcvb_gen.tasks.base import Task

MISSING = ("physics", "exogenous/")
"""Arrays (by the beginnings of their names) that an imported subset has not."""
MAX_RECORD = 2**31
"""Bytes of an episode's record beyond which the file is taken to be damaged."""


def imported_specs(task: Task, size: int) -> tuple[ArraySpec, ...]:
    """Arrays of an imported subset."""
    return tuple(spec for spec in array_specs(EpisodeShape.of(task), size) if not spec.name.startswith(MISSING))


def import_tfds(
    folder: str | Path,
    out: str | Path,
    *,
    task: str | None = None,
    level: str | None = None,
    setting: str | None = None,
    name: str = "dmc-vb-original",
    tick: Callable[[int], None] = lambda episodes: None,
) -> Manifest:
    """Import locomotion subsets; run again, it goes on where it stopped.

    Args:
      folder: a TFDS folder (with features.json), or a tree of `<task>/<level>/<setting>` folders that hold such.
      out: folder of the new release.
      task, level, setting: what a single folder holds, where its path does not say it.
      name: of the new release.
      tick: told 1 for each episode.

    Raises:
      StoreError: no TFDS folder is there, it is damaged or has other features, or `out` cannot be used.
    """
    folder, out = Path(folder), Path(out)
    found = sorted(path.parent for path in folder.rglob("features.json"))
    if not found:
        raise StoreError(f"{folder} holds no TFDS folder (no features.json); give the folder of a data set")
    if len(found) > 1 and (task or level or setting):
        raise StoreError(
            f"{folder} holds {len(found)} data sets; give the folder of one with --task, --level, --setting"
        )
    sources = {}
    for path in found:
        record = _record(path, folder, task, level, setting)
        if record.name in sources:
            raise StoreError(f"{path} and {sources[record.name][0]} are both {record.name}; import one of them")
        sources[record.name] = path, record
    manifest = Manifest(
        name=name,
        version="1.0.0",
        license="CC-BY-4.0",
        recipe={"name": name, "imported": sorted(sources)},
        subsets=tuple(record for _, record in sources.values()),
        environments=(environment(),),
        lineage=(
            {
                "kind": "import",
                "from": "DMC-VB (Ortiz et al., NeurIPS 2024), TFDS folders",
                "features_sha256": {key: sha256_file(path / "features.json") for key, (path, _) in sources.items()},
            },
        ),
    )
    manifest = start_release(out, manifest)
    for path, record in sources.values():
        _import_subset(path, out, record, tick)
    return finish_release(out, manifest)


def _record(path: Path, root: Path, task, level, setting) -> SubsetRecord:
    parts = path.parts
    if parts[-1][:1].isdigit() and "." in parts[-1]:
        parts = parts[:-1]  # TFDS's folder of the version
    guess = parts[-3:] if len(parts) >= 3 else ("", "", "")
    task, level = task or guess[0].replace("_", "-"), level or guess[1]
    setting = setting or guess[2]
    if task not in LOCOMOTION_TASKS or level not in LEVELS or is_maze(task):
        raise StoreError(
            f"{path} does not say what it is by .../<task>/<level>/<setting> (e.g. walker_walk/expert/static_medium); "
            f"give --task ({', '.join(LOCOMOTION_TASKS)}), --level ({', '.join(LEVELS)}) and --setting"
        )
    setting = normalize_setting(task, setting)
    pixels = _step_features(path).get("observation/pixels", {}).get("image")
    if not pixels:
        raise StoreError(f"{path}/features.json has no picture observation/pixels; only locomotion data are imported")
    episodes = sum(1 for file in _files(path) for _ in _offsets(file))
    if not episodes:
        raise StoreError(f"{path} holds no episodes (no *.tfrecord* files with records)")
    return SubsetRecord(
        name=f"{task}/{level}/{setting}",
        task=task,
        level=level,
        setting=setting,
        episodes=episodes,
        episodes_per_shard=min(DEFAULT_EPISODES_PER_SHARD["locomotion"], episodes),
        size=int(pixels["shape"]["dimensions"][0]),
        renderer={"name": "imported"},
    )


def _step_features(path: Path) -> dict[str, Any]:
    """Flat names of a step's features -> their JSON."""
    try:
        tree = json.loads((path / "features.json").read_text())
        steps = tree["featuresDict"]["features"]["steps"]["sequence"]["feature"]
        return dict(_flatten(steps))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path}/features.json does not describe RLDS steps ({type(error).__name__})") from None


def _flatten(feature: dict, prefix: str = "") -> Iterator[tuple[str, dict]]:
    if "featuresDict" in feature:
        for name, inner in feature["featuresDict"]["features"].items():
            yield from _flatten(inner, f"{prefix}/{name}" if prefix else name)
    else:
        yield prefix, feature


def _import_subset(path: Path, out: Path, record: SubsetRecord, tick) -> None:
    task = get_task(record.task)
    rows = task.max_steps + 1
    attributes = {"task": record.task, "level": record.level, "setting": record.setting, "imported": "DMC-VB"}
    attributes["state_fields"] = {name: [part.start, part.stop] for name, part in task.state_slices.items()}
    specs = imported_specs(task, record.size)
    create_subset(out, record, specs, rows, attributes)
    done = read_commits(out, record)
    records = ((file, offset, length) for file in _files(path) for offset, length in _offsets(file))
    for shard in range(shard_count(record)):
        places = [next(records) for _ in range(*shard_episodes(record, shard))]
        if shard in done:
            continue
        arrays = {
            spec.name: np.zeros((len(places), *([rows] if spec.steps else []), *spec.shape), spec.dtype)
            for spec in specs
        }
        arrays["goal_pair"][:] = -1
        for row, place in enumerate(places):
            _fill({name: array[row : row + 1] for name, array in arrays.items()}, _read(*place), task, place[0])
            tick(1)
        write_shard(out, record, shard, arrays.items(), arrays["length"])


def _fill(arrays: dict[str, np.ndarray], values: dict[str, Any], task: Task, file: Path) -> None:
    """Put one decoded episode into rows of a shard's arrays."""
    try:
        pictures = [np.asarray(Image.open(io.BytesIO(data))) for data in values["steps/observation/pixels"]]
        count = len(pictures)
        fields = [np.reshape(values[f"steps/observation/{name}"], (count, -1)) for name in task.state_slices]
        state = np.concatenate(fields, axis=1)
        length = count - 1  # RLDS: the last step holds the last observation
        if not 0 < length <= task.max_steps or state.shape[1] != task.state_size:
            raise ValueError(f"{count} steps with states of {state.shape[1]}")
        arrays["pixels"][0, :count] = pictures
        arrays["state"][0, :count] = state
        arrays["action"][0, :length] = np.reshape(values["steps/action"], (count, -1))[:length]
        arrays["reward"][0, :length] = np.asarray(values["steps/reward"])[:length]
        terminated = bool(np.any(values["steps/is_terminal"])) if "steps/is_terminal" in values else False
        arrays["discount"][0, :length] = 1
        arrays["discount"][0, length - 1] = 0 if terminated else 1
    except (KeyError, ValueError, TypeError, OSError) as error:
        raise StoreError(f"an episode of {file} is not one of {task.id}: {error}; fetch the file again") from None
    arrays["length"][0], arrays["terminated"][0] = length, terminated
    arrays["return"][0] = arrays["reward"][0].astype(np.float64).sum()


# -- bytes: TFRecord and tf.train.Example ----------------------------------------------------------


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.glob("*.tfrecord*") if file.is_file())


def _offsets(file: Path) -> Iterator[tuple[int, int]]:
    """Where each record's data begin, and how long they are."""
    size, offset = file.stat().st_size, 0
    with file.open("rb") as handle:
        while offset < size:
            handle.seek(offset)
            head = handle.read(12)
            length = struct.unpack("<Q", head[:8])[0] if len(head) == 12 else MAX_RECORD
            if length >= MAX_RECORD or head[8:] != _masked_crc(head[:8]) or offset + 16 + length > size:
                raise StoreError(f"{file} is damaged or cut short at byte {offset}; fetch it again")
            yield offset + 12, length
            offset += 16 + length


def _masked_crc(data: bytes) -> bytes:
    crc = google_crc32c.value(data)
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def _read(file: Path, offset: int, length: int) -> dict[str, Any]:
    """One episode: flat names -> float32 or int64 arrays, or lists of bytes."""
    with file.open("rb") as handle:
        handle.seek(offset)
        data, crc = handle.read(length), handle.read(4)
    if crc != _masked_crc(data):
        raise StoreError(f"{file} is damaged at byte {offset}; fetch it again")
    try:
        return dict(_decode_feature(entry) for _, features in _fields(data) for _, entry in _fields(features))
    except (IndexError, ValueError, KeyError, UnicodeDecodeError):
        raise StoreError(f"{file} holds something else than tf.train.Example records at byte {offset}") from None


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[place]
        place += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, place
        shift += 7


def _fields(data) -> Iterator[tuple[int, memoryview]]:
    """(number, content) of the length-delimited fields of a message."""
    data, place = memoryview(data), 0
    while place < len(data):
        key, place = _varint(data, place)
        if key & 7 != 2:
            raise ValueError("not a length-delimited field")
        size, place = _varint(data, place)
        if place + size > len(data):
            raise ValueError("a field is longer than its message")
        yield key >> 3, data[place : place + size]
        place += size


def _decode_feature(entry: memoryview) -> tuple[str, Any]:
    parts = dict(_fields(entry))
    name, [(kind, content)] = bytes(parts[1]).decode(), list(_fields(parts[2])) or [(3, memoryview(b""))]
    if kind == 1:
        return name, [bytes(value) for _, value in _fields(content)]
    packed = b"".join(bytes(value) for _, value in _fields(content))
    if kind == 2:
        return name, np.frombuffer(packed, "<f4")
    numbers, place, view = [], 0, memoryview(packed)
    while place < len(view):
        number, place = _varint(view, place)
        numbers.append(number - 2**64 if number >= 2**63 else number)
    return name, np.array(numbers, np.int64)
