"""Write a Parquet table with one row for each episode of a release.

The viewer of the Hugging Face Hub shows it, and `datasets.load_dataset` reads it. The schema and the card's header
(`CONFIG`) say that the first frames are pictures.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import CARD_FOLDER
from dmcvb_gen.dataset.pictures import shown, training_pictures
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.generate.inputs import background_source
from dmcvb_gen.generate.render import renderer_for

TABLE = f"{CARD_FOLDER}episodes.parquet"
CONFIG = {"config_name": "episodes", "default": True, "data_files": [{"split": "train", "path": TABLE}]}
"""Where the Hub finds the table, for the card's header."""
FRAME = 64
"""Largest width and height of a first frame in pixels."""
ROWS = 500
"""Episodes that are in memory at a time, and in one row group of the file."""
PICTURE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
"""How `datasets` stores a picture."""
COLUMNS = {
    "subset": (pa.string(), "task/level/distractor, the subset's folder without .zarr"),
    "episode": (pa.int64(), "index in the subset"),
    "return": (pa.float64(), "sum of the episode's rewards"),
    "length": (pa.int32(), "steps"),
    "seed": (pa.uint64(), "of the episode's random streams"),
    "policy": (pa.string(), "the behaviour policy"),
    "terminated": (pa.bool_(), "whether the task ended it, and not the time limit"),
    "first_frame": (PICTURE, "the first observation's first view"),
}
"""Column -> (type, meaning)."""


def write_table(release: Release, path: Path) -> None:
    """Write the table; render the first frames of episodes without stored pictures.

    Raises:
      StoreError: something cannot be read or written.
    """
    with pq.ParquetWriter(path, _schema(), compression="zstd") as writer:
        for subset in release.subsets.values():
            for first in range(0, len(subset.episodes), ROWS):
                few = subset.episodes[first : first + ROWS]
                writer.write_table(pa.Table.from_pydict(_facts(subset, few) | _frames(subset, few), _schema()))


def table_rows(path: Path) -> set[tuple]:
    """The rows of a table without the pictures; none if there is no table that can be read."""
    try:
        table = pq.read_table(path, columns=[name for name in COLUMNS if name != "first_frame"])
    except (pa.ArrowInvalid, OSError, KeyError):
        return set()
    return {tuple(row.values()) for row in table.to_pylist()}


def _dtype(kind: pa.DataType) -> str:
    """A type as `datasets` names it."""
    return "image" if kind == PICTURE else {"double": "float64"}.get(str(kind), str(kind))


def _schema() -> pa.Schema:
    features: dict[str, Any] = {
        name: {"_type": "Image"} if kind == PICTURE else {"dtype": _dtype(kind), "_type": "Value"}
        for name, (kind, _) in COLUMNS.items()
    }
    metadata = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.schema([(name, kind) for name, (kind, _) in COLUMNS.items()], metadata=metadata)


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
    pictures = training_pictures(subset)
    pictures = pictures if pictures.views else shown(subset)  # the overhead view, if there is no other
    name, frames = pictures.arrays[0], dict.fromkeys(episodes.tolist())
    lacking = episodes[subset.unpainted[episodes]] if name in subset.arrays else episodes
    for episode in np.setdiff1d(episodes, lacking).tolist():
        frames[episode] = subset.array(name)[episode, 0]
    if len(lacking) and not subset.record.imported:
        renderer, _ = renderer_for(subset.record, background_source(subset.release.path, subset.record))
        try:
            physics, labels = subset.read("physics", lacking)[:, 0], subset.labels(lacking)[:, 0]
            made = renderer.render(physics, labels, views=[pictures.views[0]], hide_goal=pictures.hide_goal)[:, 0]
        finally:
            renderer.close()
        frames |= dict(zip(lacking.tolist(), made, strict=True))
    return {"first_frame": [_picture(frame) for frame in frames.values()]}


def _picture(frame: np.ndarray | None) -> dict[str, Any] | None:
    if frame is None:
        return None
    picture, buffer = Image.fromarray(frame), io.BytesIO()
    if max(picture.size) > FRAME:
        picture = picture.resize((FRAME, FRAME), Image.Resampling.BOX)
    picture.save(buffer, "PNG")
    return {"bytes": buffer.getvalue(), "path": None}
