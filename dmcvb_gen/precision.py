"""The precision that this processor, or GPU, computes fast in: bfloat16 if it has instructions for it, else float32.

bfloat16 doubles the pace on processors that compute in it, and is ten times slower than float32 on those that emulate
it. The processor's flags decide, so the same command on the same machine always gives the same numbers.
"""

from __future__ import annotations

from pathlib import Path

import torch

CPU_FLAGS = {"avx512_bf16", "amx_bf16"}
"""Names, as Linux lists them, of the instructions that compute in bfloat16."""


def choose_precision(asked: str, device: str = "cpu") -> str:
    """ "float32" or "bfloat16".

    Args:
      asked: "float32", "bfloat16", or "auto", which takes the one that the device has instructions for.
      device: "cpu" or "cuda".
    """
    if asked != "auto":
        return asked
    if device.startswith("cuda"):
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        fast = bool(CPU_FLAGS & processor_flags())
    return "bfloat16" if fast else "float32"


def processor_flags(listing: str | Path = "/proc/cpuinfo") -> set[str]:
    """Names of the processor's instructions; none where the system does not list them."""
    try:
        lines = Path(listing).read_text().splitlines()
    except OSError:
        return set()
    return set(next((line for line in lines if line.startswith("flags")), "").split())
