"""Codecs and chunks of the pictures: bytes a step, writing, reading whole episodes and random 3-frame stacks.

    python scripts/bench_store.py --episodes 6

Rolls out a few walker episodes under each distractor setting (random actions), writes the same pictures in
every layout, and prints one row each. Ratios are against plain zstd in the same run.
"""

from __future__ import annotations

import argparse
import shutil
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
    folder = Path(tempfile.mkdtemp())
    try:
        count, rows, *image = values.shape
        array = zarr.create_array(
            str(folder),
            shape=values.shape,
            chunks=(1, chunk, *image),
            shards=(count, -(-rows // chunk) * chunk, *image),
            dtype="uint8",
            fill_value=0,
            **codecs(layout),
        )
        started = time.perf_counter()
        array[:] = values
        write = values.nbytes / 1e6 / (time.perf_counter() - started)
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and path.name != "zarr.json")
        started = time.perf_counter()
        for episode in range(len(values)):
            assert np.array_equal(array[episode], values[episode])
        read = len(values) * values.shape[1] / (time.perf_counter() - started)
        rng = np.random.default_rng(0)
        started, count = time.perf_counter(), 150
        for _ in range(count):
            episode, step = rng.integers(len(values)), rng.integers(values.shape[1] - 3)
            array[episode, step : step + 3]
        stacks = count / (time.perf_counter() - started)
        return dict(bytes=size / (len(values) * (values.shape[1] - 1)), write=write, read=read, stacks=stacks)
    finally:
        shutil.rmtree(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="walker-walk")
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--settings", nargs="+", default=["none", "static", "dynamic"])
    parser.add_argument("--chunks", nargs="+", type=int, default=list(CHUNKS))
    options = parser.parse_args()
    measure(pictures(options.task, "none", 1)[:, :64], "zstd", 32)  # the first call of everything is slow
    print(
        f"{'setting':8} {'layout':22} {'chunk':>5} {'B/step':>7} {'ratio':>6} {'write MB/s':>10} "
        f"{'episode frames/s':>16} {'3-stacks/s':>10}"
    )
    for setting in options.settings:
        values = pictures(options.task, setting, options.episodes)
        base = None
        for layout in LAYOUTS:
            for chunk in options.chunks if layout == LAYOUTS[0] or len(options.chunks) < 3 else options.chunks[1:3]:
                row = measure(values, layout, chunk)
                base = base or row["bytes"]
                print(
                    f"{setting:8} {layout:22} {chunk:5} {row['bytes']:7.0f} {row['bytes'] / base:6.2f} "
                    f"{row['write']:10.0f} {row['read']:16.0f} {row['stacks']:10.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
