"""Write a Parquet table with one row for each episode of a release.

The viewer of the Hugging Face Hub shows it, and `datasets.load_dataset` reads it. The schema and the card's header
(`CONFIG`) say that the first frames are pictures.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import CARD_FOLDER
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.generate.inputs import background_source
from dmcvb_gen.generate.render import renderer_for
from dmcvb_gen.generate.resolve import check_task_code
from dmcvb_gen.release.export.episodes import png, table_schema

TABLE = f"{CARD_FOLDER}episodes.parquet"
CONFIG = {"config_name": "episodes", "default": True, "data_files": [{"split": "train", "path": TABLE}]}
"""Where the Hub finds the table, for the card's header."""
FRAME = 64
"""Largest width and height of a first frame in pixels."""
ROWS = 500
"""Episodes that are in memory at a time, and in one row group of the file."""
COLUMNS = {
    "subset": ("string", "task/level/distractor, the subset's folder without .zarr"),
    "episode": ("int64", "index in the subset"),
    "return": ("float64", "sum of the episode's rewards"),
    "length": ("int32", "steps"),
    "seed": ("uint64", "of the episode's random streams"),
    "policy": ("string", "the behaviour policy"),
    "terminated": ("bool", "whether the task ended it, and not the time limit"),
    "first_frame": ("image", "the first observation's first view"),
}
"""Column -> (type as `datasets` names it, meaning)."""


def write_table(release: Release, path: Path) -> None:
    """Write the table; render the first frames of episodes without stored pictures.

    Raises:
      StoreError: something cannot be read or written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    schema = table_schema({name: (kind, 1) for name, (kind, _) in COLUMNS.items()})
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for subset in release.subsets.values():
            for first in range(0, len(subset.episodes), ROWS):
                few = subset.episodes[first : first + ROWS]
                writer.write_table(pa.Table.from_pydict(_facts(subset, few) | _frames(subset, few), schema))


def table_rows(path: Path) -> set[tuple]:
    """The rows of a table without the pictures; none if there is no table that can be read."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(path, columns=[name for name in COLUMNS if name != "first_frame"])
    except (pa.ArrowInvalid, OSError, KeyError):
        return set()
    return {tuple(row.values()) for row in table.to_pylist()}


def _facts(subset: Subset, episodes: np.ndarray) -> dict[str, Any]:
    """All columns except the pictures."""
    policies = [policy.name for policy in subset.record.policies] or ["random"]
    values = {name: subset.read(name, episodes) for name in ("return", "length", "terminated")}
    behaviour = subset.read("behaviour", episodes)
    return values | {
        "subset": [subset.name] * len(episodes),
        "episode": np.asarray(episodes, np.int64),
        "seed": [None] * len(episodes) if subset.record.imported else subset.read("seed", episodes),
        "policy": [policies[index] if 0 <= index < len(policies) else "unknown" for index in behaviour],
    }


def _frames(subset: Subset, episodes: np.ndarray) -> dict[str, Any]:
    """The column of the pictures: the stored ones, others rendered from physics states and labels."""
    pictures = shown(subset, "agents")
    pictures = pictures if pictures.views else shown(subset)  # the overhead view, if there is no other
    name, frames = pictures.arrays[0], dict.fromkeys(episodes.tolist())
    lacking = episodes[subset.unpainted[episodes]] if name in subset.arrays else episodes
    for episode in np.setdiff1d(episodes, lacking).tolist():
        frames[episode] = subset.array(name)[episode, 0]
    if len(lacking) and not subset.record.imported:
        source = background_source(subset.release.path, subset.record)
        check_task_code(subset.task, subset.trajectories)
        with contextlib.closing(renderer_for(subset.record, source)[0]) as renderer:
            physics, labels = subset.read("physics", lacking)[:, 0], subset.labels(lacking)[:, 0]
            made = renderer.render(physics, labels, views=[pictures.views[0]], hide_goal=pictures.hide_goal)[:, 0]
        frames |= dict(zip(lacking.tolist(), made, strict=True))
    return {"first_frame": [_picture(frame) for frame in frames.values()]}


def _picture(frame: np.ndarray | None) -> dict[str, Any] | None:
    if frame is None:
        return None
    if max(frame.shape[:2]) > FRAME:
        frame = np.asarray(Image.fromarray(frame).resize((FRAME, FRAME), Image.Resampling.BOX))
    return {"bytes": png(frame), "path": None}
