"""Pack policy files (safetensors) into one small archive, and unpack the same bytes.

Weights hardly compress, because 23 bits of a float32 are noise. But policies of one task have much in common: a layer
resembles the same layer of an earlier file. It is stored as a difference to `scale * earlier`, with one scale a row or
a column. For a layer x and its guess p = scale * earlier, the archive holds these streams::

    scales   float32, by least squares
    other    a bit a weight: 0 if x is p to the last bit, as in units that never learned and layers that files share
    plane0-3 of the other weights: the bytes of n(x) - n(p), where n counts units of the last bit of the largest weight
    rest     of the other weights: the bits of x below that unit

All of it is exact: a product of two float32 in float64, powers of two, integers.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every stream in an archive, so that equal files give equal archives."""
_SIGNIFICAND = 24
_WHOLE = 32
"""Bits of the rest of a weight that is smaller than a unit: the weight itself."""

Layers = defaultdict[tuple[str, tuple[int, int]], list[np.ndarray]]
"""(name, shape) -> this layer in the files before."""


class _Choice(NamedTuple):
    """Encoding of a layer.

    Attributes:
      reference: place of the earlier layer; -1 if the guess is zero.
      axis: 0 if scales belong to columns, 1 if to rows.
      unit: exponent of the unit.
      shift: of the differences, which brings their noise to a border between bytes.
    """

    reference: int
    axis: int
    unit: int
    shift: int


class _Streams:
    """Values of several kinds, written to the end and read from the start."""

    def __init__(self, content: dict[str, bytes] | None = None) -> None:
        self.written: defaultdict[str, bytearray] = defaultdict(bytearray)
        self._content = content or {}
        self._at: defaultdict[str, int] = defaultdict(int)

    def write(self, kind: str, values: np.ndarray) -> None:
        self.written[kind] += values.tobytes()

    def read(self, kind: str, dtype: Any, count: int) -> np.ndarray:
        found = np.frombuffer(self._content[kind], dtype, count, self._at[kind])
        self._at[kind] += found.nbytes
        return found


def pack_files(contents: dict[str, bytes]) -> bytes:
    """Pack safetensors files of float32 arrays, name -> bytes, into the bytes of one archive.

    Raises:
      ValueError: a file is of another kind.
    """
    streams, earlier, index = _Streams(), Layers(list), []
    for name, content in contents.items():
        at = 8 + int.from_bytes(content[:8], "little")
        choices = []
        for key, shape in _layers(content[:at]):
            layer = np.frombuffer(content, "<f4", shape[0] * shape[1], at).reshape(shape)
            choices.append(_write_layer(layer, earlier[key, shape], streams))
            earlier[key, shape].append(layer)
            at += layer.nbytes
        head = content[: 8 + int.from_bytes(content[:8], "little")]
        index.append({"name": name, "head": head.decode("latin-1"), "layers": choices})
    archive = _zipped({"index.json": json.dumps(index).encode()} | {k: bytes(v) for k, v in streams.written.items()})
    if unpack_files(archive) != contents:
        raise ValueError("the files do not come back as they were")
    return archive


