"""Publish whatever a folder holds: a release, its light copy, or an export."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.index import CARD_FILES
from dmcvb_gen.dataset.manifest import MANIFEST
from dmcvb_gen.errors import StoreError
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.release.export.publishing import export_format, publish_export
from dmcvb_gen.release.fetch import Moved
from dmcvb_gen.release.publish import publish
from dmcvb_gen.storage.remote import storage_errors


def publish_folder(
    path: str | Path,
    url: str,
    *,
    pixels: bool = True,
    take_over: bool = False,
    options: dict[str, Any] | None = None,
    workers: int = 8,
    tick: ProgressCallback = ignore,
) -> Moved:
    """Put a complete release, or an export, at a URL; run again after an interruption, it resumes.

    Args:
      url: s3://bucket/name, gs://, hf://datasets/owner/name, file: or any fsspec URL.
      pixels: False leaves the images out; `paint` renders them again.
      take_over: publish even if another upload has claimed the URL.
      options: of fsspec; credentials belong into the environment.
      workers: parallel transfers.
      tick: called with 1 for each file.

    Raises:
      StoreError: as `publish.publish` does, or an option of releases was given for an export.
    """
    if not (Path(path) / MANIFEST).exists() and export_format(path) is not None:
        if not pixels or take_over:
            raise StoreError("--no-pixels and --take-over are for releases, and this is an export: remove them")
        return publish_export(path, url, options=options, workers=workers, tick=tick)
    with contextlib.nullcontext(path) if pixels else light_copy(path) as sent:
        return publish(sent, url, options=options, take_over=take_over, workers=workers, tick=tick)


@contextlib.contextmanager
def light_copy(path: str | Path) -> Iterator[str]:
    """A copy (of links) of a release without its pictures, beside it, with a card of its own if the release has one."""
    from dmcvb_gen.generate.paint import without_pictures  # the simulator, which publishing as it is does not need
    from dmcvb_gen.release.card import README, write_card

    folder = Path(path)
    with storage_errors(folder, "write beside"):
        made = tempfile.TemporaryDirectory(dir=folder.resolve().parent, prefix=f".{folder.name}-light-")
    with made as light:
        without_pictures(folder, light)
        if (folder / README).is_file():
            with storage_errors(folder):
                for name in CARD_FILES:  # the day and the place, the changes so far
                    if name != README and (folder / name).is_file():
                        shutil.copyfile(folder / name, Path(light) / name)
            write_card(light)
        yield light
