"""The package's version, for all that write it down; `dmcvb_gen.__version__` is the same."""

from __future__ import annotations

__version__ = "0.2.0"
