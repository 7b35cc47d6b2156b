"""dmcvb-gen: the open generator behind a DMC-VB style benchmark."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dmcvb_gen.loaders.register import register_with_gymnasium
from dmcvb_gen.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from dmcvb_gen.benchmarks.evaluate import evaluate
    from dmcvb_gen.benchmarks.validate import validate
    from dmcvb_gen.generate.returns import evaluate_behaviour
    from dmcvb_gen.loaders.release import ReleaseReader
    from dmcvb_gen.making import make, paint, regenerate, repaint, rollout
    from dmcvb_gen.release.export import export
    from dmcvb_gen.release.fetch import fetch
    from dmcvb_gen.release.publish import publish
    from dmcvb_gen.release.verify import verify
    from dmcvb_gen.training.behaviour import train_behaviour

__all__ = [
    "__version__",
    "evaluate",
    "evaluate_behaviour",
    "export",
    "fetch",
    "make",
    "open",
    "paint",
    "publish",
    "regenerate",
    "repaint",
    "rollout",
    "train_behaviour",
    "validate",
    "verify",
]
ROOMS = {
    "making": ("make", "rollout", "paint", "repaint", "regenerate"),
    "training.behaviour": ("train_behaviour",),
    "generate.returns": ("evaluate_behaviour",),
    "release.verify": ("verify",),
    "release.publish": ("publish",),
    "release.fetch": ("fetch",),
    "release.export": ("export",),
    "benchmarks.evaluate": ("evaluate",),
    "benchmarks.validate": ("validate",),
}
"""Module -> its public functions, imported when they are used, so that a command loads only what it needs."""


def __getattr__(name: str) -> Any:
    for module, functions in ROOMS.items():
        if name in functions:
            return getattr(importlib.import_module(f"dmcvb_gen.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


def open(
    path: str | Path,
    storage_options: dict | None = None,
    *,
    digest: str | None = None,
    paint: bool = False,
    **painting: Any,
) -> ReleaseReader:
    """Open a release for reading: `dmcvb_gen.open("releases/demo")["walker-walk/expert/dynamic"]`.

    Args:
      path: its folder, or a URL ("s3://bucket/name", "https://...", "hf://datasets/OWNER/NAME"), which is read in
        place; either may end in "@sha256:<digest>".
      storage_options: options of the storage client, for a URL.
      digest: SHA-256 of the manifest, from a source that you trust; compared before anything else is read.
      paint: paint pictures when they are read instead of reading them; needs the simulator installed.
      painting: how, which implies `paint` (`dmcvb_gen.loaders.painted.Painting`): distractors="stored" (those of the
        data) or "resample" (fresh ones for each `set_epoch`), size, backgrounds, cache_bytes (painted episodes kept a
        subset).

    Raises:
      StoreError: there is no release, it cannot be read, it has another digest, or the URL needs a package that is
        not installed.
      DmcvbError: `painting` has an unknown value, or all of the release was imported.
      TypeError: `painting` has an unknown field.
    """
    if paint or painting:
        from dmcvb_gen.dataset.gate import Release
        from dmcvb_gen.loaders.painted import Painting, painted_release

        return painted_release(Release.open(path, storage_options, digest), Painting(**painting))
    from dmcvb_gen.loaders.release import ReleaseReader

    return ReleaseReader.open(path, storage_options, digest)


register_with_gymnasium()  # so that gymnasium.make knows our names wherever this package is imported
