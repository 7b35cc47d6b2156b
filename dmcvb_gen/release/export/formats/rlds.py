"""RLDS in TensorFlow Datasets' folder layout, written without TensorFlow: TFRecord files of one Example an episode."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.release.dmcvb_names import picture_feature, state_feature
from dmcvb_gen.release.export.episodes import ExportEpisode, Source, png
from dmcvb_gen.release.export.registry import register_exporter

EPISODES_PER_FILE = 50
_FEATURES = "tensorflow_datasets.core.features"


@register_exporter("rlds")
def write(source: Source, folder: Path) -> None:
    """Write `<version>/`: `dataset_info.json`, `features.json`, the TFRecord shards of a split "train", and in
    `metadata.json` (TFDS's place for what features cannot say) the names of joints and of state's and action's entries.

    A step has observation/<view>, observation/state, action, reward, discount, is_first, is_last, is_terminal, and
    the state's parts once more under the names and types of DMC-VB's own data set (observation/velocity, ...;
    float64, numbers without an axis if dm_control gives such); the views of mazes have its names alone
    (observation/lowres_top_camera, ...). So its loader takes the folder. The last step of an episode holds the last
    observation; its action is zeros and means nothing (RLDS). An episode has its `episode_index` and, of fixed goals,
    its `goal_pair`.
    """
    from dmcvb_gen.release.tfrecord import encode_example, record

    subset, version = source.subset, source.manifest.version
    name = subset.name.replace("/", "_").replace("-", "_").replace(".", "_")
    target = folder / version
    target.mkdir()
    count = -(-len(source.episodes) // EPISODES_PER_FILE)
    lengths, size = [0] * count, 0
    for number, episode in enumerate(source):
        shard = number // EPISODES_PER_FILE
        with (target / f"{name}-train.tfrecord-{shard:05d}-of-{count:05d}").open("ab") as file:
            size += file.write(record(encode_example(_example(source, episode))))
        lengths[shard] += 1
    info = {
        "name": name,
        "version": version,
        "description": source.description,
        "fileFormat": "tfrecord",
        "moduleName": __name__,
        "releaseNotes": {},
        "splits": [
            {
                "name": "train",
                "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
                "numBytes": str(size),
                "shardLengths": [str(length) for length in lengths],
            }
        ],
    }
    (target / "dataset_info.json").write_text(json.dumps(info, indent=1))
    (target / "features.json").write_text(json.dumps(_features(source), indent=1))
    held, seed = source.subset.record.action_repeat, source.subset.goal_seed
    facts = {"joints": source.joints, "action_repeat": held, "seed": seed}
    (target / "metadata.json").write_text(json.dumps(source.names | facts, indent=1))


# -- what the features are ------------------------------------------------------------------------


def _dict(features: dict[str, Any]) -> dict[str, Any]:
    return {"pythonClassName": f"{_FEATURES}.features_dict.FeaturesDict", "featuresDict": {"features": features}}


def _tensor(dtype: str, *shape: int) -> dict[str, Any]:
    kind = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    dimensions = {"dimensions": [str(size) for size in shape]} if shape else {}
    return {
        "pythonClassName": f"{_FEATURES}.{kind}",
        "tensor": {"shape": dimensions, "dtype": dtype, "encoding": "none"},
    }


def _fields(subset: Subset) -> dict[str, tuple[int, int]]:
    """Name -> first place and last + 1 of each field of a state."""
    return subset.spec("state").attributes["fields"]


def _features(source: Source) -> dict[str, Any]:
    subset = source.subset
    size = str(subset.record.size)
    picture = {
        "pythonClassName": f"{_FEATURES}.image_feature.Image",
        "image": {"shape": {"dimensions": [size, size, "3"]}, "dtype": "uint8", "encodingFormat": "png"},
    }
    observation = {_picture_name(source, view): picture for view in source.views}
    observation["state"] = _tensor("float32", subset.array("state").shape[-1])
    for name, (first, last) in _fields(subset).items():
        shape = [last - first] if last - first > 1 else []
        observation[state_feature(subset.task, name)] = _tensor("float64", *shape)
    step = {
        "observation": _dict(observation),
        "action": _tensor("float32", subset.array("action").shape[-1]),
        **dict.fromkeys(("reward", "discount"), _tensor("float32")),
        **dict.fromkeys(("is_first", "is_last", "is_terminal"), _tensor("bool")),
    }
    steps = {
        "pythonClassName": f"{_FEATURES}.dataset_feature.Dataset",
        "sequence": {"feature": _dict(step), "length": "-1"},
    }
    episode = {"steps": steps, "episode_index": _tensor("int64")}
    return _dict(episode | ({"goal_pair": _tensor("int64")} if subset.record.fixed_goals else {}))


def _picture_name(source: Source, view: str) -> str:
    return picture_feature(source.subset.task, view, source.pictures.hide_goal)


def _example(source: Source, episode: ExportEpisode) -> dict[str, np.ndarray | list[bytes]]:
    task = source.subset.task
    rows = episode.length + 1
    step = np.arange(rows)

    def padded(value, last):
        return np.concatenate([value, np.full((1, *value.shape[1:]), last, value.dtype)])

    values: dict[str, np.ndarray | list[bytes]] = {
        f"steps/observation/{_picture_name(source, view)}": [png(frame) for frame in frames]
        for view, frames in episode.pixels.items()
    }
    for name, (first, last) in _fields(source.subset).items():
        values[f"steps/observation/{state_feature(task, name)}"] = episode.state[:, first:last]
    if source.subset.record.fixed_goals:
        values["goal_pair"] = source.subset.read("goal_pair", [episode.index])
    return values | {
        "steps/observation/state": episode.state,
        "steps/action": padded(episode.action, 0),
        "steps/reward": padded(episode.reward, 0),
        "steps/discount": padded(episode.discount, 0 if episode.terminated else 1),
        "steps/is_first": step == 0,
        "steps/is_last": step == rows - 1,
        "steps/is_terminal": (step == rows - 1) & episode.terminated,
        "episode_index": np.array([episode.index]),
    }
