"""RLDS in TensorFlow Datasets' folder layout, written without TensorFlow: TFRecord files of one Example an episode."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from PIL import Image

from dmcvb_gen.release.export.episodes import ExportEpisode, Source
from dmcvb_gen.tasks import get_task

EPISODES_PER_FILE = 50
_FEATURES = "tensorflow_datasets.core.features"


def write(source: Source, folder: Path) -> None:
    """Write `<version>/`: `dataset_info.json`, `features.json` and the TFRecord shards of a split "train".

    A step has observation/<view>, observation/state, action, reward, discount, is_first, is_last, is_terminal, and
    the state's parts once more under the names and types of DMC-VB's own data set (observation/velocity, ...;
    float64, numbers without an axis where dm_control gives such), so that its loader takes the folder. The last
    step of an episode holds the last observation; its action is zeros and means nothing (RLDS).
    """
    subset, version = source.subset, source.manifest.version
    name = subset.name.replace("/", "_").replace("-", "_").replace(".", "_")
    target = folder / version
    target.mkdir()
    count = -(-len(source.episodes) // EPISODES_PER_FILE)
    lengths, size, file = [0] * count, 0, None
    fields = get_task(subset.task).state_slices
    for number, episode in enumerate(source):
        shard = number // EPISODES_PER_FILE
        if number % EPISODES_PER_FILE == 0:
            if file:
                file.close()
            file = (target / f"{name}-train.tfrecord-{shard:05d}-of-{count:05d}").open("wb")
        size += file.write(record(encode_example(_example(episode, fields))))
        lengths[shard] += 1
    if file:
        file.close()
    info = {
        "name": name,
        "version": version,
        "description": source.description,
        "fileFormat": "tfrecord",
        "moduleName": "dmcvb_gen.release.export.rlds",
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


# -- what the features are ------------------------------------------------------------------------


def _dict(features: dict[str, Any]) -> dict[str, Any]:
    return {
        "pythonClassName": f"{_FEATURES}.features_dict.FeaturesDict",
        "featuresDict": {"features": features},
    }


def _tensor(dtype: str, *shape: int) -> dict[str, Any]:
    kind = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    dimensions = {"dimensions": [str(size) for size in shape]} if shape else {}
    return {
        "pythonClassName": f"{_FEATURES}.{kind}",
        "tensor": {"shape": dimensions, "dtype": dtype, "encoding": "none"},
    }


def _features(source: Source) -> dict[str, Any]:
    subset = source.subset
    size = str(subset.record.size)
    picture = {
        "pythonClassName": f"{_FEATURES}.image_feature.Image",
        "image": {"shape": {"dimensions": [size, size, "3"]}, "dtype": "uint8", "encodingFormat": "png"},
    }
    observation = {view: picture for view in source.views}
    observation["state"] = _tensor("float32", subset.array("state").shape[-1])
    for name, part in get_task(subset.task).state_slices.items():
        observation[name] = _tensor("float64", *([part.stop - part.start] if part.stop - part.start > 1 else []))
    step = {
        "observation": _dict(observation),
        "action": _tensor("float32", subset.array("action").shape[-1]),
        "reward": _tensor("float32"),
        "discount": _tensor("float32"),
        "is_first": _tensor("bool"),
        "is_last": _tensor("bool"),
        "is_terminal": _tensor("bool"),
    }
    steps = {
        "pythonClassName": f"{_FEATURES}.dataset_feature.Dataset",
        "sequence": {"feature": _dict(step), "length": "-1"},
    }
    return _dict({"steps": steps, "episode_index": _tensor("int64")})


def _example(episode: ExportEpisode, fields: dict[str, slice]) -> dict[str, np.ndarray | list[bytes]]:
    rows = episode.length + 1
    step = np.arange(rows)

    def padded(value, last):
        return np.concatenate([value, np.full((1, *value.shape[1:]), last, value.dtype)])

    values: dict[str, np.ndarray | list[bytes]] = {
        f"steps/observation/{view}": [_png(frame) for frame in frames] for view, frames in episode.pixels.items()
    }
    values |= {f"steps/observation/{name}": episode.state[:, part] for name, part in fields.items()}
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


def _png(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return buffer.getvalue()


# -- bytes: the TFRecord framing and the protocol buffer tf.train.Example --------------------------


def record(data: bytes) -> bytes:
    """One TFRecord: length, its masked CRC-32C, the data, their masked CRC-32C."""
    length = struct.pack("<Q", len(data))
    return length + _masked_crc(length) + data + _masked_crc(data)


def _masked_crc(data: bytes) -> bytes:
    crc = google_crc32c.value(data)
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def _field(number: int, data: bytes) -> bytes:
    """A length-delimited field."""
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def encode_example(features: dict[str, np.ndarray | Iterable[bytes]]) -> bytes:
    """A tf.train.Example: lists of bytes, floats (float arrays) or integers (integer and boolean arrays), flattened."""
    entries = b""
    for name, value in features.items():
        if not isinstance(value, np.ndarray):
            feature = _field(1, b"".join(_field(1, item) for item in value))
        elif value.dtype.kind == "f":
            feature = _field(2, _field(1, value.astype("<f4").tobytes()))
        else:
            numbers = b"".join(_varint(int(number) & (2**64 - 1)) for number in value.ravel())
            feature = _field(3, _field(1, numbers))
        entries += _field(1, _field(1, name.encode()) + _field(2, feature))
    return _field(1, entries)
