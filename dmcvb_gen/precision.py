"""Which precision this processor is fast in: a probe of the products that a training will compute.

bfloat16 doubles the pace on processors that compute in it, and is ten times slower than float32 on those that emulate
it. A list of processors would be out of date; timing the products is not.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

PROBE_SECONDS = 0.2
"""Seconds that a probe takes at most, once every product has run."""
WORTH = 0.95
"""bfloat16 is chosen if it takes less than this share of float32's time: its results are less precise."""


def choose_precision(
    asked: str, product: Callable[[torch.dtype], object], device: str = "cpu", threads: int | None = None
) -> str:
    """ "float32" or "bfloat16".

    Args:
      asked: "float32", "bfloat16", or "auto", which takes the faster one.
      product: computes a typical product in a precision; called several times with each.
      device: "cpu" is probed; "cuda" is asked whether it supports bfloat16.
      threads: threads that the training will have; None: those that torch has now.
    """
    if asked != "auto":
        return asked
    if device.startswith("cuda"):
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        seconds = fastest(product, (torch.float32, torch.bfloat16))
    finally:
        torch.set_num_threads(before)
    return "bfloat16" if seconds[torch.bfloat16] < WORTH * seconds[torch.float32] else "float32"


def fastest(product: Callable[[torch.dtype], object], precisions: tuple[torch.dtype, ...]) -> dict[torch.dtype, float]:
    """Precision -> seconds of the fastest of several calls; the precisions take turns."""
    seconds = dict.fromkeys(precisions, float("inf"))
    for precision in precisions:
        product(precision)  # the first call prepares kernels
    end = time.perf_counter() + PROBE_SECONDS
    while time.perf_counter() < end or float("inf") in seconds.values():
        for precision in precisions:
            start = time.perf_counter()
            product(precision)
            seconds[precision] = min(seconds[precision], time.perf_counter() - start)
    return seconds


def dense_product(hidden: int, batch: int) -> Callable[[torch.dtype], object]:
    """The product of SAC's critics: two networks' hidden layers, weights converted as in training."""
    inputs, weights = torch.randn(2, batch, hidden), torch.randn(2, hidden, hidden)
    return lambda precision: torch.bmm(inputs.to(precision), weights.to(precision)).float()
