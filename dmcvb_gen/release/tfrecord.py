"""Read and write TFRecord files of tf.train.Example messages without TensorFlow."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory, text_format

from dmcvb_gen.errors import StoreError

MAX_RECORD = 2**31
"""Bytes of a record beyond which the file is taken to be damaged."""


def _example_class() -> Any:
    """tf.train.Example, from its definition in data/example.textproto."""
    text = (resources.files("dmcvb_gen.release") / "data" / "example.textproto").read_text()
    file = text_format.Parse(text, descriptor_pb2.FileDescriptorProto())
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("dmcvb_gen.Example"))


_Example = _example_class()


def encode_example(features: Mapping[str, np.ndarray | Iterable[bytes]]) -> bytes:
    """A tf.train.Example: lists of bytes, floats (float arrays) or integers (integer and boolean arrays), flattened."""
    example = _Example()
    for name, value in features.items():
        feature = example.features.feature[name]
        if not isinstance(value, np.ndarray):
            feature.bytes_list.value.extend(value)
        elif value.dtype.kind == "f":
            feature.float_list.value.extend(value.astype(np.float32).ravel().tolist())
        else:
            feature.int64_list.value.extend(value.astype(np.int64).ravel().tolist())
    return example.SerializeToString(deterministic=True)


def decode_example(data: bytes) -> dict[str, np.ndarray | list[bytes]]:
    """The features of a tf.train.Example: (n,) float32 or int64, or lists of bytes.

    Raises:
      ValueError: it is something else.
    """
    try:
        example = _Example.FromString(data)
    except message.DecodeError as error:
        raise ValueError(f"no tf.train.Example ({error})") from None
    if not example.features.feature:
        raise ValueError("no tf.train.Example with features")
    values: dict[str, np.ndarray | list[bytes]] = {}
    for name, feature in example.features.feature.items():
        kind = feature.WhichOneof("kind")
        if kind == "bytes_list":
            values[name] = list(feature.bytes_list.value)
        elif kind == "float_list":
            values[name] = np.array(feature.float_list.value, np.float32)
        else:
            values[name] = np.array(feature.int64_list.value, np.int64)
    return values


# -- the framing of TFRecord: length, its masked CRC-32C, the data, their masked CRC-32C ------------


def _masked_crc(data: bytes) -> bytes:
    crc = google_crc32c.value(data)
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def record(data: bytes) -> bytes:
    """One TFRecord."""
    length = struct.pack("<Q", len(data))
    return length + _masked_crc(length) + data + _masked_crc(data)


def offsets(file: Path) -> Iterator[tuple[int, int]]:
    """Return the offset and length of each record's data in a file.

    Raises:
      StoreError: the file is damaged or cut short.
    """
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


def read_example(file: Path, offset: int, length: int) -> dict[str, np.ndarray | list[bytes]]:
    """The features of the record at one of `offsets`.

    Raises:
      StoreError: the record is damaged, or something else than a tf.train.Example.
    """
    with file.open("rb") as handle:
        handle.seek(offset)
        data, crc = handle.read(length), handle.read(4)
    if crc != _masked_crc(data):
        raise StoreError(f"{file} is damaged at byte {offset}; fetch it again")
    try:
        return decode_example(data)
    except ValueError as error:
        raise StoreError(f"{file} holds something else than RLDS episodes at byte {offset}: {error}") from None
