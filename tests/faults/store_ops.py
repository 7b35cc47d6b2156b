"""Operations on tiny releases of made-up numbers, plain JSON in and out, to be run by `tests.faults.server`.

A release has a subset of walker's arrays and one of a maze's, pictures of 4 pixels, 5 rows an episode. Shard values are
drawn from the subset's name and the shard's number, so that a shard made again has the bytes that it had.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.manifest import Manifest, SubsetRecord
from dmcvb_gen.dataset.schema import ArraySpec, EpisodeShape, array_specs
from dmcvb_gen.dataset.writer import create_subset, finish_release, shard_episodes, start_release, write_shard
from dmcvb_gen.release.fetch import fetch as bring
from dmcvb_gen.release.publish import publish as put
from dmcvb_gen.release.verify import check_files

SIZE, ROWS, EPISODES, EPISODES_PER_SHARD = 4, 5, 3, 2
WALKER = EpisodeShape(("pixels",), False, {"height": (0, 1), "velocity": (1, 4)}, 6, 4, 9, 2, ROWS - 1)
MAZE = EpisodeShape(("top", "egocentric"), True, {"goal": (0, 2), "joints": (2, 7)}, 8, 7, 11, 3, ROWS - 1)
SHAPES = {"walker-walk/random/dynamic": WALKER, "ant-maze-empty7x7/random/visible": MAZE}
NAMES = tuple(SHAPES)
SHARDS = tuple((name, shard) for name in NAMES for shard in range(-(-EPISODES // EPISODES_PER_SHARD)))


def record_of(name: str) -> SubsetRecord:
    task, level, setting = name.split("/")
    return SubsetRecord(
        name=name,
        task=task,
        level=level,
        setting=setting,
        episodes=EPISODES,
        episodes_per_shard=EPISODES_PER_SHARD,
        size=SIZE,
        views=SHAPES[name].views,
        max_steps=SHAPES[name].max_steps,
        renderer={"name": "native", "samples": None},
    )


def manifest() -> Manifest:
    records = tuple(record_of(name) for name in NAMES)
    pattern = {"tasks": "walker-walk", "levels": "random", "settings": "dynamic", "episodes": EPISODES}
    recipe = {"name": "made-up", "seed": 0, "subsets": [pattern]}
    return Manifest(name="made-up", version="1.0.0", license="CC-BY-4.0", recipe=recipe, subsets=records)


def specs_of(name: str) -> tuple[ArraySpec, ...]:
    return array_specs(SHAPES[name], SIZE)


def values_of(name: str, shard: int) -> dict[str, np.ndarray]:
    """Every array of a shard, (episode, row, ...); no value is the fill value."""
    first, last = shard_episodes(record_of(name), shard)
    rng = np.random.default_rng([zlib.crc32(name.encode()), shard])
    values = {}
    for spec in specs_of(name):
        shape = (last - first, *((ROWS,) if spec.steps else ()), *spec.shape)
        values[spec.name] = rng.integers(1, 100, shape).astype(spec.dtype)
    values["length"][:] = ROWS - 1
    return values


def start(root: str) -> None:
    """Make the release's folder, manifest and empty arrays, or take them up."""
    begun = start_release(Path(root), manifest())
    for record in begun.subsets:
        create_subset(Path(root), record, specs_of(record.name), ROWS, {"task": record.task})


def write(root: str, name: str, shard: int) -> dict:
    values = values_of(name, shard)
    return write_shard(Path(root), record_of(name), shard, values.items(), values["length"]).model_dump(mode="json")


def finish(root: str) -> dict:
    return finish_release(Path(root), open_release(root).manifest).model_dump(mode="json")


def publish(root: str, url: str) -> int:
    return put(root, url, workers=2).moved


def fetch(url: str, out: str, only: list[str], episodes: list[int] | None) -> int:
    return bring(url, out, only, tuple(episodes) if episodes else None, workers=2).moved


def look(root: str) -> dict[str, list[int]]:
    """The committed shards of each subset, every value of them compared with what was written; {} without a release."""
    if not (Path(root) / "manifest.json").exists():
        return {}
    found = {name: [] for name in NAMES}
    for name, subset in open_release(root).subsets.items():
        for shard in subset.commits:
            found[name].append(shard)
            episodes = range(*shard_episodes(subset.record, shard))
            for array, wanted in values_of(name, shard).items():
                np.testing.assert_array_equal(subset.read(array, episodes), wanted, err_msg=f"{name} {shard} {array}")
    return found


def check(root: str) -> list[str]:
    """What is wrong with a release's files, in words."""
    return [str(finding) for finding in check_files(Path(root))]
