"""Functions of float64 arrays whose bits do not depend on the processor.

numpy's `exp`, `sin` and their like come from vector libraries that are chosen by processor, and so do the products of
BLAS; their last bits differ between machines. Whatever decides a stored number takes its functions from here: they are
made of numpy's additions, multiplications, divisions and square roots alone, which IEEE 754 rounds in one way only.
Accurate to a few units in the last place (tests/test_arithmetic.py).
"""

from __future__ import annotations

import math

import numpy as np

_LOG2_E = 1.4426950408889634
_LN2 = (float.fromhex("0x1.62e42fee00000p-1"), 1.9082149292705877e-10)
"""ln 2 in two parts; the first has few enough bits that its multiples by exponents are exact."""
_HALF_PI = (1.5707963267341256, 6.07710050359346e-11, 2.912732056093356e-20)
"""pi / 2 in three parts, likewise."""
_ARCTAN_EIGHTHS = np.array(
    [
        0.0,
        0.12435499454676144,
        0.24497866312686414,
        0.35877067027057225,
        0.4636476090008061,
        0.5585993153435624,
        0.6435011087932844,
        0.7188299996216245,
        0.7853981633974483,
    ]
)
"""arctan(k / 8)."""
_EXP = [1 / math.factorial(n) for n in range(14)]
_SIN = [(-1) ** n / math.factorial(2 * n + 1) for n in range(9)]
_COS = [(-1) ** n / math.factorial(2 * n) for n in range(10)]
_ARCTAN = [(-1) ** n / (2 * n + 1) for n in range(8)]
_ARTANH = [1 / (2 * n + 1) for n in range(12)]


def _series(coefficients: list[float], x: np.ndarray) -> np.ndarray:
    """sum of coefficients[n] * x**n, by Horner's rule."""
    value = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value *= x
        value += coefficient
    return value


def exp(x) -> np.ndarray:
    """e**x elementwise; 0 and inf where it leaves float64."""
    x = np.clip(np.asarray(x, np.float64), -746.0, 710.0)
    power = np.floor(x * _LOG2_E + 0.5)
    rest = (x - power * _LN2[0]) - power * _LN2[1]
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(_series(_EXP, rest), power.astype(np.int32))


def log(x) -> np.ndarray:
    """Natural logarithm elementwise, of positive numbers."""
    part, power = np.frexp(np.asarray(x, np.float64))
    low = part < math.sqrt(0.5)
    part, power = np.where(low, 2 * part, part), power - low
    ratio = (part - 1) / (part + 1)
    return power * _LN2[0] + (power * _LN2[1] + 2 * ratio * _series(_ARTANH, ratio * ratio))


def tanh(x) -> np.ndarray:
    """Hyperbolic tangent elementwise; absolute error below 2e-16."""
    x = np.asarray(x, np.float64)
    decay = exp(-2 * np.abs(x))
    return np.copysign((1 - decay) / (1 + decay), x)


def sin_cos(x) -> tuple[np.ndarray, np.ndarray]:
    """Sine and cosine elementwise, of angles up to 1e5."""
    x = np.asarray(x, np.float64)
    turn = np.floor(x * (2 / math.pi) + 0.5)
    rest = ((x - turn * _HALF_PI[0]) - turn * _HALF_PI[1]) - turn * _HALF_PI[2]
    square = rest * rest
    sine, cosine = rest * _series(_SIN, square), _series(_COS, square)
    quarter = turn.astype(np.int64) & 3
    odd = (quarter & 1).astype(bool)
    first, second = np.where(odd, cosine, sine), np.where(odd, sine, cosine)
    return np.where(quarter >= 2, -first, first), np.where((quarter == 1) | (quarter == 2), -second, second)


def arctan2(y, x) -> np.ndarray:
    """Angle of (x, y) elementwise, in [-pi, pi]; 0 at the origin."""
    y, x = np.broadcast_arrays(np.asarray(y, np.float64), np.asarray(x, np.float64))
    high, low = np.maximum(np.abs(x), np.abs(y)), np.minimum(np.abs(x), np.abs(y))
    ratio = low / np.where(high == 0, 1.0, high)
    step = np.floor(ratio * 8 + 0.5)
    rest = (ratio - step / 8) / (1 + ratio * (step / 8))
    angle = _ARCTAN_EIGHTHS[step.astype(np.int64)] + rest * _series(_ARCTAN, rest * rest)
    angle = np.where(np.abs(y) > np.abs(x), math.pi / 2 - angle, angle)
    angle = np.where(x < 0, math.pi - angle, angle)
    return np.copysign(angle, y)


def erf(x) -> np.ndarray:
    """Error function elementwise; absolute error below 2e-8 beyond 4, where it counts as 1."""
    x = np.asarray(x, np.float64)
    inside = np.clip(x, -4.0, 4.0)
    term = inside * (2 / math.sqrt(math.pi)) * exp(-inside * inside)
    value = term.copy()
    for n in range(1, 90):  # 2^n x^(2n+1) / (2n+1)!!, all of one sign
        term *= 2 * inside * inside / (2 * n + 1)
        value += term
    return np.where(np.abs(x) > 4, np.copysign(1.0, x), value)


def total(parts: np.ndarray) -> np.ndarray:
    """Sum over the first axis, from its first entry to its last."""
    value = parts[0].copy()
    for part in parts[1:]:
        value += part
    return value


def norm(x, axis: int = -1, keepdims: bool = False) -> np.ndarray:
    """Euclidean length along an axis, summed from the first entry to the last."""
    parts = np.moveaxis(np.asarray(x, np.float64), axis, 0)
    length = np.sqrt(total(parts * parts))
    return np.expand_dims(length, axis) if keepdims else length


def gaussian(uniform) -> np.ndarray:
    """Standard normal numbers of uniform ones, two of each pair of neighbors (Box and Muller 1958).

    Args:
      uniform: (..., 2 n) in [0, 1).

    Returns:
      (..., 2 n).
    """
    uniform = np.asarray(uniform, np.float64)
    radius = np.sqrt(-2 * log(1 - uniform[..., 0::2]))
    sine, cosine = sin_cos(2 * math.pi * uniform[..., 1::2])
    return np.stack([radius * cosine, radius * sine], axis=-1).reshape(uniform.shape)


def normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal numbers from a stream; fewer are the first of more.

    numpy's own take a logarithm from the system's mathematics library in their tail.
    """
    count = math.prod(shape)
    return gaussian(rng.random(count + count % 2))[:count].reshape(shape)


def from_unit(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Numbers in [-1, 1], (..., n), scaled to [low, high], each (n,); as they are if these are -1 and 1."""
    if (low == -1).all() and (high == 1).all():
        return values
    return np.clip(low + (values + 1) / 2 * (high - low), low, high).astype(values.dtype)


def to_unit(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Numbers in [low, high], (..., n), scaled to [-1, 1]: the inverse of `from_unit`."""
    if (low == -1).all() and (high == 1).all():
        return values
    return np.clip((values - low) / (high - low) * 2 - 1, -1, 1).astype(values.dtype)
