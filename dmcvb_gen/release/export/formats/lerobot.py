"""LeRobot's dataset layout, version 3 (github.com/huggingface/lerobot): Parquet tables with PNG images.

`datasets.load_dataset(folder)` reads the tables, too: their schema says that the pictures are pictures.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dmcvb_gen.generate.modalities import modality_of
from dmcvb_gen.release.export.episodes import ExportEpisode, Source, png, table_schema
from dmcvb_gen.release.export.registry import register_exporter

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
CHUNK_FILES, DATA_MB, VIDEO_MB = 1000, 100, 500
"""LeRobot's defaults: files a folder, megabytes a file."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
EPISODES_PER_FILE = 50
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


@register_exporter("lerobot", modules=("pyarrow",))
def write(source: Source, folder: Path) -> None:
    """Write `meta/` (info.json, stats.json, tasks.parquet, episodes), `data/` and a card.

    Modalities that are stored become images of their own: depth is LeRobot's own depth feature in millimeters,
    segmentation has the number of the geom + 1, both as PNG of 16 bits (`Modality.gray`); flow is in colors
    (`Modality.color`). info.json says how values are read. The last observation of an episode has no action and is left
    out, as LeRobot's frames all have one.
    """
    layout = _Layout(source)
    (folder / "meta").mkdir()
    files, statistics, index = _Files(folder, layout), _Statistics(), 0
    rows: list[dict[str, Any]] = []
    for episode in source:
        columns = layout.frames(episode, len(rows), index) | layout.pictures(episode)
        row = {"episode_index": len(rows), "tasks": [layout.task], "length": episode.length}
        row |= {"dataset_from_index": index, "dataset_to_index": index + episode.length}
        row |= files.add(columns, len(rows)) | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        rows.append(row | statistics.add(columns))
        index += episode.length
    files.close()
    _write_meta(folder, layout, rows, index, statistics)


def _write_meta(folder: Path, layout: _Layout, rows: list[dict], frames: int, statistics: _Statistics) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / EPISODES_PATH).parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), folder / EPISODES_PATH)
    tasks = {"task_index": pa.array([0], pa.int64()), "__index_level_0__": [layout.task]}
    pandas = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
            {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object"},
        ],
        "pandas_version": "2.0.0",
    }
    table = pa.table(tasks).replace_schema_metadata({"pandas": json.dumps(pandas)})
    pq.write_table(table, folder / "meta/tasks.parquet")
    (folder / "meta/stats.json").write_text(json.dumps(statistics.total(), indent=1))
    info = {
        "codebase_version": VERSION,
        "robot_type": layout.source.subset.task,
        "total_episodes": len(rows),
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": layout.fps,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": layout.features,
    }
    (folder / "meta/info.json").write_text(json.dumps(info, indent=1))
    (folder / "README.md").write_text(_card(layout))


def _card(layout: _Layout) -> str:
    manifest = layout.source.manifest
    rate = ""
    if layout.fps != layout.rate:
        rate = f"\nThe task takes {layout.rate:.4g} steps a second; timestamps have {layout.fps}, a whole number.\n"
    # `datasets` knows the data of a local folder by its name and this header alone, so the header names the data.
    return (
        f"---\nlicense: {manifest.license.lower()}\ntask_categories:\n- robotics\ntags:\n- LeRobot\nconfigs:\n"
        f"- config_name: default\n  description: {layout.source.digest}\n  data_files: data/*/*.parquet\n---\n\n"
        f"# {manifest.name} {manifest.version}\n\nA LeRobot data set ({VERSION}): {layout.source.description}.\n{rate}"
    )


class _Layout:
    """Columns of the data set.

    Attributes:
      task: text of the one task, task and level.
      rate, fps: steps a second, and the whole number that LeRobot takes for them; timestamps are made of that.
      keys: view -> feature of its pictures.
      modalities: array of depth, segmentation or flow -> feature of its pictures.
      features: features as in info.json.
    """

    def __init__(self, source: Source):
        self.source, self.size = source, source.subset.record.size
        self.task = f"{source.subset.task} ({source.subset.level})"
        self.rate, self.fps = source.steps_per_second, round(source.steps_per_second)
        single = len(source.views) == 1
        self.keys = {view: "observation.image" if single else f"observation.images.{view}" for view in source.views}
        self.modalities = {name: f"observation.images.{name.replace('/', '_')}" for name in source.modalities}
        self.features = self._features(source)

    def _features(self, source: Source) -> dict[str, Any]:
        scalar: dict[str, Any] = {"shape": [1], "names": None}
        shape, axes = [self.size, self.size, 3], ["height", "width", "channel"]
        picture: dict[str, Any] = {"dtype": "image", "shape": shape, "names": axes}
        state, actions = source.names["state"], source.names["action"]
        return {
            **{key: picture for key in self.keys.values()},
            **{key: self._modality(picture, name) for name, key in self.modalities.items()},
            "observation.state": {"dtype": "float32", "shape": [len(state)], "names": state},
            "action": {"dtype": "float32", "shape": [len(actions)], "names": actions},
            "next.reward": {"dtype": "float32", **scalar},
            "next.done": {"dtype": "bool", **scalar},
            "next.success": {"dtype": "bool", **scalar},
            "timestamp": {"dtype": "float32", **scalar},
            **{n: {"dtype": "int64", **scalar} for n in ("frame_index", "episode_index", "index", "task_index")},
        }

    def _modality(self, picture: dict[str, Any], name: str) -> dict[str, Any]:
        modality = modality_of(name)
        if modality.levels is None:
            return picture | {"info": {"encoding": modality.encoding}}
        info: dict[str, Any] = {"encoding": modality.levels}
        if modality.name == "depth":
            info |= {"is_depth_map": True, "depth_unit": "mm"}
        return {"dtype": "image", "shape": [self.size, self.size, 1], "names": picture["names"], "info": info}

    def pictures(self, episode: ExportEpisode) -> dict[str, np.ndarray]:
        """Feature -> (L, size, size, 3) uint8, or (L, size, size) uint16 for those of 16 bits."""
        pictures = {key: episode.pixels[view][: episode.length] for view, key in self.keys.items()}
        for name, key in self.modalities.items():
            modality, values = modality_of(name), episode.modalities[name][: episode.length]
            pictures[key] = modality.gray(values) if modality.levels else modality.color(values)
        return pictures

    def frames(self, episode: ExportEpisode, number: int, index: int) -> dict[str, np.ndarray]:
        """The columns of an episode but its pictures, each with a row a frame."""
        length, steps = episode.length, np.arange(episode.length)
        return {
            "observation.state": episode.state[:length],
            "action": episode.action,
            "next.reward": episode.reward,
            "next.done": steps == length - 1,
            "next.success": (steps == length - 1) & episode.terminated,
            "timestamp": (steps / self.fps).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full(length, number),
            "index": index + steps,
            "task_index": np.zeros(length, int),
        }


