"""Codecs and chunks of the pictures: bytes a step, writing, reading whole episodes and random 3-frame stacks.

    python scripts/bench_store.py --episodes 6

Rolls out a few walker episodes under each distractor setting (random actions), writes the same pictures in
every layout, and prints one row each. Ratios are against plain zstd in the same run.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec, TransposeCodec, ZstdCodec, numcodecs

from dmcvb_gen.generate.plan import make_plan, run_plan, start
from dmcvb_gen.generate.recipe import make_recipe

LAYOUTS = (
    "zstd",
    "zstd-9",
    "blosc-bitshuffle",
    "time-zstd",
    "time-delta-zstd",
    "width-delta-zstd",
    "width-delta-zstd-9",
    "width-delta-blosc",
    "channel-delta-zstd",
)
CHUNKS = (8, 32, 128, 501)


def codecs(layout: str) -> dict[str, tuple]:
    """Codecs of a chunk (1, step, height, width, channel), by name of the layout."""
    last, width, channel = ((0, 2, 3, 4, 1), (0, 1, 4, 2, 3), (0, 4, 1, 2, 3))
    orders = {"time": last, "width": width, "channel": channel}
    transpose = [TransposeCodec(order=order) for name, order in orders.items() if layout.startswith(name)]
    delta = [numcodecs.Delta(dtype="|u1")] if "delta" in layout else []
    level = 9 if layout.endswith("-9") else 1 if layout.startswith("channel") else 3
    packed: object = ZstdCodec(level=level)
    if "blosc" in layout:
        shuffle = "bitshuffle" if "bitshuffle" in layout else "noshuffle"
        packed = BloscCodec(cname="zstd", clevel=5 if shuffle == "bitshuffle" else 3, shuffle=shuffle, typesize=1)
    return {"filters": (*transpose, *delta), "compressors": (packed,)}


def pictures(task_id: str, setting: str, episodes: int) -> np.ndarray:
    """(episode, 501, 64, 64, 3) uint8."""
    recipe = make_recipe(
        {
            "name": "bench",
            "subsets": [{"tasks": task_id, "levels": "random", "settings": setting, "episodes": episodes}],
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        plan = make_plan(recipe, folder)
        start(plan)
        [subset] = run_plan(plan, 1).release.subsets.values()
        return subset.read("pixels")


def measure(values: np.ndarray, layout: str, chunk: int) -> dict[str, float]:
    """Bytes a step, MB written a second, frames of whole episodes and stacks of three frames read a second."""
    count, rows, *image = values.shape
    with tempfile.TemporaryDirectory() as folder:
        shape = dict(chunks=(1, chunk, *image), shards=(count, -(-rows // chunk) * chunk, *image))
        array = zarr.create_array(folder, shape=values.shape, dtype="uint8", fill_value=0, **shape, **codecs(layout))
        started = time.perf_counter()
        array[:] = values
        write = values.nbytes / 1e6 / (time.perf_counter() - started)
        size = sum(path.stat().st_size for path in Path(folder, "c").rglob("*") if path.is_file())
        started = time.perf_counter()
        for episode in range(count):
            assert np.array_equal(array[episode], values[episode])
        read = count * rows / (time.perf_counter() - started)
        rng, started = np.random.default_rng(0), time.perf_counter()
        for _ in range(150):
            episode, step = rng.integers(count), rng.integers(rows - 3)
            array[episode, step : step + 3]
        stacks = 150 / (time.perf_counter() - started)
    return dict(bytes=size / (count * (rows - 1)), write=write, read=read, stacks=stacks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="walker-walk")
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--settings", nargs="+", default=["none", "static", "dynamic"])
    options = parser.parse_args()
    measure(pictures(options.task, "none", 1)[:, :64], "zstd", 32)  # the first call of everything is slow
    print("setting  layout                 chunk  B/step  ratio write MB/s episode frames/s 3-stacks/s")
    for setting in options.settings:
        values, base = pictures(options.task, setting, options.episodes), None
        for layout in LAYOUTS:
            for chunk in CHUNKS if layout == LAYOUTS[0] else CHUNKS[1:3]:
                row = measure(values, layout, chunk)
                base = base or row["bytes"]
                print(
                    f"{setting:8} {layout:22} {chunk:5} {row['bytes']:7.0f} {row['bytes'] / base:6.2f} "
                    f"{row['write']:10.0f} {row['read']:16.0f} {row['stacks']:10.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
