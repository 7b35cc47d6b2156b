"""LeRobot's dataset layout, version 3 (github.com/huggingface/lerobot): Parquet tables, pictures as PNG in them."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from dmcvb_gen.release.export.episodes import ExportEpisode, Source

VERSION = "v3.0"
CHUNK_FILES, DATA_MB, VIDEO_MB = 1000, 100, 500
"""LeRobot's defaults: files a folder, megabytes a file."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
EPISODES_PER_FILE = 50


def write(source: Source, folder: Path) -> None:
    """Write `meta/` (info.json, stats.json, tasks.parquet, episodes) and `data/`; the last observation of an episode
    has no action and is left out, as LeRobot's frames all have one."""
    subset = source.subset
    names = {
        view: "observation.image" if len(source.views) == 1 else f"observation.images.{view}" for view in source.views
    }
    task, rows, statistics = f"{subset.task} ({subset.level})", [], _Statistics()
    pending: list[dict] = []
    index = 0
    (folder / "meta").mkdir()
    for number, episode in enumerate(source):
        chunk, file = divmod(number // EPISODES_PER_FILE, CHUNK_FILES)
        pending.append(_frames(episode, number, index, names, source.steps_per_second))
        rows.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": episode.length,
                "dataset_from_index": index,
                "dataset_to_index": index + episode.length,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            | statistics.add(pending[-1], episode, names)
        )
        index += episode.length
        if len(pending) == EPISODES_PER_FILE or number == len(source.episodes) - 1:
            path = folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(_table(pending, names), path)
            pending = []
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "__index_level_0__": [task]})
    pandas = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
            {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object"},
        ],
        "pandas_version": "2.0.0",
    }
    pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), folder / "meta/tasks.parquet")
    (folder / EPISODES_PATH).parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), folder / EPISODES_PATH)
    (folder / "meta/stats.json").write_text(json.dumps(statistics.total(), indent=1))
    info = {
        "codebase_version": VERSION,
        "robot_type": subset.task,
        "total_episodes": len(rows),
        "total_frames": index,
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": round(source.steps_per_second),
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": _features(subset, names),
    }
    (folder / "meta/info.json").write_text(json.dumps(info, indent=1))


def _features(subset, names) -> dict:
    size = subset.record.size
    scalar = {"shape": [1], "names": None}
    features = {
        name: {"dtype": "image", "shape": [size, size, 3], "names": ["height", "width", "channel"]}
        for name in names.values()
    }
    for name, array in (("observation.state", "state"), ("action", "action")):
        features[name] = {"dtype": "float32", "shape": [subset.array(array).shape[-1]], "names": None}
    features |= {"next.reward": {"dtype": "float32", **scalar}, "next.done": {"dtype": "bool", **scalar}}
    features["timestamp"] = {"dtype": "float32", **scalar}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", **scalar}
    return features


def _frames(episode: ExportEpisode, number: int, index: int, names, rate: float) -> dict[str, np.ndarray | list]:
    length, steps = episode.length, np.arange(episode.length)
    columns: dict[str, np.ndarray | list] = {
        name: [_png(frame) for frame in episode.pixels[view][:length]] for view, name in names.items()
    }
    return columns | {
        "observation.state": episode.state[:length],
        "action": episode.action,
        "next.reward": episode.reward,
        "next.done": steps == length - 1,
        "timestamp": (steps / rate).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(length, number),
        "index": index + steps,
        "task_index": np.zeros(length, np.int64),
    }


def _png(frame: np.ndarray) -> dict[str, bytes | None]:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return {"bytes": buffer.getvalue(), "path": None}


def _table(parts, names) -> pa.Table:
    columns = {}
    for name in parts[0]:
        if name in names.values():
            kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
            columns[name] = pa.array([value for part in parts for value in part[name]], kind)
        else:
            value = np.concatenate([part[name] for part in parts])
            if value.ndim == 2:
                flat = pa.array(value.ravel())
                columns[name] = pa.FixedSizeListArray.from_arrays(flat, value.shape[1])
            else:
                columns[name] = pa.array(value)
    return pa.table(columns)


class _Statistics:
    """Minimum, maximum, mean, standard deviation and count of every feature, an episode at a time and in all."""

    def __init__(self):
        self._parts: dict[str, list[dict[str, np.ndarray]]] = {}

    def add(self, columns, episode: ExportEpisode, names) -> dict[str, list]:
        """Take an episode up; gives its own statistics as columns "stats/<feature>/<statistic>"."""
        flat = {}
        for name in columns:
            if name in names.values():
                view = next(view for view, other in names.items() if other == name)
                value = episode.pixels[view][: episode.length].astype(np.float64) / 255
                axes, shape = (0, 1, 2), (3, 1, 1)  # LeRobot's pictures: a number a channel, in [0, 1]
            else:
                value = np.asarray(columns[name], np.float64).reshape(episode.length, -1)
                axes, shape = 0, (value.shape[1],)
            part = {key: getattr(value, key)(axis=axes).reshape(shape) for key in ("min", "max", "mean", "std")}
            part["count"] = np.array([episode.length])
            self._parts.setdefault(name, []).append(part)
            flat |= {f"stats/{name}/{key}": number.tolist() for key, number in part.items()}
        return flat

    def total(self) -> dict[str, dict[str, list]]:
        """The statistics of all episodes together."""
        out = {}
        for name, parts in self._parts.items():
            count = np.array([part["count"][0] for part in parts], np.float64)
            weight = (count / count.sum()).reshape(-1, *[1] * parts[0]["mean"].ndim)
            means = np.stack([part["mean"] for part in parts])
            mean = (weight * means).sum(axis=0)
            variance = (weight * (np.stack([part["std"] for part in parts]) ** 2 + (means - mean) ** 2)).sum(axis=0)
            out[name] = {
                "min": np.min([part["min"] for part in parts], axis=0).tolist(),
                "max": np.max([part["max"] for part in parts], axis=0).tolist(),
                "mean": mean.tolist(),
                "std": np.sqrt(variance).tolist(),
                "count": [int(count.sum())],
            }
        return out