def unpack_files(archive: bytes) -> dict[str, bytes]:
    """The files of an archive: name -> bytes."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        content = {name: file.read(name) for name in file.namelist()}
    streams, earlier, files = _Streams(content), Layers(list), {}
    for entry in json.loads(content["index.json"]):
        parts = [entry["head"].encode("latin-1")]
        for (key, shape), choice in zip(_layers(parts[0]), entry["layers"], strict=True):
            layer = _read_layer(shape, _Choice(*choice), earlier[key, shape], streams)
            earlier[key, shape].append(layer)
            parts.append(layer.tobytes())
        files[entry["name"]] = b"".join(parts)
    return files


def _layers(head: bytes) -> Iterator[tuple[str, tuple[int, int]]]:
    """Arrays of a safetensors file in the order of their bytes: name, (rows, columns)."""
    entries = {key: entry for key, entry in json.loads(head[8:]).items() if key != "__metadata__"}
    for key, entry in sorted(entries.items(), key=lambda item: item[1]["data_offsets"]):
        if entry["dtype"] != "F32":
            raise ValueError(f"{key} is {entry['dtype']}; the arrays of policies are float32")
        *rows, columns = entry["shape"]
        yield key, (int(np.prod(rows)), columns)


def _write_layer(layer: np.ndarray, earlier: list[np.ndarray], streams: _Streams) -> _Choice:
    """Write a (rows, columns) layer, as the difference to whichever layer makes it smallest."""
    unit = int(np.frexp(np.abs(layer).max())[1]) - _SIGNIFICAND
    counts, bits, rest = _taken_apart(layer, unit)

    def difference_to(reference: int, axis: int) -> tuple[float, int, int, np.ndarray, np.ndarray, np.ndarray]:
        scales = _scales(layer, earlier[reference], axis) if reference >= 0 else np.zeros(0, np.float32)
        guess = _guess(layer.shape, earlier, reference, axis, scales)
        other = guess.astype(np.float32).view(np.uint32) != layer.view(np.uint32)
        difference = (counts - _rounded(guess, unit))[other]
        size = np.log2(np.abs(difference) + 1.0).sum() + bits[other].sum() + 32 * scales.size
        return float(size), reference, axis, scales, other, difference

    ways = [(-1, 0), *((reference, axis) for reference in range(len(earlier)) for axis in (0, 1))]
    _, reference, axis, scales, other, difference = min((difference_to(*way) for way in ways), key=lambda way: way[0])
    folded = np.where(difference < 0, -2 * difference - 1, 2 * difference)
    spread = float(np.sqrt(np.mean(np.square(difference.astype(np.float64))))) if difference.size else 0.0
    # Three bits of the byte above the noise hold most differences; the byte over it is nearly always zero.
    shift = min((3 - int(np.log2(spread + 1))) % 8, _WHOLE - int(folded.max(initial=0)).bit_length())
    planes = (folded << shift).astype("<u4").view(np.uint8).reshape(-1, 4)
    streams.write("scales", scales)
    streams.write("other", np.packbits(other))
    for plane in range(4):
        streams.write(f"plane{plane}", planes[:, plane])
    for width in range(1, _WHOLE + 1):
        values = rest[other & (bits == width)]
        streams.write("rest", np.packbits((values[:, None] >> np.arange(width)) & 1))
    return _Choice(reference, axis, unit, shift)


def _read_layer(
    shape: tuple[int, int], choice: _Choice, earlier: list[np.ndarray], streams: _Streams
) -> np.ndarray:  # (rows, columns) float32
    scales = streams.read("scales", "<f4", shape[1 - choice.axis] if choice.reference >= 0 else 0)
    guess = _guess(shape, earlier, choice.reference, choice.axis, scales)
    size = shape[0] * shape[1]
    other = np.unpackbits(streams.read("other", np.uint8, -(-size // 8)), count=size).astype(bool).reshape(shape)
    planes = np.stack([streams.read(f"plane{plane}", np.uint8, int(other.sum())) for plane in range(4)], axis=1)
    folded = planes.view("<u4").ravel().astype(np.int64) >> choice.shift
    counts = np.where(folded & 1, -(folded + 1) // 2, folded // 2) + _rounded(guess, choice.unit)[other]
    bits = _missing_bits(counts)
    rest = np.zeros(counts.shape, np.int64)
    for width in range(1, _WHOLE + 1):
        number = int((bits == width).sum())
        packed = streams.read("rest", np.uint8, -(-number * width // 8))
        digits = np.unpackbits(packed, count=number * width).reshape(number, width).astype(np.int64)
        rest[bits == width] = (digits << np.arange(width)).sum(axis=1)
    return _put_together(guess.astype(np.float32), other, counts, bits, rest, choice.unit)


def _taken_apart(layer: np.ndarray, unit: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whole units in each weight, the number of bits below them, and these bits as an integer; all int64."""
    scaled = np.ldexp(layer.astype(np.float64), -unit)
    counts = np.trunc(scaled).astype(np.int64)
    bits = _missing_bits(counts)
    rest = np.ldexp(np.abs(scaled - counts), np.where(counts == 0, 0, bits)).astype(np.int64)
    return counts, bits, np.where(counts == 0, layer.view(np.uint32).astype(np.int64), rest)


def _put_together(
    guess: np.ndarray, other: np.ndarray, counts: np.ndarray, bits: np.ndarray, rest: np.ndarray, unit: int
) -> np.ndarray:
    """The guess with the other weights in their places, see `_taken_apart`."""
    significand = (np.abs(counts) << np.minimum(bits, _SIGNIFICAND)) + rest
    weights = (np.ldexp(significand.astype(np.float64), unit - bits) * np.sign(counts)).astype(np.float32)
    guess[other] = np.where(counts == 0, rest.astype(np.uint32).view(np.float32), weights)
    return guess


def _missing_bits(counts: np.ndarray) -> np.ndarray:
    """Bits of a weight below the unit."""
    below = _SIGNIFICAND - np.frexp(np.abs(counts).astype(np.float64))[1]
    return np.where(counts == 0, _WHOLE, below).astype(np.int64)


def _scales(layer: np.ndarray, reference: np.ndarray, axis: int) -> np.ndarray:
    """Factor of each column or row that brings the reference nearest to the layer, float32."""
    products = (layer.astype(np.float64) * reference).sum(axis)
    squares = np.square(reference.astype(np.float64)).sum(axis)
    return np.divide(products, squares, out=np.zeros_like(products), where=squares > 0).astype(np.float32)


def _guess(
    shape: tuple[int, ...], earlier: list[np.ndarray], reference: int, axis: int, scales: np.ndarray
) -> np.ndarray:
    if reference < 0:
        return np.zeros(shape)
    return earlier[reference].astype(np.float64) * np.expand_dims(scales.astype(np.float64), axis)


def _rounded(guess: np.ndarray, unit: int) -> np.ndarray:
    return np.rint(np.ldexp(guess, -unit)).astype(np.int64)


def _zipped(streams: dict[str, bytes]) -> bytes:
    """A zip file of the streams, those compressed that become smaller by it."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in streams.items():
            alone = io.BytesIO()
            with zipfile.ZipFile(alone, "w", zipfile.ZIP_LZMA) as trial:
                trial.writestr(name, content)
            smaller = trial.infolist()[0].compress_size < len(content)
            method = zipfile.ZIP_LZMA if smaller else zipfile.ZIP_STORED
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), content, method)
    return out.getvalue()
