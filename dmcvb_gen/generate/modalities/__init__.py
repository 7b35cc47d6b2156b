"""Modalities: what each pixel shows, computed from its depth, its geom and the states; one file each.

`repaint --label NAME` stores them beside the images. A new one is a file here, or in a package that names it under the
entry points "dmcvb_gen.modalities"; docs/extending.md has an example.
"""

from __future__ import annotations

from collections.abc import Iterable

from dmcvb_gen.generate.modalities.base import Modality, Seen, all_modalities, get_modality, register_modality

__all__ = ["Modality", "Seen", "all_modalities", "get_modality", "modality_of", "register_modality", "stored_in"]


def modality_of(array: str) -> Modality:
    """The modality that an array holds: "depth", or "depth/top" of a task with several views."""
    return get_modality(array.partition("/")[0])


def stored_in(arrays: Iterable[str]) -> tuple[str, ...]:
    """The arrays among these that hold a modality."""
    return tuple(array for array in arrays if array.partition("/")[0] in all_modalities())
