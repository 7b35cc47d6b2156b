"""Read and write TFRecord files of tf.train.Example messages without TensorFlow."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

from dmcvb_gen.errors import StoreError

MAX_RECORD = 2**31
"""Bytes of a record beyond which the file is taken to be damaged."""

_FIELD = descriptor_pb2.FieldDescriptorProto
_LISTS = {"bytes_list": ("BytesList", _FIELD.TYPE_BYTES), "float_list": ("FloatList", _FIELD.TYPE_FLOAT)}
_LISTS |= {"int64_list": ("Int64List", _FIELD.TYPE_INT64)}


def _example_class() -> Any:
    """tf.train.Example as its published definition (tensorflow/core/example) says it."""
    file = descriptor_pb2.FileDescriptorProto(name="dmcvb_gen/example.proto", package="dmcvb_gen", syntax="proto3")
    feature = descriptor_pb2.DescriptorProto(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, (field, (kind, of)) in enumerate(_LISTS.items(), 1):
        values = file.message_type.add(name=kind).field.add(name="value", number=1, type=of)
        values.label = _FIELD.LABEL_REPEATED
        member = feature.field.add(name=field, number=number, type=_FIELD.TYPE_MESSAGE, type_name=f".dmcvb_gen.{kind}")
        member.label, member.oneof_index = _FIELD.LABEL_OPTIONAL, 0
    file.message_type.append(feature)
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry", options={"map_entry": True})
    entry.field.add(name="key", number=1, type=_FIELD.TYPE_STRING, label=_FIELD.LABEL_OPTIONAL)
    whole, one, many = _FIELD.TYPE_MESSAGE, _FIELD.LABEL_OPTIONAL, _FIELD.LABEL_REPEATED
    entry.field.add(name="value", number=2, type=whole, type_name=".dmcvb_gen.Feature", label=one)
    entries = ".dmcvb_gen.Features.FeatureEntry"
    features.field.add(name="feature", number=1, type=whole, type_name=entries, label=many)
    example = file.message_type.add(name="Example")
    example.field.add(name="features", number=1, type=whole, type_name=".dmcvb_gen.Features", label=one)
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