class _Files:
    """The tables, `EPISODES_PER_FILE` episodes a file, a row group an episode."""

    def __init__(self, folder: Path, layout: _Layout):
        self._folder = folder
        self._schema = table_schema({name: (one["dtype"], one["shape"][0]) for name, one in layout.features.items()})
        self._table: Any = None

    def add(self, columns: dict[str, np.ndarray], number: int) -> dict[str, Any]:
        """Write an episode; gives where it is, as columns of the table of episodes."""
        import pyarrow.parquet as pq

        chunk, file = divmod(number // EPISODES_PER_FILE, CHUNK_FILES)
        if number % EPISODES_PER_FILE == 0:
            self.close()
            path = self._folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._table = pq.ParquetWriter(path, self._schema)
        self._table.write_table(self._rows(columns))
        return {"data/chunk_index": chunk, "data/file_index": file}

    def _rows(self, columns: dict[str, np.ndarray]) -> pa.Table:
        import pyarrow as pa

        rows: dict[str, Any] = {}
        for field in self._schema:
            values = columns[field.name]
            if pa.types.is_struct(field.type):
                rows[field.name] = [{"bytes": png(frame), "path": None} for frame in values]
            else:
                rows[field.name] = list(values) if pa.types.is_fixed_size_list(field.type) else values.ravel()
        return pa.table(rows, self._schema)

    def close(self) -> None:
        """End the file that is open."""
        if self._table is not None:
            self._table.close()


class _Statistics:
    """Minimum, maximum, mean, standard deviation, quantiles and count of every feature, an episode at a time and in
    all; the quantiles of all are the weighted means of the episodes', as LeRobot itself takes them together."""

    def __init__(self):
        self._parts: dict[str, list[dict[str, np.ndarray]]] = {}

    def add(self, columns: dict[str, np.ndarray]) -> dict[str, list]:
        """Take an episode up; gives its own statistics as columns "stats/<feature>/<statistic>".

        Those of pictures have a number a channel: of 16 bits in their own unit, of others in [0, 1].
        """
        flat: dict[str, list] = {}
        shape: tuple[int, ...]
        for name, value in columns.items():
            if value.dtype == np.uint16:
                value, shape = value.reshape(-1, 1).astype(np.float64), (1, 1, 1)
            elif value.ndim == 4:
                value, shape = value.reshape(-1, 3) / 255.0, (3, 1, 1)
            else:
                value = np.asarray(value, np.float64).reshape(len(value), -1)
                shape = (value.shape[1],)
            part = {key: getattr(value, key)(axis=0).reshape(shape) for key in ("min", "max", "mean", "std")}
            found = np.quantile(value, list(QUANTILES.values()), axis=0)
            part |= {key: number.reshape(shape) for key, number in zip(QUANTILES, found, strict=True)}
            part["count"] = np.array([len(columns[name])])
            self._parts.setdefault(name, []).append(part)
            flat |= {f"stats/{name}/{key}": number.tolist() for key, number in part.items()}
        return flat

    def total(self) -> dict[str, dict[str, list]]:
        """The statistics of all episodes together."""
        out = {}
        for name, parts in self._parts.items():
            stacked = {key: np.stack([part[key] for part in parts]) for key in parts[0]}
            count = stacked.pop("count")[:, 0].astype(np.float64)
            weight = (count / count.sum()).reshape(-1, *[1] * parts[0]["mean"].ndim)
            mean = (weight * stacked["mean"]).sum(axis=0)
            variance = (weight * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(axis=0)
            total = {"min": stacked["min"].min(axis=0), "max": stacked["max"].max(axis=0), "mean": mean}
            total |= {"std": np.sqrt(variance)} | {key: (weight * stacked[key]).sum(axis=0) for key in QUANTILES}
            out[name] = {key: value.tolist() for key, value in total.items()} | {"count": [int(count.sum())]}
        return out
